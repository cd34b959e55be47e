"""When the samples of a stream were on the air, on the machine's monotonic clock.

A tag on the stream tells it: ``rx_time`` of a device, as GNU Radio's sources set it, on the device's clock; or
``BURST_TIME`` of this package's blocks, on the machine's clock, at the first sample of a burst whose samples come
faster than the air would carry them. Without a tag, a burst ended when its last sample arrived, so the time is late by
what samples take to get here.

Invariants: the newest tag at or before a burst counts; the last arrivals are kept, and no more.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import pmt

BURST_TIME = pmt.intern("burst_time")
"""Tag at the first sample of a burst: s on the machine's monotonic clock at which it begins or began."""
TX_TIME, RX_TIME = pmt.intern("tx_time"), pmt.intern("rx_time")
"""The tags of GNU Radio's blocks for devices: a tuple of whole s and the rest."""
_KEPT = 512


def whole_and_rest(seconds: float) -> Any:
    """A time in s as GNU Radio's blocks for devices write it."""
    whole = int(seconds // 1)
    return pmt.make_tuple(pmt.from_uint64(whole), pmt.from_double(seconds - whole))


def seconds_of(value: Any) -> float | None:
    """The time in s of a tag, in either form; None if it has none of them."""
    if pmt.is_tuple(value) and pmt.length(value) == 2:
        whole, rest = pmt.tuple_ref(value, 0), pmt.tuple_ref(value, 1)
        return float(pmt.to_uint64(whole)) + float(pmt.to_double(rest)) if pmt.is_uint64(whole) else None
    return float(pmt.to_double(value)) if pmt.is_real(value) else None


class StreamTimes:
    """The times of the samples of a stream. Any thread may ask.

    :param sample_rate: samples/s
    :param clock: s, monotonic
    :ivar offset: returns s to add to ``rx_time`` for the time of ``clock``; None: such tags tell nothing, because a
        device without a clock may count from anywhere
    """

    def __init__(self, sample_rate: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._clock = sample_rate, clock
        self.offset: Callable[[], float] | None = None
        self._arrived: deque[tuple[int, float]] = deque(maxlen=_KEPT)
        self._tags: deque[tuple[int, float, bool]] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

    def begins(self, place: int, seconds: float) -> None:
        """A burst begins or began at a sample, counted from the start, and at a time of ``clock``."""
        with self._lock:
            self._tags.append((place, seconds, False))

    def arrived(self, count: int, tags: Iterable[Any] = ()) -> None:
        """So many samples have arrived since the start, the last of them now, and these tags with them."""
        with self._lock:
            self._arrived.append((count, self._clock()))
            for tag in tags:
                of_device = tag.key == RX_TIME
                known = self.offset is not None if of_device else tag.key == BURST_TIME
                seconds = seconds_of(tag.value) if known else None
                if seconds is not None:
                    self._tags.append((tag.offset, seconds, of_device))

    def at(self, first: int, end: int, slack: int) -> float:
        """s, when the sample ``first`` was on the air, the first of a burst whose last one is before ``end``.

        :param slack: samples by which ``first`` may be too early
        """
        with self._lock:
            for place, seconds, of_device in reversed(self._tags):
                if place <= first + slack:
                    told = seconds + (first - place) / self._rate
                    return told + self.offset() if of_device and self.offset is not None else told
            count, now = self._arrived[-1]
            for earlier in reversed(self._arrived):
                if earlier[0] < end:
                    break
                count, now = earlier
        return now - (count - first) / self._rate
