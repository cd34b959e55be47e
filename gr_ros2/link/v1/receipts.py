"""Which of one sender's packets some robot has, or one of those that count, as reports tell."""

from __future__ import annotations

from collections.abc import Callable, Collection

from gr_ros2.wire.control import MAP
from gr_ros2.wire.v1 import SPAN

_MAP, _ALL = (1 << MAP) - 1, (1 << SPAN) - 1


class Receipts:
    """See the module.

    A report also counts a packet as here that its robot does not wait for any more. So the first one that covers a
    packet says whether it has come, unless its robot was told before that it need not wait; otherwise those do that
    come while it is repaired.

    :param robots: those that count; none for any
    :ivar newest: number of the newest packet that any report covers, -1 for none
    """

    def __init__(self, robots: Collection[int] = ()) -> None:
        self._robots = frozenset(robots)
        self.newest = -1
        self._covered = self._came = 0
        """Bit i stands for packet ``newest - i``: a report has covered it; it has come."""

    def report(self, robot: int, number: int, arrived: int, repaired: Callable[[int], bool], told: int) -> None:
        """A robot has reported; see ``Peers.report``.

        :param repaired: whether a packet is still repaired
        :param told: the newest packet of which robots were told whether they need to wait for it
        """
        if self._robots and robot not in self._robots:
            return
        newer = number - self.newest
        if newer > 0:
            self._covered = self._covered << newer & _ALL if newer < SPAN else 0
            self._came = self._came << newer & _ALL if newer < SPAN else 0
            self.newest = number
        older = self.newest - number
        arrived = arrived << older & _ALL & ~self._came
        first = ~self._covered & (1 << max(self.newest - told, 0)) - 1
        self._came |= arrived & first
        late = arrived & ~first
        while late:
            back = late.bit_length() - 1
            late ^= 1 << back
            self._came |= repaired(self.newest - back) << back
        self._covered |= _MAP << older & _ALL

    def have(self, first: int, last: int) -> bool:
        """Whether somebody has each packet from one to another."""
        bits = (1 << last - first + 1) - 1
        return last <= self.newest and self._came >> self.newest - last & bits == bits
