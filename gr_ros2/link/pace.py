"""When packets may leave: the credits of the PHY and the configured rate, the same for every version.

Invariants: time is an argument and never goes back; without a rate and before the first credit or ``use_credit``, every
packet may leave at once.
"""

from __future__ import annotations

from collections import deque
from math import inf

from gr_ros2.link.airtime import LEAD_S
from gr_ros2.settings.fields import AUTO, Auto

_INTERVALS = 15
"""Number of packet intervals whose median estimates the interval of credits."""
_ENOUGH, _RECENT_S = 3, 10.0
"""Intervals that must have been measured within so many seconds, or ``_INTERVALS`` of them where these are longer,
before a message is dropped because of them. With one, the pause of a busy computer stopped the commands of a link for
good: what was dropped measured nothing better."""


class Pace:
    """The pace of one sending half.

    :param packet_rate: see :class:`gr_ros2.settings.robot.RobotConfig`
    :ivar known: whether the slots are known (from a rate or from credits), so that an idle slot can be noticed
    """

    def __init__(self, packet_rate: float | Auto) -> None:
        self._credits: int | None = None
        self._busy_since = inf
        """When the last packet left, if another was waiting for a credit then."""
        self._credited = -inf
        """When a credit came for which a packet was waiting."""
        self._steady = False
        """Whether the last packet left as soon as its credit came, so that the PHY is busy without a pause."""
        self._rough = True
        """Whether no interval of a PHY that was busy without a pause has been measured."""
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        self._measured: deque[float] = deque([-inf] * _ENOUGH, maxlen=_ENOUGH)
        """When the last intervals were measured."""
        self._median = 0.0
        self._free = -inf
        self._since = inf
        """Since when the air is free for what the newest credit asks for; infinite if that is not known."""
        self.change(packet_rate)

    def change(self, packet_rate: float | Auto) -> None:
        """Set the rate. The next packet need not wait for the old one."""
        self._unpaced = packet_rate == 0
        self._rate = 0.0 if packet_rate == AUTO else packet_rate
        self.known = self._rate > 0 or (self._credits is not None and not self._unpaced)
        self.slot = -inf
        """Earliest time at which the rate lets a packet leave."""

    def use_credit(self) -> None:
        """From now on, a packet leaves only when there is a credit, unless every packet leaves at once (rate 0)."""
        if self._credits is None:
            self._credits = 0
            self.known = not self._unpaced

    def credit(self, packets: int = 1, since: float | None = None) -> None:
        """The PHY can take this many further packets; the first call does what ``use_credit`` does.

        :param since: s, since when the air is free for them; None if that is not known. Infinite: they were held back
            until now, by a limit of airtime or its switch. The time since the last packet left then is not the interval
            of the PHY, and a message must not be dropped as if it were
        """
        self._since = inf if since is None else since
        if since == inf:
            self._busy_since = inf
        self._credits = (self._credits or 0) + (0 if self._unpaced else packets)
        self.known = not self._unpaced

    @property
    def ready(self) -> float:
        """s, since when a packet could have left; infinite if that is not known."""
        return self._since if self._since > self.slot else self.slot

    @property
    def credits(self) -> int | None:
        """For how many packets there are credits; None where none are needed."""
        return None if self._unpaced else self._credits

    def left_with(self, packets: int) -> None:
        """There are credits for so many packets now, since another endpoint has used some of those that both had."""
        self._credits = packets

    @property
    def credited(self) -> bool:
        """Whether there is a credit for a packet."""
        return bool(self._credits)

    @property
    def out_of_credit(self) -> bool:
        """Whether nothing leaves before the next credit, whatever is submitted."""
        return self._credits == 0 and not self._unpaced

    @property
    def interval(self) -> float:
        """s from one packet to the next while the source is busy: from the rate, or measured from the credits.

        0 if neither is known.
        """
        return 1 / self._rate if self._rate else self._median

    @property
    def spacing(self) -> float:
        """s from one packet to the next as the configured rate has it; 0 without one."""
        return 1 / self._rate if self._rate else 0.0

    def sure_interval(self, now: float) -> float:
        """The same, but 0 where it was measured too seldom, or too long ago, to drop a message because of it."""
        recent_s = max(_RECENT_S, _INTERVALS * self._median)
        return self.interval if self._rate or self._measured[0] > now - recent_s else 0.0

    def free(self, now: float) -> float:
        """When the air is free of all packets that have left, as far as it can be estimated; not before ``now``."""
        return now if now > self._free else self._free

    def may_leave(self, now: float) -> bool:
        """Whether a packet may leave. While packets wait for their credits, the interval of the credits is measured."""
        if now < self.slot or (self._credits == 0 and not self._unpaced):
            return False
        if self._busy_since < inf:
            if self._steady and self._rough:
                # The first credits after a pause come earlier by the time that a source needs for composing.
                self._rough = False
                self._intervals.clear()
            if self._steady or self._rough:
                self._intervals.append(now - self._busy_since)
                self._measured.append(now)
                self._median = sorted(self._intervals)[len(self._intervals) // 2]
            self._busy_since = inf
            self._credited = now
            self._free = min(self._free, now + LEAD_S)
        return True

    def left(self, now: float, *, waiting: bool) -> None:
        """A packet left.

        :param waiting: whether more is waiting
        """
        interval = 1 / self._rate if self._rate else self._median
        self._free = (now if now > self._free else self._free) + interval
        if self._credits is not None and not self._unpaced:
            self._credits -= 1
            self._busy_since = now if not self._credits and waiting else inf
            self._steady = now == self._credited
        if self._rate:
            # A slot missed by less than its length is used later, so that a late wake-up does not lower the rate.
            self.slot = max(self.slot, now - interval) + interval
