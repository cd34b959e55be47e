"""Bursts in the form that transmitting devices need: padded, at the right level, with their length in a tag. For
devices that need it, samples received during a burst are blanked.

Invariants: all bursts have the same length. So the begin and end of a burst follow from sample numbers, never from a
tag from upstream. A burst leaves as soon as its last sample has arrived. Zeros follow the last sample, never the next
burst.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, floor

import numpy as np
import pmt
from gnuradio import gr
from numpy.typing import NDArray

from gr_ros2.phy.threads import KeepsThreadState

LENGTH_TAG = "burst_len"
"""Tag on the first sample of a burst: the number of its samples. With ``tx_sob`` and ``tx_eob`` instead,
``uhd.usrp_sink`` would begin a burst of its own at its start. That burst can damage our first two (gnuradio#1944)."""
_LENGTH = pmt.intern(LENGTH_TAG)
_REMEMBERED = 64
"""Number of bursts whose times are kept. A receiver is never that many bursts behind."""

Samples = NDArray[np.complex64]


@dataclass(frozen=True)
class BurstLayout:
    """One packet's burst, in samples.

    :param samples: number of samples from the transmitter, above 0
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
        """Samples of the whole burst."""
        return -(-(self.lead + self.samples + self.tail) // self.multiple) * self.multiple


class BurstShaper(KeepsThreadState, gr.basic_block):  # type: ignore[misc]
    """Takes the samples of a transmitter and gives whole bursts, tagged with their length.

    A converter would turn a sample beyond full scale into its opposite. Such a sample is reduced to full scale and
    counted.

    :param layout: layout of a burst
    :param scale: factor on the samples
    :param sample_rate: samples/s
    :param clock: s, monotonic
    """

    def __init__(
        self,
        layout: BurstLayout,
        scale: float,
        sample_rate: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__("gr_ros2_burst_shaper", [np.complex64], [np.complex64])
        self._layout = layout
        self._scale = np.float32(scale)
        self._burst_s = layout.total / sample_rate
        self._clock = clock
        self.clipped = 0
        """Number of samples that were beyond full scale."""
        self._sending: deque[tuple[float, float]] = deque(maxlen=_REMEMBERED)
        self._lock = threading.Lock()
        self.set_tag_propagation_policy(gr.TPP_DONT)
        self.set_output_multiple(layout.total)

    def sent(self, begin: float, end: float) -> list[tuple[float, float]]:
        """Begin and end of the bursts on the air that touch an interval, s of the clock."""
        with self._lock:
            return [times for times in self._sending if times[0] <= end and begin <= times[1]]

    def forecast(self, noutput_items: int, ninputs: int) -> list[int]:
        # Whole bursts only: a device that has begun a burst must not wait for the rest of it.
        return [noutput_items // self._layout.total * self._layout.samples] * ninputs

    def general_work(self, input_items: list[Samples], output_items: list[Samples]) -> int:
        layout = self._layout
        bursts = min(len(input_items[0]) // layout.samples, len(output_items[0]) // layout.total)
        packets = input_items[0][: bursts * layout.samples].reshape(bursts, layout.samples)
        shaped = output_items[0][: bursts * layout.total].reshape(bursts, layout.total)
        shaped[:] = 0
        shaped[:, layout.lead : layout.lead + layout.samples] = self._within_scale(packets * self._scale)
        self.consume(0, packets.size)
        self._note(bursts)
        return self._tagged(bursts)

    def _within_scale(self, samples: Samples) -> Samples:
        beyond = np.abs(samples) > 1
        if beyond.any():
            self.clipped += int(beyond.sum())
            samples[beyond] /= np.abs(samples[beyond])
        return samples

    def _note(self, bursts: int) -> None:
        """Store when these bursts are on the air: now, or directly after the bursts before them."""
        with self._lock:
            for _ in range(bursts):
                begin = max(self._clock(), self._sending[-1][1] if self._sending else float("-inf"))
                self._sending.append((begin, begin + self._burst_s))

    def _tagged(self, bursts: int) -> int:
        total = self._layout.total
        for burst in range(bursts):
            self.add_item_tag(0, self.nitems_written(0) + burst * total, _LENGTH, pmt.from_long(total))
        return bursts * total


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
        self.set_tag_propagation_policy(gr.TPP_DONT)

    def work(self, input_items: list[Samples], output_items: list[Samples]) -> int:
        out = output_items[0]
        out[:] = input_items[0][: len(out)]
        first = self._clock() - len(out) / self._sample_rate
        for begin, end in self._sent(first - self._after, self._clock()):
            # Rounded outwards: a sample that overlaps a burst only in part is blanked too.
            low = max(0, floor((begin - first) * self._sample_rate))
            high = min(len(out), ceil((end + self._after - first) * self._sample_rate))
            out[low:high] = 0
            self.blanked += max(0, high - low)
        return len(out)
