"""Common parts of every device that turns samples into waves: whole bursts at their time, and a watch over its streams.

Invariants: a device gets its samples at the time of transmission, in whole bursts, and no sample is beyond full scale.
A device that stops giving or taking samples becomes one line that names front end, device and remedy.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from math import inf, sqrt
from typing import Annotated, Any, ClassVar

import numpy as np
from gnuradio import gr
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import RadioError
from gr_ros2.core.watch import Watch
from gr_ros2.phy import Phy
from gr_ros2.phy.threads import KeepsThreadState
from gr_ros2.radio.bursts import Blanker, BurstLayout, BurstShaper
from gr_ros2.radio.front_end import FrontEnd, FrontEndCounters, SharedAir
from gr_ros2.radio.stream_events import BURSTS_OUT, GapCounter
from gr_ros2.settings.config import STRICT, Seconds

SILENT_S = 3.0
"""A device without a sample given or taken for this time, s, counts as dead; a change of direction takes a tenth."""
_TIMED_S = 0.001
"""``timing_error_s`` of a device that tags what it receives with the time, and sends at a time."""
_FOLLOWED_S = 1.0
"""s after which the clock of a device is compared with the machine's again: 50 ppm make 50 us of it."""
_LEAD_S = 0.002
"""How long before its airtime begins a device gets a packet, s, so that packets follow each other without a pause. If
there must be a pause, the device gets the packet when the pause is over."""
STANDS_OUT = 4.0
"""Power over that of the noise from which on something is a signal: 6 dB."""
_CHUNK = 256
"""Samples whose mean power is compared: of noise, it is above ``STANDS_OUT`` less than once in 10^100."""
DOUBLES_S = 5.0
"""s in which the noise's estimate doubles at most. It follows a smaller power at once, so it is the lowest power of
late. A carrier 20 dB above the noise counts as a signal for 23 s and then as noise: whoever listens before sending does
not fall silent for ever."""

_SILENCE = 2 * STANDS_OUT
"""Samples that are all zero are silence, so many times below the weakest power that came. Twice as much would still
be a signal; noise that begins after zeros, as a driver may give at its start, counts as one for ``DOUBLES_S`` only."""
_WEAKEST = 1e-8
"""Power over the greatest one below which nothing is a signal: the edges of a burst beside zeros. After such an edge,
noise counted as a signal for minutes."""


