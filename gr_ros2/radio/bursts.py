"""Bursts in the form that transmitting devices need: padded, at the right level, with their length in a tag. For
devices that need it, samples received during a burst are blanked.

Invariants: bursts follow each other without a sample between them. If they all have the same length, their begins
follow from sample numbers alone; otherwise each begins with a tag that tells its length. A burst leaves as soon as its
last sample has arrived. Zeros follow the last sample, never the next burst.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, floor
from typing import Any, NamedTuple

import numpy as np
import pmt
from gnuradio import gr
from numpy.typing import NDArray

from gr_ros2.phy.base import LENGTH_TAG
from gr_ros2.phy.stream_times import BURST_TIME, TX_TIME, seconds_of, whole_and_rest
from gr_ros2.phy.threads import KeepsThreadState

_LENGTH = pmt.intern(LENGTH_TAG)
_PLACES = 256
"""Blanked places that are remembered for a block behind, which is some buffers late at most."""
_REMEMBERED = 64
"""Number of bursts whose times are kept. A receiver is never that many bursts behind."""

Samples = NDArray[np.complex64]


class Burst(NamedTuple):
    """The samples of one packet.

    :param at: s, monotonic, when it begins; None where nothing says so
    :param leave_at: s, when it has to begin, on the clock of the tag; None for as soon as possible
    """

    samples: Samples
    at: float | None = None
    leave_at: float | None = None


class BurstCutter:
    """Cuts the input of a block into whole bursts, also where they arrive in parts.

    :param longest: samples of the longest burst
    :param tagged: whether each burst begins with a tag :data:`LENGTH_TAG`; if not, all are as long as the longest
    """

    def __init__(self, longest: int, tagged: bool) -> None:
        self._longest, self._tagged = longest, tagged
        self._parts: list[Samples] = []
        self._missing = 0
        self._times: dict[Any, float | None] = {}

    def cut(
        self, block: Any, samples: Samples, fits: Callable[[int], bool] = lambda _: True
    ) -> tuple[list[Burst], int]:
        """Take samples from the start of a block's input.

        :param block: the block, which has one input
        :param samples: all samples of the input
        :param fits: whether one more burst of that many samples may end now; asked once for each burst. The last
            samples of a burst that does not fit are not taken
        :return: the bursts that are complete, and the number of samples taken
        """
        bursts: list[Burst] = []
        taken = 0
        while taken < len(samples):
            if not self._missing:
                self._missing = self._begin(block, taken)
            part = samples[taken : taken + self._missing]
            held = sum(map(len, self._parts))
            if len(part) == self._missing:
                if not fits(held + len(part)):
                    break
                times = self._times
                bursts.append(Burst(np.concatenate([*self._parts, part]), times.get(BURST_TIME), times.get(TX_TIME)))
                self._parts = []
            else:
                self._parts.append(part.copy())
            taken += len(part)
            self._missing -= len(part)
        return bursts, taken

    def _begin(self, block: Any, at: int) -> int:
        """Samples of the burst that begins at a sample of the input; notes its times."""
        first = block.nitems_read(0) + at
        tags = {tag.key: tag.value for tag in block.get_tags_in_range(0, first, first + 1)}
        self._times = {key: seconds_of(tags[key]) for key in (BURST_TIME, TX_TIME) if key in tags}
        return int(pmt.to_long(tags[_LENGTH])) if self._tagged else self._longest


@dataclass(frozen=True)
class BurstLayout:
    """How a packet's burst is laid out, in samples.

    :param samples: number of samples from the transmitter for the longest packet, above 0
    :param lead: zeros before the packet, while the amplifier settles
    :param tail: smallest number of zeros behind the packet, to push the last sample out of filters and buffers
    :param multiple: the total length is a multiple of this, so that no device waits for the rest of a transfer
    """

    samples: int
    lead: int = 0
    tail: int = 0
    multiple: int = 1

    @property
    def total(self) -> int:
        """Samples of the longest burst, zeros included."""
        return self.total_of(self.samples)

    def total_of(self, samples: int) -> int:
        """Samples of a burst, zeros included, of which that many come from the transmitter."""
        return -(-(self.lead + samples + self.tail) // self.multiple) * self.multiple


class BurstShaper(KeepsThreadState, gr.basic_block):  # type: ignore[misc]
    """Takes the samples of a transmitter and gives whole bursts, tagged with their length.

    A converter would turn a sample beyond full scale into its opposite. Such a sample is reduced to full scale and
    counted.

    :param layout: layout of the bursts
    :param scale: factor on the samples
    :param tagged: whether bursts differ in length, see :class:`BurstCutter`
    :param sample_rate: samples/s
    :param clock: s, monotonic
    """

    def __init__(
        self,
        layout: BurstLayout,
        scale: float,
        sample_rate: float,
        clock: Callable[[], float] = time.monotonic,
        *,
        tagged: bool = False,
    ) -> None:
        super().__init__("gr_ros2_burst_shaper", [np.complex64], [np.complex64])
        self._layout = layout
        self._scale = np.float32(scale)
        self._cutter = BurstCutter(layout.samples, tagged)
        self._sample_rate = sample_rate
        self._clock = clock
        self.clock_offset: Callable[[], float] | None = None
        """s to add to the device's clock for the machine's; None where the device has no clock, or cannot send by it. A
        burst that has to begin at a time then goes on without one."""
        self.clipped = 0
        """Number of samples that were beyond full scale."""
        self._sending: deque[tuple[float, float]] = deque(maxlen=_REMEMBERED)
        self._lock = threading.Lock()
        self.set_tag_propagation_policy(gr.TPP_DONT)
        self.set_output_multiple(layout.total)  # so that the longest burst always finds room

    def sent(self, begin: float, end: float) -> list[tuple[float, float]]:
        """Begin and end of the bursts on the air that touch an interval, s of the clock."""
        with self._lock:
            return [times for times in self._sending if times[0] <= end and begin <= times[1]]

    def forecast(self, noutput_items: int, ninputs: int) -> list[int]:  # noqa: ARG002 - parts of bursts are held here
        return [1] * ninputs

    def general_work(self, input_items: list[Samples], output_items: list[Samples]) -> int:
        # Whole bursts only: a device that has begun a burst must not wait for the rest of it.
        out, room = output_items[0], len(output_items[0])

        def fits(samples: int) -> bool:
            nonlocal room
            room -= self._layout.total_of(samples)
            return room >= 0

        bursts, taken = self._cutter.cut(self, input_items[0], fits)
        self.consume(0, taken)
        made = 0
        for burst, _, leave_at in bursts:
            total = self._layout.total_of(len(burst))
            begin = made + self._layout.lead
            out[made : made + total] = 0
            out[begin : begin + len(burst)] = self._within_scale(burst * self._scale)
            self.add_item_tag(0, self.nitems_written(0) + made, _LENGTH, pmt.from_long(total))
            if leave_at is not None and self.clock_offset is not None:
                at = leave_at - self._layout.lead / self._sample_rate - self.clock_offset()
                self.add_item_tag(0, self.nitems_written(0) + made, TX_TIME, whole_and_rest(at))
            made += total
            self._note(total, None if self.clock_offset is None else leave_at)
        return made

    def _within_scale(self, samples: Samples) -> Samples:
        beyond = np.abs(samples) > 1
        if beyond.any():
            self.clipped += int(beyond.sum())
            samples[beyond] /= np.abs(samples[beyond])
        return samples

    def _note(self, total: int, leave_at: float | None) -> None:
        """Store when a burst is on the air: now, when it has to leave, or directly after the one before it."""
        with self._lock:
            begin = max(self._clock(), self._sending[-1][1] if self._sending else float("-inf"))
            if leave_at is not None:
                begin = max(begin, leave_at - self._layout.lead / self._sample_rate)
            self._sending.append((begin, begin + total / self._sample_rate))


class Blanker(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Passes samples on. Sets those to zero that arrive while this robot sends, or up to ``after`` s later.

    The time of a sample is its arrival at this block. So ``after`` must cover the delay from the antenna to this block.

    :param sent: returns the times of sending, like :meth:`BurstShaper.sent`
    :param after: time to blank after each burst, s
    :param sample_rate: samples/s
    """

    def __init__(
        self,
        sent: Callable[[float, float], list[tuple[float, float]]],
        after: float,
        sample_rate: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__("gr_ros2_blanker", [np.complex64], [np.complex64])
        self._sent = sent
        self._after = after
        self._sample_rate = sample_rate
        self._clock = clock
        self.blanked = 0
        """Number of samples set to zero."""
        self._passed = 0
        self._places: deque[tuple[int, int]] = deque(maxlen=_PLACES)
        """First of the samples set to zero, and the one behind the last, counted from the start."""

    def blanked_in(self, first: int, end: int) -> list[tuple[int, int]]:
        """Where samples were set to zero, of the newest ones from ``first`` to before ``end``, counted from the
        start. Any thread may ask."""
        return [(low, high) for low, high in tuple(self._places) if low < end and first < high]

    def work(self, input_items: list[Samples], output_items: list[Samples]) -> int:
        out = output_items[0]
        out[:] = input_items[0][: len(out)]
        first = self._clock() - len(out) / self._sample_rate
        for begin, end in self._sent(first - self._after, self._clock()):
            # Rounded outwards: a sample that overlaps a burst only in part is blanked too.
            low = max(0, floor((begin - first) * self._sample_rate))
            high = min(len(out), ceil((end + self._after - first) * self._sample_rate))
            if low < high:
                out[low:high] = 0
                self.blanked += high - low
                place = self._passed + low
                if self._places and self._places[-1][1] == place:
                    place, _ = self._places.pop()
                self._places.append((place, self._passed + high))
        self._passed += len(out)
        return len(out)
