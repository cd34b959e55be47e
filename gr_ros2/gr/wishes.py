"""Topics that are asked for from afar: what other robots want of this one, and what this one wants of others.

The wishes are kept by :mod:`gr_ros2.calls.wishes`, and cross as calls of the link itself. A thread, which begins with
the first wish, starts and ends what is sent, and asks others again.

Invariants: nothing is sent here, and no message of an offered topic is taken, unless somebody asks; whatever others
ask, the thread goes on; what is shown of another robot is what that robot has answered.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from math import floor, inf
from typing import Any, NamedTuple

from gr_ros2.calls import Request
from gr_ros2.calls.wish_frames import (
    MOST_OFFERS,
    GiveUp,
    LinkRequest,
    ListRequest,
    OfferRow,
    WishAnswer,
    WishOutcome,
    WishRequest,
    read_answer,
    read_offers,
    read_request,
    write_answer,
    write_offers,
    write_request,
)
from gr_ros2.calls.wishes import PATIENCE_S, HeldWishes, OwnWish, OwnWishes
from gr_ros2.core.errors import ConfigError, GrRos2Error, WireError
from gr_ros2.core.names import topic_fault
from gr_ros2.gr.calls import LiveCalls
from gr_ros2.gr.link_sending import LinkSendingBlock
from gr_ros2.gr.offers import Measurements, OpenTopic
from gr_ros2.middleware import Middleware
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import DEFAULT_OPTIONS
from gr_ros2.settings.robot import RobotConfig

LOOK_S = 1.0
"""s between two looks at whether what is sent has another type now, and at whether a robot is heard again."""
_MOST_WAITING = 256
"""Requests of each robot that wait to be looked at."""
_log = logging.getLogger(__name__)

Told = Callable[[bool, str], None]
"""Takes whether a wish is fulfilled, and what became of it in words."""


class _Asked(NamedTuple):
    """A request of a robot, or of one of its starts."""

    robot: int
    boot: int
    ticket: int
    request: LinkRequest


@dataclass(slots=True)
class _List:
    """What a robot offers, as far as it has told.

    :param at: when it has answered, s; -inf before that
    """

    rows: list[OfferRow]
    at: float = -inf


class LiveWishes:
    """The wishes of both directions of one robot's link.

    :param source: sends what is asked for, and knows what may be
    :param alone: what sends over one radio alone, by the name of the radio
    """

    def __init__(
        self,
        config: RobotConfig,
        calls: LiveCalls,
        source: LinkSendingBlock,
        graph: Middleware,
        *,
        clock: Callable[[], float],
        alone: Callable[[str], LinkSendingBlock | None] | None = None,
    ) -> None:
        self._config, self._calls, self._source, self._clock = config, calls, source, clock
        self._alone = alone or (lambda _via: None)
        self._found = source.found
        self._closed = threading.Event()
        self._measurements = Measurements(graph, clock, self._closed, coded=config.compression)
        self._due = threading.Condition()
        """Its lock protects everything below."""
        self._held, self._own = HeldWishes(), OwnWishes()
        self._inbox: list[_Asked] = []
        self._lists: dict[int, _List] = {}
        self._asks: set[int] = set()
        """Robots that are to be asked what they offer."""
        self._told: dict[tuple[int, str], list[tuple[float, Told]]] = {}
        self._sent: dict[str, tuple[OpenTopic, float]] = {}
        """What is sent because somebody wants it, and its rate."""
        self._counters: Counter[str] = Counter()
        self._look_at = inf
        self._thread: threading.Thread | None = None
        if config.offer:
            for options in (DEFAULT_OPTIONS, *config.offer.values()):
                self._sender(options).measure_air()
            if not config.key:
                _log.warning(
                    "what offer names can be asked for by whoever can send on this link, as it has no key; set key"
                )
        calls.on_link_call, calls.on_met = self._called, self._met

    def close(self) -> None:
        """Ask nobody any more, and end what others have asked for. Idempotent."""
        self._closed.set()
        with self._due:
            thread = self._thread
            self._due.notify_all()
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    # ---- what this robot wants

    def want(self, robot: int, name: str, rate: float = 0.0, for_s: float = 60.0, told: Told | None = None) -> None:
        """Want a topic, a service or an action of another robot from now on.

        :param name: as that robot calls it
        :param rate: messages/s at most; 0 = as they come
        :param told: called once, when the robot has answered, or has not for ``PATIENCE_S``
        :raises ConfigError: for a robot that is not heard, a wrong name or number, or too many wishes
        """
        name = self._checked(robot, name)
        try:
            write_request(WishRequest(name, rate, 1))
        except WireError as error:
            raise ConfigError(f"rate = {rate:g}: write messages/s, 0 for as many as come") from error
        if not 1 <= for_s < inf:
            raise ConfigError(f"for = {for_s:g} s: write 1 s or more")
        now = self._clock()
        with self._due:
            if not self._own.want(robot, name, rate, for_s, now):
                raise ConfigError("this robot wants too much at a time; give something up (gr-ros2 want … --give-up)")
            if told is not None:
                self._told.setdefault((robot, name), []).append((now + PATIENCE_S, told))
            self._wake()

    def give_up(self, robot: int, name: str) -> None:
        """Want it no more.

        :raises ConfigError: as :meth:`want`
        """
        name = self._checked(robot, name)
        with self._due:
            self._own.give_up(robot, name, self._clock())
            self._wake()

    def wish(self, robot: int, name: str) -> dict[str, Any]:
        """What has become of a wish: ``state`` (asked, sent, refused, over or none), and the same in words."""
        name = name.lstrip("/")
        with self._due:
            self._own.expire(self._clock())
            return self._wish(robot, name, self._own.get(robot, name))

    def offers(self, robot: int, *, anew: bool = False) -> dict[str, Any]:
        """What another robot offers, as far as it has answered: ``rows``, and s since then, None before.

        :param anew: ask it now
        :raises ConfigError: for a robot that is not heard
        """
        self._calls.check_heard(robot)
        with self._due:
            if anew:
                self._lists[robot] = _List([])
                self._asks.add(robot)
                self._wake()
            told = self._lists.get(robot, _List([]))
            age_s = None if told.at == -inf else self._clock() - told.at
            return {"robot": robot, "age_s": age_s, "rows": [asdict(row) for row in told.rows]}

    def hears(self, robot: int) -> bool:
        """Whether a robot can be asked."""
        return robot in self._calls.heard()

    def known(self) -> dict[int, list[dict[str, Any]]]:
        heard = self._calls.heard()
        with self._due:
            told = {robot: self._lists.get(robot, _List([])) for robot in heard}
        return {robot: [asdict(row) for row in offers.rows] for robot, offers in told.items()}

    def stats(self) -> dict[str, Any]:
        """The wishes of this robot, and those of others here with what is sent for them."""
        now = self._clock()
        with self._due:
            self._own.expire(now)
            self._held.expire(now)
            held = [
                {
                    "robot": robot,
                    "topic": name,
                    "rate": wish.rate,
                    "left_s": wish.until - now,
                    "words": f"robot {robot} wants {name}" + (f" at {wish.rate:g}/s at most" if wish.rate else ""),
                }
                for robot, name, wish in self._held
            ]
            own = [self._wish(robot, name, wish) for robot, name, wish in self._own]
            return {"wanted": held, "wants": own, "counters": dict(self._counters)}

    def _wish(self, robot: int, name: str, wish: OwnWish | None) -> dict[str, Any]:
        told: dict[str, Any] = {"robot": robot, "topic": name, "state": "none", "words": f"{name}: nobody wants it"}
        told["offered"] = wish is not None and not (
            wish.answer is not None and wish.answer.outcome == WishOutcome.NOT_OFFERED
        )
        if wish is None:
            return told
        left_s = max(wish.until - self._clock(), 0.0)
        answer, over = wish.answer, wish.ended < inf
        anyway = answer is not None and answer.outcome == WishOutcome.SENT_ANYWAY
        refused = answer is not None and answer.outcome not in (WishOutcome.SENT, WishOutcome.SENT_ANYWAY)
        state = "refused" if refused else "over" if over and not anyway else "asked" if answer is None else "sent"
        told |= {"state": state, "rate": wish.rate, "left_s": 0.0 if over else left_s}
        if answer is not None:
            told |= {"cost_Bps": answer.cost, "free_Bps": None if answer.free == inf else answer.free}
        return told | {"words": _words(robot, name, state, left_s, answer)}

    def _checked(self, robot: int, name: str) -> str:
        """A name without leading slash.

        :raises ConfigError: for a robot that is not heard, or a name that no topic has
        """
        self._calls.check_heard(robot)
        plain = name.lstrip("/")
        if fault := topic_fault(f"/{plain}"):
            raise ConfigError(f"{name!r} {fault}; write it as gr-ros2 topics {robot} does")
        return plain

    # ---- what others want

    def _called(self, robot: int, boot: int, request: Request) -> None:
        with self._due:
            try:
                asked = _Asked(robot, boot, request.ticket, read_request(request.payload))
            except WireError:
                self._counters["malformed"] += 1
                return
            if sum(waits.robot == robot for waits in self._inbox) < _MOST_WAITING:
                self._inbox.append(asked)
                self._wake()
            else:
                self._counters["too_many"] += 1

    def _met(self, robot: int, boot: int) -> None:
        with self._due:
            self._held.started(robot, boot)
            self._own.met(robot, self._clock())
            self._due.notify_all()

    def _measure(self, inbox: Sequence[_Asked]) -> None:
        """Measure all topics at once that are wanted anew: one after the other, 20 take longer than an answer may."""
        new: dict[str, OpenTopic] = {}
        for robot, boot, _, wish in inbox:
            if isinstance(wish, WishRequest) and not self._held.holds(robot, boot, wish, self._clock()):
                offered = self._found.offers.get(wish.name)
                if offered is not None and offered.options.to in (AUTO, robot) and not offered.fits:
                    new[wish.name] = offered
        self._measurements.measure(new.values())

    def _serve(self, robot: int, boot: int, ticket: int, asked: LinkRequest) -> None:
        match asked:
            case ListRequest():
                reply = write_offers(self._rows())
            case GiveUp(name):
                with self._due:
                    self._held.give_up(robot, name)
                self._apply()
                reply = write_answer(WishAnswer(WishOutcome.SENT))
            case WishRequest():
                answer = self._answer(robot, boot, asked)
                self._counters[answer.outcome.name.lower()] += 1
                reply = write_answer(answer)
        self._calls.answer(ticket, reply)

    def _rows(self) -> list[OfferRow]:
        offers = sorted(self._found.offers.items())[:MOST_OFFERS]
        measured = self._measurements.measure(offered for _, offered in offers)
        return [
            OfferRow(
                name,
                offered.type_name,
                measured[offered.name].rate if offered.name in measured else 0.0,
                measured[offered.name].size if offered.name in measured else 0.0,
                name in self._sent,
                offered.fits,
            )
            for name, offered in offers
        ]

    def _answer(self, robot: int, boot: int, wish: WishRequest) -> WishAnswer:
        offered = self._found.offers.get(wish.name)
        if offered is None:
            sent = self._found.sends(wish.name, robot)
            return WishAnswer(WishOutcome.SENT_ANYWAY if sent else WishOutcome.NOT_OFFERED)
        if offered.options.to not in (AUTO, robot):
            return WishAnswer(WishOutcome.NOT_FOR_YOU)
        renewed = self._held.holds(robot, boot, wish, self._clock())
        answer = (
            WishAnswer(WishOutcome.SENT, offered.at(wish.rate).max_rate) if renewed else self._cost(offered, wish.rate)
        )
        if answer.outcome != WishOutcome.SENT:
            return answer
        with self._due:
            if not self._held.take(robot, boot, wish, self._clock()):
                return WishAnswer(WishOutcome.TOO_MANY)
        self._apply()
        if wish.name not in self._sent:
            with self._due:
                self._held.give_up(robot, wish.name)
            return WishAnswer(WishOutcome.FAILED)
        return answer

    def _cost(self, offered: OpenTopic, asked: float) -> WishAnswer:
        """What sending a topic takes of the air, and whether that is free."""
        rate = offered.at(asked).max_rate
        if offered.info is None or offered.fits:
            return WishAnswer(WishOutcome.SENT, rate)
        measured = self._measurements.measure([offered])[offered.name]
        each, free = self._sender(offered.options).air_for(measured.size)
        comes = measured.rate

        def takes(most: float) -> float:
            return (min(most, comes) if most and comes else most or comes) * each

        _, sent_at = self._sent.get(offered.name.lstrip("/"), (offered, inf))
        before = 0.0 if sent_at == inf else takes(sent_at)
        cost = takes(rate)
        if cost - before > free:
            return WishAnswer(WishOutcome.NO_ROOM, (free + before) / each, cost, free)
        return WishAnswer(WishOutcome.SENT, rate, cost, free)

    def _apply(self) -> None:
        """Send what is wanted now, and nothing else of what is offered."""
        with self._due:
            wanted = self._held.wanted(self._clock())
        for name in [name for name in self._sent if name not in wanted]:
            ended, _ = self._sent.pop(name)
            self._sender(ended.options).found.end(ended)
        for name, rate in wanted.items():
            offered, (sent, sent_at) = self._found.offers.get(name), self._sent.get(name, (None, inf))
            if offered is None or (sent is not None and sent.type_name == offered.type_name and sent_at == rate):
                continue
            try:
                self._sender(offered.options).found.begin(offered, rate, self._config.offer)
                self._sent[name] = offered, rate
            except GrRos2Error as error:
                self._counters["failed"] += 1
                if self._counters["failed"] == 1:
                    _log.warning("%s is asked for and not sent: %s", name, error)

    def _sender(self, options: SendOptions) -> LinkSendingBlock:
        return self._alone(options.via) or self._source

    # ---- the thread

    def _wake(self) -> None:
        """Let the thread look. Called with the lock held."""
        if self._thread is None and not self._closed.is_set():
            self._thread = threading.Thread(target=self._run, name="gr-ros2-wishes", daemon=True)
            self._thread.start()
        self._due.notify_all()

    def _run(self) -> None:
        while True:
            with self._due:
                while not (self._closed.is_set() or self._inbox or self._asks):
                    wait_s = self._next() - self._clock()
                    if wait_s <= 0:
                        break
                    self._due.wait(None if wait_s == inf else wait_s)
                if self._closed.is_set():
                    return
                inbox, self._inbox = self._inbox, []
            steps: list[Callable[[], None]] = [partial(self._measure, inbox)]
            steps += [partial(self._serve, *asked) for asked in inbox]
            for step in [*steps, self._apply, self._ask]:
                try:
                    step()
                except Exception:  # noqa: BLE001 - whatever one robot asks, others are answered
                    self._counters["failed"] += 1
                    if self._counters["failed"] == 1:
                        _log.exception("what is asked for from afar")
            self._look_at = self._clock() + LOOK_S if self._sent else inf

    def _next(self) -> float:
        """When something is to be done, s."""
        waiting = min((at for told in self._told.values() for at, _ in told), default=inf)
        return min(self._held.next_end, self._own.next_ask, waiting, self._look_at)

    def _ask(self) -> None:
        """Ask others, and tell those who wait that no answer has come."""
        now = self._clock()
        with self._due:
            asks: list[tuple[int, LinkRequest]] = [(robot, ListRequest()) for robot in self._asks]
            self._asks.clear()
            asks += self._own.due(now)
            late = [(key, told) for key, waiting in self._told.items() for at, told in waiting if at <= now]
            self._told = {
                key: left for key, waiting in self._told.items() if (left := [one for one in waiting if one[0] > now])
            }
        for (robot, name), told in late:
            told(False, f"robot {robot} has not answered yet; it is asked for {name} again")
        for robot, request in asks:
            heard = self._calls.ask(robot, write_request(request), partial(self._take, robot, request), PATIENCE_S)
            if not heard and isinstance(request, WishRequest):
                with self._due:
                    self._own.unheard(robot, request.name, now, LOOK_S)

    def _take(self, robot: int, request: LinkRequest, reply: bytes) -> None:
        """An answer has come, in the thread that receives."""
        now = self._clock()
        try:
            if isinstance(request, ListRequest):
                rows = [row for row in read_offers(reply) if not topic_fault(f"/{row.name.lstrip('/')}")]
                with self._due:
                    self._lists[robot] = _List(rows, now)
                return
            answer = read_answer(reply)
        except WireError:
            self._counters["malformed"] += 1
            return
        if isinstance(request, WishRequest):
            with self._due:
                self._own.answered(robot, request, answer, now)
                wish = self._wish(robot, request.name, self._own.get(robot, request.name))
                waiting = self._told.pop((robot, request.name), [])
                self._due.notify_all()
            for _, told in waiting:
                told(wish["state"] == "sent", wish["words"])


def _words(robot: int, name: str, state: str, left_s: float, answer: WishAnswer | None) -> str:
    if answer is None:
        return f"robot {robot} has been asked for {name}" if state == "asked" else f"{name} of robot {robot}: given up"
    cost = _bytes(answer.cost) + (f" of {_bytes(answer.free)} that are free" if answer.free < inf else "")
    match answer.outcome:
        case WishOutcome.SENT if state == "over":
            return f"robot {robot} sends {name} no more for this robot"
        case WishOutcome.SENT:
            rate = f" at {answer.rate:g}/s at most" if answer.rate else ""
            return f"robot {robot} sends {name}{rate}, for {left_s:.0f} s" + (
                f"; it takes {cost}" if answer.cost else ""
            )
        case WishOutcome.SENT_ANYWAY:
            return f"robot {robot} sends {name} whether somebody asks or not"
        case WishOutcome.NOT_OFFERED:
            return f"robot {robot} does not offer {name}; what it offers: gr-ros2 topics {robot}"
        case WishOutcome.NO_ROOM:
            most = f"--rate {floor(answer.rate * 100) / 100:g} fits" if answer.rate >= 0.01 else "nothing fits"
            return f"the air is too full for {name} of robot {robot}: it takes {cost}; {most}"
        case WishOutcome.TOO_MANY:
            return f"robot {robot} does not send {name}: this robot wants too much of it; give something up"
        case WishOutcome.NOT_FOR_YOU:
            return f"robot {robot} offers {name} to another robot alone"
    return f"robot {robot} cannot send {name}; its log says why"


def _bytes(rate: float) -> str:
    units = ((1e6, "MB/s"), (1e3, "kB/s"))
    return next((f"{rate / unit:.3g} {name}" for unit, name in units if rate >= unit), f"{rate:.0f} B/s")
