"""The calls of one robot's end of a link: those that its programs make, and those that other robots make here.

*At most once.* A request names the start of the robot for which it is. A robot that has started again since drops it,
because its earlier start may have executed the request. Of one start of a caller, requests are taken in the order of
their numbers only. So a request is executed at most once, whatever is lost, repeated, or restarted.

*Deadline.* The caller's end and the end that is called both drop a call when its deadline has passed. A reply that
arrives later is counted, and does not reach the client.

Counters, where NAME is the name of the service on the graph of this end:

- of calls made here: ``called:NAME``, and each of them in one of ``answered:NAME``, ``timed_out:NAME`` (no reply by the
  deadline), ``server_gone:NAME`` (the far server, or its robot's link, has ended) and ``too_many:NAME`` (``MAX_CALLS``
  were waiting: the oldest without a deadline is given up, or where there is none the new one); or it waits. ``late``
  counts replies to calls that no longer wait, and requests that come after their deadline.
- of calls of other robots: ``served:NAME``, and each of them in one of ``replied:NAME``, ``unanswered:NAME`` (the
  server here did not reply by the deadline), ``caller_gone:NAME`` (the caller's link has started again) and
  ``refused:NAME`` (``MAX_CALLS`` of that robot were waiting: as above); or it waits.
- of frames that are dropped before that: ``not_for_us``, ``other_start`` (for an earlier start of this robot),
  ``repeated``, ``no_server``, ``malformed``.

Invariants: there is no clock and no IO here, the caller passes in the time; no input raises an error; memory is bounded
by ``MAX_CALLS`` per robot; the counters of calls add up.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from math import inf

from gr_ros2.calls.frames import MAX_DEADLINE_S, NO_DEADLINE, CallFrame, read_frame, write_frame
from gr_ros2.core.errors import WireError

MAX_CALLS = 256
"""Calls that may wait for a reply: of this robot in all, and of each other robot."""


@dataclass(frozen=True, slots=True)
class Request:
    """A request of another robot, for a server on the graph of this end. ``ticket`` names it in :meth:`Calls.reply`."""

    ticket: int
    service_id: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Answer:
    """A reply for the client that gave this ``token`` to :meth:`Calls.call`."""

    robot: int
    service_id: int
    token: Hashable
    payload: bytes


@dataclass(frozen=True, slots=True)
class OutgoingFrame:
    """A frame to be sent to a robot. It is useless after ``lifespan_s`` seconds; infinity means that there is no
    limit."""

    data: bytes
    lifespan_s: float
    robot: int


@dataclass(frozen=True, slots=True)
class Service:
    """A service of another robot.

    :param boot: the start of the robot that announced it
    :param service_id: its topic id in that robot's table
    :param name: of the service on the graph of this end
    """

    robot: int
    boot: int
    service_id: int
    name: str


@dataclass(frozen=True, slots=True)
class Offer:
    """A service of this robot.

    :param name: on the graph of this end
    :param deadline_s: s that its server has for a reply, where the caller does not ask for less; ``NO_DEADLINE``
        without limit
    """

    name: str
    deadline_s: float = NO_DEADLINE


@dataclass(frozen=True, slots=True)
class _Made:
    """A call made here that waits for its reply."""

    service: Service
    token: Hashable
    expires: float

    @property
    def name(self) -> str:
        return self.service.name


@dataclass(frozen=True, slots=True)
class _Served:
    """A call of another robot that waits for the reply of the server here."""

    name: str
    robot: int
    boot: int
    number: int
    expires: float


class Calls:
    """Both directions of one robot's calls.

    :param src_id: id of this robot
    :param boot: number of this start of it
    """

    def __init__(self, src_id: int, boot: int) -> None:
        self.counters: Counter[str] = Counter()
        self._src_id, self._boot = src_id, boot
        self._number = 0
        self._ticket = 0
        self._made: dict[int, _Made] = {}
        self._served: dict[int, _Served] = {}
        self._last: dict[int, tuple[int, int]] = {}
        """The newest start of each robot, and the number of the last request that was taken from it."""

    # ---- calls made here

    def call(
        self, service: Service, token: Hashable, payload: bytes, *, deadline_s: float, now: float
    ) -> OutgoingFrame | None:
        """Make a call.

        :param token: given back with the reply
        :param deadline_s: s until the reply must be here; ``NO_DEADLINE``, or more than 6553.5, without limit
        :return: what to send; None if too many calls wait
        """
        robot, boot, name = service.robot, service.boot, service.name
        self.expire(now)
        self.counters[f"called:{name}"] += 1
        if len(self._made) >= MAX_CALLS and not self._make_space(self._made, list(self._made), "too_many"):
            self.counters[f"too_many:{name}"] += 1
            return None
        self._number += 1
        deadline_s = deadline_s if deadline_s <= MAX_DEADLINE_S else NO_DEADLINE
        expires = now + deadline_s if deadline_s else inf
        self._made[self._number] = _Made(service, token, expires)
        frame = CallFrame(robot, boot, self._number, payload, service.service_id, deadline_s)
        return OutgoingFrame(write_frame(frame), deadline_s or inf, robot)

    def withdrawn(self, robot: int, service_ids: Iterable[int]) -> None:
        """A robot no longer has these services. Calls of them will not be answered."""
        gone = frozenset(service_ids)
        self._give_up(lambda service: service.robot == robot and service.service_id in gone)

    # ---- calls of other robots

    def reply(self, ticket: int, payload: bytes, now: float) -> OutgoingFrame | None:
        """The server here has replied to a request.

        :return: what to send; None if nobody waits for it any more
        """
        self.expire(now)
        served = self._served.pop(ticket, None)
        if served is None:
            self.counters["late"] += 1
            return None
        self.counters[f"replied:{served.name}"] += 1
        frame = CallFrame(served.robot, served.boot, served.number, payload)
        return OutgoingFrame(write_frame(frame), served.expires - now, served.robot)

    # ---- frames

    def receive(
        self, sender: tuple[int, int], data: bytes, offers: Mapping[int, Offer], now: float, age_s: float = 0.0
    ) -> Request | Answer | None:
        """Take the bytes of a frame.

        :param sender: id of the robot that sent it, and the start of that robot
        :param offers: the services of this robot whose server is there, by id
        :param age_s: s for which it has been under way: a call counts from its caller
        :return: what it asks for; None for a frame that is dropped, and counted
        """
        self.expire(now)
        try:
            frame = read_frame(data)
        except WireError:
            return self._dropped("malformed")
        if frame.dst_id != self._src_id:
            return self._dropped("not_for_us")
        if frame.dst_boot != self._boot:
            return self._dropped("other_start")
        return self._request(sender, frame, offers, now, age_s) if frame.is_request else self._answer(sender, frame)

    def started(self, robot: int, boot: int) -> None:
        """Note that a robot has started. Its earlier starts neither answer nor wait for an answer."""
        self._give_up(lambda service: service.robot == robot and service.boot != boot)
        for ticket in [key for key, call in self._served.items() if call.robot == robot and call.boot != boot]:
            self.counters[f"caller_gone:{self._served.pop(ticket).name}"] += 1

    def expire(self, now: float) -> None:
        """Give up the calls whose deadline has passed."""
        for number in [number for number, made in self._made.items() if made.expires <= now]:
            self.counters[f"timed_out:{self._made.pop(number).name}"] += 1
        for ticket in [ticket for ticket, served in self._served.items() if served.expires <= now]:
            self.counters[f"unanswered:{self._served.pop(ticket).name}"] += 1

    @property
    def waiting(self) -> tuple[int, int]:
        """Number of calls that wait: of those made here, and of those of other robots."""
        return len(self._made), len(self._served)

    def _request(
        self, sender: tuple[int, int], frame: CallFrame, offers: Mapping[int, Offer], now: float, age_s: float
    ) -> Request | Answer | None:
        robot, boot = sender
        newest, last = self._last.get(robot, (-1, 0))
        if boot == newest and frame.number <= last:
            return self._dropped("repeated")
        self._last[robot] = (boot, frame.number)
        offer = offers.get(frame.service_id)
        if offer is None:
            return self._dropped("no_server")
        expires = now - age_s + min(frame.deadline_s or inf, offer.deadline_s or inf)
        if now >= expires:
            return self._dropped("late")
        name = offer.name
        self.counters[f"served:{name}"] += 1
        waiting = [ticket for ticket, call in self._served.items() if call.robot == robot]
        if len(waiting) >= MAX_CALLS and not self._make_space(self._served, waiting, "refused"):
            return self._dropped(f"refused:{name}")
        self._ticket += 1
        self._served[self._ticket] = _Served(name, robot, boot, frame.number, expires)
        return Request(self._ticket, frame.service_id, frame.payload)

    def _answer(self, sender: tuple[int, int], frame: CallFrame) -> Request | Answer | None:
        made = self._made.get(frame.number)
        if made is None or (made.service.robot, made.service.boot) != sender:
            return self._dropped("late")
        del self._made[frame.number]
        self.counters[f"answered:{made.name}"] += 1
        return Answer(made.service.robot, made.service.service_id, made.token, frame.payload)

    def _give_up(self, ended: Callable[[Service], bool]) -> None:
        for number in [number for number, made in self._made.items() if ended(made.service)]:
            self.counters[f"server_gone:{self._made.pop(number).name}"] += 1

    def _make_space(self, calls: dict[int, _Made] | dict[int, _Served], keys: list[int], counter: str) -> bool:
        """Give up the oldest of these calls that has no deadline, as its caller may have left long ago."""
        for key in keys:
            if calls[key].expires == inf:
                self.counters[f"{counter}:{calls.pop(key).name}"] += 1
                return True
        return False

    def _dropped(self, counter: str) -> Request | Answer | None:
        self.counters[counter] += 1
        return None