class EnergyCounter(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Counts signals that stand out of the noise in received samples, whether or not there is a packet in them.

    :param sample_rate: samples/s
    :param blanked_in: returns where samples were set to zero from one sample to before another, counted from the start;
        these are neither noise nor silence. None: nowhere
    :ivar bursts: how often the power rose above the noise
    """

    def __init__(
        self, sample_rate: float, blanked_in: Callable[[int, int], Sequence[tuple[int, int]]] | None = None
    ) -> None:
        super().__init__("gr_ros2_energy_counter", [np.complex64], None)
        self.set_output_multiple(_CHUNK)
        self.bursts = 0
        self._rise = 2 ** (_CHUNK / (sample_rate * DOUBLES_S))
        self._blanked_in = blanked_in
        self._noise = self._weakest = inf
        """Power of the noise, and the least power of a chunk that is not zero; infinite while it is not known."""
        self._strongest = 0.0
        self._silent = False
        """Whether zeros came before anything else."""
        self._above = False

    def is_above(self) -> bool:
        """Whether the newest samples are above the noise."""
        return self._above

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        whole = len(input_items[0]) // _CHUNK * _CHUNK
        if not whole:
            return len(input_items[0])
        parts = input_items[0][:whole].view(np.float32).reshape(-1, 2 * _CHUNK)
        power = np.einsum("ij,ij->i", parts, parts)
        heard = np.isfinite(power)
        if self._blanked_in is not None:
            first = self.nitems_read(0)
            for low, high in self._blanked_in(first, first + whole):
                heard[max(low - first, 0) // _CHUNK : (high - first - 1) // _CHUNK + 1] = False
        power = power[heard]
        known = self._weakest < inf
        self._weakest = min(self._weakest, power[power > 0].min(initial=inf))
        self._strongest = max(self._strongest, power.max(initial=0.0))
        silence = max(self._weakest, _WEAKEST * self._strongest) / _SILENCE
        before = silence if self._silent and not known else max(self._noise, silence)
        self._silent |= not power.all()
        power = np.maximum(power, silence)
        steps = self._rise ** np.arange(1, len(power) + 1)
        # The lowest power so far, each one grown since: noise[n] = min(power[k] * rise^(n - k), k <= n).
        noise = steps * np.minimum.accumulate(np.minimum(power / steps, before))
        above = power > STANDS_OUT * noise  # False while nothing but zeros came
        if len(power):
            self.bursts += int(np.count_nonzero(above[1:] & ~above[:-1])) + bool(above[0] and not self._above)
            self._above, self._noise = bool(above[-1]), float(noise[-1])
        return whole


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BurstDeviceOptions(SharedAir):
    """What every device takes."""

    level: Annotated[float, Field(gt=0, le=1, title="Burst level (share of full scale)")] = 0.1
    """root mean square of a burst's samples, 1 = full scale; OFDM peaks 12 dB above it, unscrambled 17"""
    turnaround_s: Annotated[Seconds, Field(title="Turn-around time (s)")] = 0.005
    """s, with `half_duplex`, from the end of a burst until the device hears again; nothing is sent in it"""

    def layout(self, samples: int, sample_rate: float) -> BurstLayout:
        """How a burst of so many samples from the transmitter is laid out."""
        raise NotImplementedError

    @property
    def silence_s(self) -> float:
        """How long nothing is sent after each burst, s."""
        return self.guard_s + (self.turnaround_s if self.half_duplex else 0.0)


class BurstFrontEnd(FrontEnd):
    """A device. A subclass opens its transmitter and its receiver, and sets both up completely.

    :raises RadioError: when there is no such device, or it refuses a setting
    """

    Options: ClassVar[type[BurstDeviceOptions]] = BurstDeviceOptions
    has_radio = True
    may_return = True
    any_length = True
    timed_error_s: ClassVar[float] = _TIMED_S
    """``timing_error_s`` where the device has a clock."""

    def __init__(self, phy: Phy, **options: Any) -> None:
        super().__init__(phy, **options)
        chosen = self.options
        self.layout = chosen.layout(phy.airtime_samples(), phy.sample_rate)
        scale = chosen.level / sqrt(phy.burst_power())
        self._shaper = BurstShaper(self.layout, scale, phy.sample_rate, tagged=phy.any_length)
        self._blanker: Blanker | None = None
        if chosen.half_duplex and self.transmits:
            self._blanker = self._make_blanker()
        blanked_in = None if self._blanker is None else self._blanker.blanked_in
        self._gaps, self._energy = GapCounter(), EnergyCounter(phy.sample_rate, blanked_in)
        self._given, self._taken = Watch(), Watch()
        self._transmitting: Any = None
        self._receiving: Any = None
        self._offset: float | None = None
        self._offset_at = 0.0
        self._open()

    def _make_blanker(self) -> Blanker:
        return Blanker(self._shaper.sent, self.options.turnaround_s, self.phy.sample_rate)

    def _open(self) -> None:
        """Open both, or neither."""
        try:
            if self.transmits:
                self._transmitting = self._open_transmitter()
            self._receiving = self._open_receiver()
            self._follow_clock()
        except BaseException:
            self.close()
            raise

    @abstractmethod
    def _open_transmitter(self) -> Any:
        """The block that sends, ready to run."""

    @abstractmethod
    def _open_receiver(self) -> Any:
        """The block that receives, ready to run."""

    def _device_time(self) -> float | None:
        """s of the device's clock now, by which it sends and tags; None if it has none."""
        return None

    def _follow_clock(self) -> None:
        """Compare the clock of the device with the machine's."""
        before = time.monotonic()
        at = self._device_time()
        after = time.monotonic()
        if at is not None:
            self._offset, self._offset_at = (before + after) / 2 - at, after
            self.timing_error_s, self._shaper.clock_offset = self.timed_error_s, self._device_offset

    def _device_offset(self) -> float:
        assert self._offset is not None
        return self._offset

    @property
    def clock_offset(self) -> Callable[[], float] | None:
        return None if self._offset is None else self._device_offset

    @property
    def sink(self) -> Any:
        return self._shaper if self.transmits else None

    @property
    def source(self) -> Any:
        return self._blanker or self._receiving

    def wire(self, graph: Any) -> None:
        if self.transmits:
            graph.connect(self._shaper, self._transmitting)
        graph.connect(self._receiving, self._gaps)
        if self._blanker is not None:
            graph.connect(self._receiving, self._blanker)
        graph.connect(self.source, self._energy)

    @property
    def busy(self) -> Callable[[], bool] | None:
        return self._energy.is_above if self._blanker is not None and self._hears_where_it_sends() else None

    def _hears_where_it_sends(self) -> bool:
        """Whether it receives at the frequency at which it sends."""
        return True

    @classmethod
    def airtime_with(cls, phy: Phy, chosen: Any, packet_len: int | None = None, mcs: int = 0) -> float:
        samples = phy.on_mcs(mcs).airtime_samples(packet_len)
        return float(chosen.layout(samples, phy.sample_rate).total / phy.sample_rate + chosen.silence_s)

    def ahead(self) -> float:
        return 0.0 if self.options.silence_s else _LEAD_S

    def check(self, now: float) -> None:
        if self._offset is not None and now - self._offset_at > _FOLLOWED_S:
            self._follow_clock()
        if self._given.still_s(self._gaps.nitems_read(0), now) > SILENT_S:
            raise self._dead("no samples")
        if self._transmitting is None:
            return
        if self._taken.still_s(self._sent(), now) > SILENT_S + self.layout.total / self.phy.sample_rate:
            raise self._dead("a burst to send was not taken")

    def _sent(self) -> object:
        """What changes while the device takes what it is given; None where nothing waits."""
        taken = self._transmitting.nitems_read(0)
        return taken if taken < self._shaper.nitems_written(0) else None

    def _dead(self, symptom: str) -> RadioError:
        return RadioError(
            f"front_end {self.name}: {self._device_said()}: {symptom} for {SILENT_S:g} s; was the device unplugged, or "
            "is the machine too slow for phy.sample_rate?"
        )

    @abstractmethod
    def _device_said(self) -> str:
        """The setting that chooses the device, for errors."""

    def counters(self) -> FrontEndCounters:
        """Losses, and what the device reports about them.

        ``clipped``: samples beyond full scale. ``blanked``: samples not received because this robot was sending.
        ``overflows``: places where received samples were lost before they came here. ``energy``: signals above the
        noise, with or without a packet in them. Those of
        :meth:`_device_counters` are added.
        """
        counted = self._device_counters()
        passed = {BURSTS_OUT: counted.pop(BURSTS_OUT)} if BURSTS_OUT in counted else {}
        passed["energy"] = self._energy.bursts
        if self._blanker is not None:
            passed["blanked"] = self._blanker.blanked
        overflows = {} if self._gaps.gaps is None else {"overflows": self._gaps.gaps}
        return FrontEndCounters(passed, {"clipped": self._shaper.clipped, **overflows, **counted})

    def _device_counters(self) -> dict[str, int]:
        """Counters of the bursts after the shaper, by name; those sent completely are ``BURSTS_OUT``."""
        return {}

    def close(self) -> None:
        # The device is released when nothing refers to its blocks.
        self._transmitting = self._receiving = None
