"""Who wants which topics of whom: the wishes of other robots here, and those of this robot elsewhere.

A wish belongs to one start of the robot that asks, and ends by itself: it holds for ``LEASE_S`` at most, and whoever
wants a topic for longer asks again (:class:`OwnWishes`). So a sender stops soon when a robot that asked has vanished,
and at once when that robot has started again. A sender that has started again is asked again as soon as it is heard.

Invariants: there is no clock and no IO here, the caller passes in the time; memory is bounded by ``MOST_WISHES`` for
each robot, and for this robot in all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

from gr_ros2.calls.wish_frames import GiveUp, LinkRequest, WishAnswer, WishOutcome, WishRequest

MOST_WISHES = 32
LEASE_S = 60.0
"""s for which a wish holds without being renewed. It is renewed at half of that."""
PATIENCE_S = 30.0
"""s for which an answer is waited for; also the longest time after which a wish is sent again."""
AGAIN_S = 4.0
"""s after which a wish is sent again without an answer; then twice as long, and so on. A robot that has just started
may miss what was sent before it had heard this one, and measures a topic for 2 s before it answers."""
_SHOWN_S = 60.0
"""s for which it is remembered how a wish ended."""


def faster(one: float, other: float) -> float:
    """The higher of two rates in messages/s, where 0 is as they come."""
    return max(one, other) if one and other else 0.0


@dataclass(frozen=True, slots=True)
class Held:
    """A wish of another robot.

    :param boot: the start of the robot that asked
    :param until: s
    """

    boot: int
    rate: float
    until: float


class HeldWishes:
    """The wishes of other robots for topics of this one."""

    def __init__(self) -> None:
        self._held: dict[tuple[int, str], Held] = {}

    def take(self, robot: int, boot: int, wish: WishRequest, now: float) -> bool:
        """Take or renew a wish; returns whether there was room for it."""
        self.expire(now)
        key = (robot, wish.name)
        if key not in self._held and sum(whose == robot for whose, _ in self._held) >= MOST_WISHES:
            return False
        self._held[key] = Held(boot, wish.rate, now + min(wish.for_s, LEASE_S))
        return True

    def give_up(self, robot: int, name: str) -> None:
        """A robot wants a topic no more."""
        self._held.pop((robot, name), None)

    def started(self, robot: int, boot: int) -> None:
        """A robot has started: nobody waits for what its earlier starts wanted."""
        for key in [key for key, held in self._held.items() if key[0] == robot and held.boot != boot]:
            del self._held[key]

    def expire(self, now: float) -> None:
        """End the wishes that were not renewed."""
        for key in [key for key, held in self._held.items() if held.until <= now]:
            del self._held[key]

    def wanted(self, now: float) -> dict[str, float]:
        """The highest rate at which each topic is wanted."""
        self.expire(now)
        rates: dict[str, float] = {}
        for (_, name), held in self._held.items():
            rates[name] = faster(rates.get(name, held.rate), held.rate)
        return rates

    def holds(self, robot: int, boot: int, wish: WishRequest, now: float) -> bool:
        """Whether a robot wants this already, as fast or faster."""
        held = self._held.get((robot, wish.name))
        return held is not None and held.boot == boot and held.until > now and faster(held.rate, wish.rate) == held.rate

    @property
    def next_end(self) -> float:
        """When the next wish ends, s; infinite if there is none."""
        return min((held.until for held in self._held.values()), default=inf)

    def __iter__(self) -> Iterator[tuple[int, str, Held]]:
        return ((robot, name, held) for (robot, name), held in self._held.items())


@dataclass(slots=True)
class OwnWish:
    """A wish of this robot.

    :param until: s, when it ends
    :param ask_at: when the other robot is asked, or asked again, s
    :param again_s: after which it is asked again without an answer
    :param leased: until when it holds at the other robot, if that has taken it, s
    :param answer: the newest; None before the first
    :param ended: when it was given up, refused or over, s; infinite while it goes on
    """

    rate: float
    until: float
    ask_at: float
    again_s: float = AGAIN_S
    leased: float = -inf
    answer: WishAnswer | None = None
    ended: float = inf


class OwnWishes:
    """What this robot wants of others."""

    def __init__(self) -> None:
        self._wishes: dict[tuple[int, str], OwnWish] = {}
        self._given_up: list[tuple[int, str]] = []

    def want(self, robot: int, name: str, rate: float, for_s: float, now: float) -> bool:
        """Want a topic from now on; returns whether there is room for one more wish."""
        self.expire(now)
        key = (robot, name)
        going_on = [other for other, wish in self._wishes.items() if wish.ended == inf and other != key]
        if len(going_on) >= MOST_WISHES:
            return False
        self._wishes.pop(key, None)
        for other in [other for other, wish in self._wishes.items() if wish.ended < inf][: -MOST_WISHES or None]:
            del self._wishes[other]
        self._wishes[key] = OwnWish(rate, now + for_s, now)
        return True

    def give_up(self, robot: int, name: str, now: float) -> None:
        """Want a topic no more. The other robot is told, whether it knows of the wish or not."""
        wish = self._wishes.get((robot, name))
        if wish is not None:
            wish.ended = min(wish.ended, now)
        if len(self._given_up) < MOST_WISHES:
            self._given_up.append((robot, name))

    def due(self, now: float) -> list[tuple[int, LinkRequest]]:
        """What is to be asked now, and of whom. Each is asked again if no answer comes."""
        self.expire(now)
        asks: list[tuple[int, LinkRequest]] = [(robot, GiveUp(name)) for robot, name in self._given_up]
        self._given_up.clear()
        for (robot, name), wish in self._wishes.items():
            if wish.ended == inf and wish.ask_at <= now:
                lease_s = max(1, round(min(wish.until - now, LEASE_S)))
                wish.ask_at, wish.leased = now + wish.again_s, now + lease_s
                wish.again_s = min(2 * wish.again_s, PATIENCE_S)
                asks.append((robot, WishRequest(name, wish.rate, lease_s)))
        return asks

    def unheard(self, robot: int, name: str, now: float, again_s: float) -> None:
        """The robot could not be asked, as it is not heard: it is asked again soon, or when it is met."""
        if (wish := self._wishes.get((robot, name))) is not None:
            wish.ask_at = now + again_s

    def answered(self, robot: int, request: WishRequest, answer: WishAnswer, now: float) -> None:
        """An answer has come. A wish that was refused is over, and one for what is sent anyway."""
        wish = self._wishes.get((robot, request.name))
        if wish is None or wish.ended < inf or wish.rate != request.rate:
            return
        wish.answer, wish.again_s = answer, AGAIN_S
        if answer.outcome == WishOutcome.SENT:
            wish.ask_at = inf if wish.leased > wish.until - 1 else now + LEASE_S / 2
        else:
            wish.ended = now

    def met(self, robot: int, now: float) -> None:
        """A robot has started, or is heard again: it may know nothing of the wishes."""
        for (whose, _), wish in self._wishes.items():
            if whose == robot:
                wish.ask_at, wish.again_s = now, AGAIN_S

    def expire(self, now: float) -> None:
        """End what is over, and forget what has been over for long."""
        for key, wish in list(self._wishes.items()):
            wish.ended = min(wish.ended, wish.until if wish.until <= now else inf)
            if now - wish.ended > _SHOWN_S:
                del self._wishes[key]

    def get(self, robot: int, name: str) -> OwnWish | None:
        """A wish, which may be over."""
        return self._wishes.get((robot, name))

    @property
    def next_ask(self) -> float:
        """When somebody is to be asked, s; infinite if nobody is."""
        if self._given_up:
            return -inf
        return min((wish.ask_at for wish in self._wishes.values() if wish.ended == inf), default=inf)

    def __iter__(self) -> Iterator[tuple[int, str, OwnWish]]:
        return ((robot, name, wish) for (robot, name), wish in self._wishes.items())
