"""Bursts as transmitting devices want them: padded, at the right level, their length told by a tag; and a deaf receiver
meanwhile, where the device needs it.

Invariants: every burst has the same length, so where one begins and ends is arithmetic on sample numbers, never a tag
from upstream; a burst leaves as soon as its last sample is in; what follows the last sample are zeros, never the next
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
"""On a burst's first sample: how many it has. With ``tx_sob`` and ``tx_eob`` instead ``uhd.usrp_sink`` would begin one
of its own when it starts, which can damage the first two of ours (gnuradio#1944)."""
_LENGTH = pmt.intern(LENGTH_TAG)
_REMEMBERED = 64
"""Bursts whose times are kept: more than a receiver can be behind."""

Samples = NDArray[np.complex64]


@dataclass(frozen=True)
class BurstLayout:
    """One packet's burst, in samples.

    :param samples: what the transmitter gives, above 0
    :param lead: zeros before it, while the amplifier settles
    :param tail: zeros behind it at least, to push the last sample out of filters and buffers
    :param multiple: the whole is a multiple of this, so that no device waits for the rest of a transfer
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
    """A transmitter's samples in, whole bursts out, tagged with their length.

    A sample beyond full scale, which a converter would turn into its opposite, is brought back to it and counted.

    :param layout: of a burst
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
        """Samples that were beyond full scale."""
        self._sending: deque[tuple[float, float]] = deque(maxlen=_REMEMBERED)
        self._lock = threading.Lock()
        self.set_tag_propagation_policy(gr.TPP_DONT)
        self.set_output_multiple(layout.total)

    def sent(self, begin: float, end: float) -> list[tuple[float, float]]:
        """From when to when bursts were on the air, s of the clock, as far as they touch an interval."""
        with self._lock:
            return [times for times in self._sending if times[0] <= end and begin <= times[1]]

    def forecast(self, noutput_items: int, ninputs: int) -> list[int]:
        # Whole bursts only: a device that has begun one must not wait for the rest.
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
        """Remember when these bursts are on the air: now, or behind those before them."""
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
    """Samples in and out; zeros for those that came while we sent, and for ``after`` s beyond.

    A sample's time is when it gets here, so ``after`` has to cover what it takes from the antenna to this place.

    :param sent: when we were sending, as :meth:`BurstShaper.sent`
    :param after: s
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
        """Samples made zero."""
        self.set_tag_propagation_policy(gr.TPP_DONT)

    def work(self, input_items: list[Samples], output_items: list[Samples]) -> int:
        out = output_items[0]
        out[:] = input_items[0][: len(out)]
        first = self._clock() - len(out) / self._sample_rate
        for begin, end in self._sent(first - self._after, self._clock()):
            # Rounded outwards: a sample that is half ours is ours.
            low = max(0, floor((begin - first) * self._sample_rate))
            high = min(len(out), ceil((end + self._after - first) * self._sample_rate))
            out[low:high] = 0
            self.blanked += max(0, high - low)
        return len(out)
