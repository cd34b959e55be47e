"""When the newest message of a topic is coded, and into how many bytes: as late as possible, and as the air has room.

The newest message waits as it is. When the frame before will have left, it is coded into what is free until the next
wanted message has come (encoding on pull: Fouladi et al., *Salsify*, NSDI 2018). A message that is not coded breaks
nothing. Frames form a chain that is sent in order and repaired until it is confirmed (:mod:`gr_ros2.link.frames`).

Invariants: sans-IO, as the engines of a link: ``now`` is an argument (s, monotonic) and never goes back; at most one
frame is being coded; while each robot that reports has lacked one for ``PATIENCE_S`` none is begun but a key frame,
once a report says that somebody is there; a key frame is asked for at most once in ``KEY_S``; memory is one message,
and of a map the one that was coded, too.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

from gr_ros2.link.frames import FrameState

PATIENCE_S = 0.5
KEY_S = 2.0
REPEAT_S = 10.0
"""s between two frames of a map that does not change, where nobody reports."""
LEAST_BYTES = 36
"""Budget of a frame when less is free. At 32 kbit/s and 20 % loss 15 pictures/s come out, 6 with 60 bytes and without
what the next two allow."""
_EAGER = 2
"""Times the free rate that such frames may take: what is used counts repairs, which leave when nothing else waits."""
_OFTEN_S = 0.1
"""Where the free rate has no room for one in so many s, they take no more than that: odometry that fills 3.5 kbit/s
would be 2.4 times as old as alone."""
_AHEAD = 2 * LEAST_BYTES
"""Bytes that may wait there when the next is coded: both leave in one packet, and the newer one is shown. Where less
than that is free until the next, twice as many may: otherwise a picture in a hundred is left out at 32 kbit/s and 5 %
loss while a repair waits, and one in ten at 20 %."""
PART = 0.85
"""Of what is free, so that a frame that came out long, or a repair, does not delay the next. With .9, pictures at 64
kbit/s are 107 ms old, with .8 101."""
_LATELY = 0.2
"""Weight of the newest period in the mean."""
_FIRST_S = 0.1
"""s until the next message as long as only one has come."""
_STILL = 4
"""Mean periods after which a topic that brings nothing has stopped, so that the gap is no period."""


class Pull(NamedTuple):
    """A message to be coded now.

    :param came: when it came, s
    :param budget: bytes; None where the rate of the channel is not known
    :param key: as a key frame
    """

    message: bytes
    came: float
    budget: int | None
    key: bool


class StatePull:
    """The frames of a topic whose newest message counts, however old it is, such as a map: exactly, and whole for those
    who ask for it. Where nobody reports every frame is whole, and comes again each ``REPEAT_S``.

    :param period_s, coding_s: see :class:`FramePull`
    """

    def __init__(self, *, period_s: float = 0.0, coding_s: float = 0.008) -> None:
        self.period_s, self._coding_s = period_s, coding_s
        self._newest: bytes | None = None
        self._pulled: bytes | None = None
        self._coded: bytes | None = None
        self._came = self._taken = -inf
        self._new = self._coding = False
        self._key = True
        self._asks = 0

    @property
    def newest(self) -> bytes | None:
        """The newest message, as long as it counts."""
        return self._newest

    def offer(self, message: bytes, now: float) -> bool:
        """A message has come. Returns whether it takes the place of one that was not coded."""
        superseded, self._new = self._new, True
        self._newest, self._came = message, now
        return superseded

    def waits(self, now: float, asks: int, reports: bool) -> bool:
        """Whether a message is to be coded as soon as the air allows it: somebody needs it."""
        if asks != self._asks:
            self._key, self._asks = True, asks
        needed = self._new or self._key or (not reports and now >= self._taken + REPEAT_S)
        return needed and self._newest is not None and not self._coding and now >= self._taken + self.period_s

    def pull(self, now: float, progress: FrameState, share: float = 1.0) -> Pull | None:
        """The message to be coded now, if it ``waits``; None if there is none yet. ``done`` has to follow."""
        rate = progress.rate * share
        if self._newest is None or progress.waiting > (rate * self._coding_s if rate < inf else 0):
            return None
        request = Pull(self._newest, self._came, None, self._key or not progress.reports)
        self._new = self._key = False
        self._coding, self._taken, self._pulled = True, now, self._newest
        return request

    def done(self, failed: Pull | None = None) -> None:
        """The message was coded, or could not be; see :class:`FramePull`. Then the one before it counts."""
        self._coding = False
        if failed is None:
            self._coded = self._pulled
            return
        self._key = self._key or failed.key
        if failed.message is self._coded:
            self._coded = None
        if not self._new:
            self._newest = self._coded

    def end(self) -> bool:
        """Code nothing more. Returns whether a message was waiting."""
        waited, self._new, self._newest = self._new, False, None
        return waited


class FramePull:
    """The frames of one topic at its sender.

    :param period_s: s between two frames at least, 0 = each message; may change
    :param coding_s: s that coding takes
    """

    def __init__(self, *, period_s: float = 0.0, coding_s: float = 0.008) -> None:
        self.period_s, self._coding_s = period_s, coding_s
        self._newest: bytes | None = None
        self._came = self._taken = self._keyed = self._due = -inf
        self._period = 0.0
        self._coding = False
        self._key = True
        self._joined = -1

    def offer(self, message: bytes, now: float) -> bool:
        """A message has come. Returns whether it takes the place of one that was not coded."""
        superseded = self._newest is not None
        gap = now - self._came
        if gap < inf and (not self._period or gap < _STILL * self._period):
            self._period = gap if not self._period else self._period + _LATELY * (gap - self._period)
        elif gap < inf:
            self._period = gap
        self._newest, self._came = message, now
        return superseded

    def waits(self, now: float, _asks: int = 0, _reports: bool = True) -> bool:
        """Whether a message waits that may be coded now, if the air and the receivers allow it."""
        return self._newest is not None and not self._coding and now >= self._due - self._period / 2

    def pull(self, now: float, progress: FrameState, share: float = 1.0) -> Pull | None:
        """The message to be coded now, None if there is none yet. ``done`` has to follow.

        :param share: of the free rate that is this topic's
        """
        rate, waiting = progress.rate * share, progress.waiting
        often = LEAST_BYTES / _OFTEN_S < rate < inf
        ahead = _AHEAD * (1 + (PART * rate * self._period < _AHEAD)) if often else 0
        soon = max(rate * self._coding_s if rate < inf else 0, ahead)
        if self._newest is None or not self.waits(now) or waiting > soon:
            return None
        if progress.lacked > PATIENCE_S and (progress.silent or now - self._keyed < KEY_S):
            return None
        if progress.joined != self._joined or progress.behind > PATIENCE_S:
            self._key, self._joined = True, progress.joined
        # Until the message after this one has come, which is a whole number of periods away.
        next_s = max(self._period, self.period_s) or _FIRST_S
        until = max(self._came + next_s - now, next_s / 2)
        budget = None if rate == inf else int(PART * rate * until) - waiting
        if budget is not None and budget < LEAST_BYTES:
            if now - self._taken < LEAST_BYTES / (rate * (_EAGER if often else PART)):
                return None
            budget = LEAST_BYTES
        key = (self._key or not progress.reports) and now - self._keyed >= KEY_S
        if key:
            self._key, self._keyed = False, now
        request = Pull(self._newest, self._came, budget, key)
        self._newest, self._coding, self._taken = None, True, now
        late = now - self._due
        self._due = self.period_s + (self._due if late < self.period_s / 2 else now)  # in the mean no more often
        return request

    def done(self, failed: Pull | None = None) -> None:
        """The message was coded.

        :param failed: what could not be coded
        """
        self._coding = False
        if failed is not None and failed.key:
            self._key, self._keyed = True, -inf

    def end(self) -> bool:
        """Code nothing more. Returns whether a message was waiting."""
        waited, self._newest = self._newest is not None, None
        return waited
