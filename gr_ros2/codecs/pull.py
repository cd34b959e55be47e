"""When the newest message of a topic is coded, and into how many bytes: as late as possible, and as the air has room.

The newest message waits as it is. When the frame before will have left, it is coded into what is free until the next
wanted message has come (encoding on pull: Fouladi et al., *Salsify*, NSDI 2018). A message that is not coded breaks
nothing. Frames form a chain that is sent in order and repaired until it is confirmed.

Invariants: sans-IO, as the engines of a link: ``now`` is an argument (s, monotonic) and never goes back; at most one
frame is being coded; none is begun while one is unconfirmed for ``PATIENCE_S``; a key frame is asked for at most once
in ``KEY_S``; memory is one message and the names of unconfirmed frames, at most ``MOST_UNCONFIRMED``.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from math import inf
from typing import NamedTuple

PATIENCE_S = 0.5
KEY_S = 2.0
WINDOW_S = 2.0
"""s over which the rate that others leave free is a mean."""
LEAST_BYTES = 120
"""Budget of a frame when nothing is free: a picture that is coarse tells more than none."""
MOST_UNCONFIRMED = 64
_LEAST_FREE = 0.1
"""Part of the capacity that a camera may count on; else it would never learn that more is free."""
_FEW_S = 0.3
"""s of a window at least, so that the first packets do not stand for a rate."""
_LATELY = 0.2
"""Weight of the newest period in the mean."""
_FIRST_S = 0.1
"""s until the next message as long as only one has come."""
_STILL = 4
"""Mean periods after which a topic that brings nothing has stopped, so that the gap is no period."""


class FreeRate:
    """The rate that other topics leave free.

    :param capacity: bytes/s that packets carry beside their headers
    """

    def __init__(self, capacity: float) -> None:
        self.capacity = capacity
        self._used: deque[tuple[float, float]] = deque()
        self._sum = 0.0

    def left(self, now: float, others: int) -> None:
        """A packet has left.

        :param others: bytes in it of other topics than the ones that share the free rate, and of their repairs
        """
        self._used.append((now, others))
        self._sum += others
        while self._used[0][0] < now - WINDOW_S:
            self._sum -= self._used.popleft()[1]

    def rate(self, now: float) -> float:
        """bytes/s."""
        if not self._used:
            return self.capacity
        spent = self._sum / max(now - self._used[0][0], _FEW_S)
        return max(_LEAST_FREE * self.capacity, self.capacity - spent)


class Pull(NamedTuple):
    """A message to be coded now.

    :param budget: bytes
    :param key: as a key frame
    """

    message: bytes
    budget: int
    key: bool


class FramePull:
    """The frames of one topic at its sender.

    :param free: what others leave free; topics that share it have a ``share`` of it each
    :param period_s: s between two frames at least, 0 = each message
    :param coding_s: s that coding takes
    :param reports: whether receivers report; if not, key frames come in ``KEY_S`` and nothing waits to be confirmed
    """

    def __init__(
        self,
        free: FreeRate,
        *,
        period_s: float = 0.0,
        coding_s: float = 0.008,
        reports: bool = True,
        share: float = 1.0,
    ) -> None:
        self._free, self._least_s, self._coding_s, self._reports, self._share = free, period_s, coding_s, reports, share
        self._newest: bytes | None = None
        self._came = self._taken = self._keyed = -inf
        self._period = 0.0
        self._coding = False
        self._key = True
        self._unconfirmed: OrderedDict[int, float] = OrderedDict()
        self.superseded = 0
        """Messages that were not coded, since newer ones came."""

    def offer(self, message: bytes, now: float) -> None:
        """A message has come."""
        self.superseded += self._newest is not None
        gap = now - self._came
        if gap < inf and (not self._period or gap < _STILL * self._period):
            self._period = gap if not self._period else self._period + _LATELY * (gap - self._period)
        elif gap < inf:
            self._period = gap
        self._newest, self._came = message, now

    def pull(self, now: float, waiting: int) -> Pull | None:
        """The message to be coded now, None if there is none yet. ``coded`` or ``failed`` has to follow.

        :param waiting: bytes of this topic that have not left
        """
        rate = self._free.rate(now) * self._share
        if self._newest is None or self._coding or waiting > rate * self._coding_s:
            return None
        if now < self._taken + self._least_s - self._period / 2:
            return None
        if self._reports and self._unconfirmed and now - next(iter(self._unconfirmed.values())) > PATIENCE_S:
            return None
        if len(self._unconfirmed) >= MOST_UNCONFIRMED:
            return None
        # Until the message after this one has come, which is a whole number of periods away.
        next_s = max(self._period, self._least_s) or _FIRST_S
        until = max(self._came + next_s - now, next_s / 2)
        budget = max(LEAST_BYTES, int(rate * until) - waiting)
        key = (self._key or not self._reports) and now - self._keyed >= KEY_S
        if key:
            self._key, self._keyed = False, now
        request = Pull(self._newest, budget, key)
        self._newest, self._coding, self._taken = None, True, now
        return request

    def coded(self, name: int, now: float) -> None:
        """The message was coded as the frame of this name, which is sent now."""
        self._coding = False
        if self._reports:
            self._unconfirmed[name] = now

    def failed(self) -> None:
        """The message could not be coded."""
        self._coding = False

    def confirmed(self, name: int) -> None:
        """All receivers that report have the frame."""
        self._unconfirmed.pop(name, None)

    def broken(self) -> None:
        """A frame was given up: what follows it cannot be decoded."""
        self._unconfirmed.clear()
        self._key = True

    def joined(self) -> None:
        """A receiver has come that has no frame, or has come back."""
        self._key = True

    def silent(self) -> None:
        """No receiver reports any more: nothing waits for them. Who returns is ``joined``."""
        self._unconfirmed.clear()
