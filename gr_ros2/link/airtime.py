"""When each packet occupies the channel: one after the other, each for its airtime; and when to ask for the next.

Invariants: a packet starts at the latest of its arrival, the time it asks for, and the end of the packet before; a
packet leaves when its airtime is over, or ``ahead`` before it begins, never earlier; idle time is not saved up; a
credit is granted no earlier than ``lead`` and ``ahead`` before the channel is free of all queued and all promised
packets (a promised packet is an unused credit, counted as a longest packet), and only while there are fewer than
``OUTSTANDING`` of them. The lead can follow what the source was measured to need (:class:`ComposingTime`). There is no
IO and no clock: ``now`` is seconds, monotonic. With a limit (:mod:`gr_ros2.link.airtime_limit`) a credit is granted
only when the limit lets a longest packet begin, and a packet that comes without one and would have to wait for the
limit is refused. While sending is switched off, nothing passes and no credit is granted. With ``listens``, one packet
at a time is queued or promised, and it waits until nobody else sends. While the device is not ``ready``, packets wait
too.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from math import inf
from typing import Generic, TypeVar

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.airtime_limit import AirtimeLimit

T = TypeVar("T")

LEAD_S = 0.005
"""s before the channel is free; a source needs this time to compose and hand over the next packet."""
LEAST_LEAD_S = 0.001
"""s of lead at least where it is measured: a thread that sleeps wakes up as late as this now and then."""
READY_S = 0.02
"""s after which a device that was not ready is asked again."""
MEASURED = 64
"""Packets whose composing times decide over the lead. The longest of so many is exceeded by one packet in 65, which
then begins late by a part of a millisecond. On an idle computer: median 0.4 ms, 1 % above 1.4 ms. A lead of 5 ms keeps
one packet more composed in advance, and every message waits for it (``python -m bench live_image``)."""
OUTSTANDING = 2
"""Most packets queued or granted: one being sent and one waiting behind it. Later packets are not composed yet."""


class ComposingTime:
    """How long a source lately took from a credit to its packet at the longest, s: from ``LEAST_LEAD_S`` to ``most``.

    A packet that came later than ``most`` does not count: nothing was there to send, or the computer paused for longer
    than a lead could hide.

    :param most: s, and what holds before so many packets came
    :ivar longest: s
    """

    def __init__(self, most: float) -> None:
        self._most = self.longest = most
        self._took = deque([most] * MEASURED, MEASURED)
        self._granted: deque[float] = deque(maxlen=OUTSTANDING)

    def granted(self, now: float) -> None:
        """A credit was given."""
        self._granted.append(now)

    def came(self, now: float) -> None:
        """A packet came for the oldest credit."""
        took = now - self._granted.popleft() if self._granted else inf
        if took <= self._most:
            self._took.append(took)
            self.longest = min(max(LEAST_LEAD_S, *self._took), self._most)


class AirtimeClock(Generic[T]):
    """A queue that lets packets through at the rate of the channel.

    :param airtime: s that a packet occupies, gap included; the longest if they differ; 0 if packets take no time
    :param lead: s before the channel is free at which the next packet is requested
    :param measured: whether that is at most ``lead``, and otherwise what the source was measured to need
    :param ahead: s before the begin of its airtime at which a packet leaves, if a device then spends that time; None:
        a packet leaves when its airtime is over, because the following stages take no time
    :param limit: what limits the airtime; None = nothing
    :param timed: the device itself waits for the time that a packet asks for, which then leaves ``lead`` before it
    :param listens: called when a packet is about to leave; returns s after which to listen again because somebody else
        sends, 0 if the channel is clear. None: nobody listens
    :param ready: called when a packet is about to leave; returns whether the device takes it. None: always
    :raises ConfigError: for a negative airtime, lead or ahead
    :ivar refused: packets that were refused, by reason: ``airtime_limit`` or ``transmit_off``; others may be
        counted here too
    :ivar used: s of airtime of all packets taken
    :ivar deferred: how often a packet did not leave because somebody else was sending
    :ivar held: whether the credits given last had been held back by the limit, the switch or the device
    """

    def __init__(
        self,
        airtime: float,
        lead: float = LEAD_S,
        ahead: float | None = None,
        limit: AirtimeLimit | None = None,
        *,
        measured: bool = False,
        timed: bool = False,
        listens: Callable[[], float] | None = None,
        ready: Callable[[], bool] | None = None,
    ) -> None:
        if not airtime >= 0:
            raise ConfigError(f"airtime = {airtime} s: must be 0 or more")
        if not lead >= 0:
            raise ConfigError(f"lead = {lead} s: must be 0 or more")
        if ahead is not None and not ahead >= 0:
            raise ConfigError(f"ahead = {ahead} s: must be 0 or more")
        self._airtime = airtime
        self._lead = lead
        self._composing = ComposingTime(lead) if measured else None
        self._ahead = ahead
        self._timed = timed
        self._listens, self._ready = listens, ready
        self._most = OUTSTANDING if listens is None else 1
        self.deferred = 0
        self._free = float("-inf")
        self._queue: deque[tuple[float, float, T]] = deque()
        """When each packet leaves, when its airtime begins, and the packet."""
        self._unused = 0
        self.limit = limit
        self._transmits = True
        self.refused: Counter[str] = Counter()
        self.used = 0.0
        self.held = False
        self._holding = False
        """Whether the limit, the switch or the device has held back the next credit."""

    def offer(self, packet: T, now: float, airtime: float | None = None, leave_at: float | None = None) -> float | None:
        """A packet arrives; it uses a credit if one is open.

        :param airtime: s that it occupies, None for the airtime of the longest packet
        :param leave_at: s, before which its airtime must not begin; None for no such time
        :return: when its airtime begins; None where it is refused
        """
        self._unused = max(0, self._unused - 1)
        if self._composing is not None:
            self._composing.came(now)
        takes = self._airtime if airtime is None else airtime
        begin = max(now, self._free, now if leave_at is None else leave_at)
        if not self._transmits:
            self.refused["transmit_off"] += 1
            return None
        if self.limit is not None:
            allowed = self.limit.earliest(begin, takes)
            if allowed > begin + self._lead or not self.limit.reserve(now, takes):
                self.refused["airtime_limit"] += 1
                return None
            begin = allowed
            self.limit.spend(begin, takes)
        self.used += takes
        self._free = begin + takes
        leaves = self._free if self._ahead is None else begin - self._ahead
        if self._timed and leave_at is not None:
            leaves = min(leaves, begin - self._lead)
        self._queue.append((leaves, begin, packet))
        return begin

    @property
    def transmits(self) -> bool:
        """Whether packets may pass."""
        return self._transmits

    def switch(self, *, on: bool) -> None:
        """Let packets pass, or refuse those that wait and all that come."""
        self._transmits = on
        if not on:
            self._holding = True
            self.refused["transmit_off"] += len(self._queue)
            self._queue.clear()

    def due(self, now: float) -> list[tuple[float, T]]:
        """The packets that may leave, in order of arrival, each with the time at which its airtime begins."""
        over: list[tuple[float, T]] = []
        while self._queue and self._queue[0][0] <= now and self._is_clear(now):
            over.append(self._queue.popleft()[1:])
        return over

    def grants(self, now: float) -> int:
        """Credits to give out at ``now``; they are counted as given."""
        given = 0
        while self._may_grant(now):
            self._unused += 1
            given += 1
            if self._composing is not None:
                self._composing.granted(now)
        if given:
            self.held, self._holding = self._holding, False
        return given

    @property
    def free(self) -> float:
        """When the channel is free of all packets that have come and of all but one that were promised, s."""
        return self._free + max(self._unused - 1, 0) * self._airtime

    def next_timeout(self, now: float) -> float | None:
        """When ``due`` or ``grants`` next has something, None if only an arrival can change that."""
        times = [self._queue[0][0]] if self._queue else []
        granted = self._next_grant(now)
        if granted is not None and (self._free > now + self._taken_ahead or self.limit is not None):
            times.append(max(now, granted))
        return min(times) if times else None

    @property
    def first_due(self) -> float | None:
        """When the first queued packet may leave, None if none is queued."""
        return self._queue[0][0] if self._queue else None

    @property
    def backlog(self) -> int:
        """Packets that have not left."""
        return len(self._queue)

    @property
    def _outstanding(self) -> int:
        return len(self._queue) + self._unused

    def _is_clear(self, now: float) -> bool:
        """Whether the first packet may leave; if not, all packets are put off."""
        wait = 0.0
        if self._ready is not None and not self._ready():
            wait, self._holding = READY_S, True
        elif self._listens is not None and (wait := self._listens()) > 0:
            self.deferred += 1
        if wait > 0:
            later = now + wait - self._queue[0][0]
            self._queue = deque((leaves + later, begin + later, packet) for leaves, begin, packet in self._queue)
            self._free += later
            if self.limit is not None:
                self.limit.put_off(later)
        return wait <= 0

    def _may_grant(self, now: float) -> bool:
        at = self._next_grant(now)
        if at is None or self.limit is None:
            return at is not None and at <= now
        allowed = at <= now and self.limit.reserve(now, self._airtime)
        self._holding |= not allowed and self._promised_until(now) - self._grant_lead <= now
        return allowed

    def _next_grant(self, now: float) -> float | None:
        """When the next credit may be granted, None if only an arrival or the switch can change that."""
        if self._outstanding >= self._most or not self._transmits:
            return None
        begin = self._promised_until(now)
        if self.limit is None:
            return begin - self._grant_lead
        if self._unused:
            return None  # what the limit says of the packet after it is known when that one has come
        return max(self.limit.earliest(begin, self._airtime) - self._grant_lead, self.limit.again(now) or now)

    @property
    def _grant_lead(self) -> float:
        lead = self._lead if self._composing is None else self._composing.longest
        return lead + self._taken_ahead

    @property
    def _taken_ahead(self) -> float:
        return self._ahead or 0.0

    def _promised_until(self, now: float) -> float:
        return max(now + self._taken_ahead, self._free) + self._unused * self._airtime
