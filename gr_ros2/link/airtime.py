"""When each packet occupies the channel: one after the other, each for its airtime; and when to ask for the next.

Invariants: a packet starts at the later of its arrival and the end of the packet before; a packet leaves when its
airtime is over, or ``ahead`` before it begins, never earlier; idle time is not saved up; a credit is granted no earlier
than ``lead`` before the channel is free of all queued and all promised packets (a promised packet is an unused credit,
counted as a longest packet), and only while there are fewer than ``OUTSTANDING`` of them. There is no IO and no clock:
``now`` is seconds, monotonic.
"""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

from gr_ros2.core.errors import ConfigError

T = TypeVar("T")

LEAD_S = 0.005
"""s before the channel is free; a source needs this time to compose and hand over the next packet."""
OUTSTANDING = 2
"""Most packets queued or granted: one being sent and one waiting behind it. Later packets are not composed yet."""


class AirtimeClock(Generic[T]):
    """A queue that lets packets through at the rate of the channel.

    :param airtime: s that a packet occupies, gap included; the longest if they differ; 0 if packets take no time
    :param lead: s before the channel is free at which the next packet is requested
    :param ahead: s before the begin of its airtime at which a packet leaves, if a device then spends that time; None:
        a packet leaves when its airtime is over, because the following stages take no time
    :raises ConfigError: for a negative airtime, lead or ahead
    """

    def __init__(self, airtime: float, lead: float = LEAD_S, ahead: float | None = None) -> None:
        if not airtime >= 0:
            raise ConfigError(f"airtime = {airtime} s: must be 0 or more")
        if not lead >= 0:
            raise ConfigError(f"lead = {lead} s: must be 0 or more")
        if ahead is not None and not ahead >= 0:
            raise ConfigError(f"ahead = {ahead} s: must be 0 or more")
        self._airtime = airtime
        self._lead = lead
        self._ahead = ahead
        self._free = float("-inf")
        self._queue: deque[tuple[float, T]] = deque()
        self._unused = 0

    def offer(self, packet: T, now: float, airtime: float | None = None) -> float:
        """A packet arrives; it uses a credit if one is open.

        :param airtime: s that it occupies, None for the airtime of the longest packet
        :return: when its airtime begins
        """
        begin = max(now, self._free)
        self._free = begin + (self._airtime if airtime is None else airtime)
        self._queue.append((self._free if self._ahead is None else begin - self._ahead, packet))
        self._unused = max(0, self._unused - 1)
        return begin

    def due(self, now: float) -> list[T]:
        """The packets that may leave, in order of arrival."""
        over: list[T] = []
        while self._queue and self._queue[0][0] <= now:
            over.append(self._queue.popleft()[1])
        return over

    def grants(self, now: float) -> int:
        """Credits to give out at ``now``; they are counted as given."""
        given = 0
        while self._may_grant(now):
            self._unused += 1
            given += 1
        return given

    def next_timeout(self, now: float) -> float | None:
        """When ``due`` or ``grants`` next has something, None if only an arrival can change that."""
        times = [self._queue[0][0]] if self._queue else []
        if self._free > now and self._outstanding < OUTSTANDING:
            times.append(max(now, self._promised_until(now) - self._lead))
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

    def _may_grant(self, now: float) -> bool:
        return self._outstanding < OUTSTANDING and self._promised_until(now) - self._lead <= now

    def _promised_until(self, now: float) -> float:
        return max(now, self._free) + self._unused * self._airtime
