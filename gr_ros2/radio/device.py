"""Common parts of all radios: frequencies, gains, antennas, and a transmitter that works in bursts.

Invariants: a device gets its samples at the time of transmission, in whole bursts, and no sample is beyond full scale.
Errors of a vendor's library become one line that names front end, args and remedy. The same holds for a device that
stops giving or taking samples.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import sqrt
from typing import Annotated, Any, ClassVar

from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import RadioError
from gr_ros2.core.watch import Watch
from gr_ros2.phy import Phy
from gr_ros2.radio.bursts import Blanker, BurstLayout, BurstShaper
from gr_ros2.radio.device_checks import DeviceChecks
from gr_ros2.radio.energy import EnergyCounter
from gr_ros2.radio.front_end import FrontEnd, FrontEndCounters, Hertz, SharedAir
from gr_ros2.radio.stream_events import BURSTS_OUT, GapCounter
from gr_ros2.settings.config import STRICT, Seconds, Text, build
from gr_ros2.settings.fields import AUTO, Auto

SILENT_S = 3.0
"""A device without a sample given or taken for this time, s, counts as dead; a change of direction takes a tenth."""
_MOST_ZEROS = 1 << 20
"""Samples."""
_TIMED_S = 0.001
"""``timing_error_s`` of a device that tags what it receives with the time, and sends at a time."""
_FOLLOWED_S = 1.0
"""s after which the clock of a device is compared with the machine's again: 50 ppm make 50 us of it."""
_LEAD_S = 0.002
"""How long before its airtime begins a device gets a packet, s, so that packets follow each other without a pause. If
there must be a pause, the device gets the packet when the pause is over."""

Decibels = Annotated[float, Field(ge=-200, le=200)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DeviceOptions(SharedAir):
    """Settings of every radio.

    :param args: which device, in the words of its driver; auto takes the first found
    :param frequency: Hz, to send at, and to receive at unless ``frequency_rx`` says otherwise
    :param frequency_rx: Hz, to receive at; auto = ``frequency``
    :param gain_tx: dB, of the transmitter; 0 unless set, so that nothing loud happens unasked
    :param gain_rx: dB, of the receiver
    :param antenna_tx: port to send from, auto = the device's default
    :param antenna_rx: port to receive from, auto = the device's default
    :param bandwidth: Hz, of the analogue filters, auto = the device's choice
    :param level: root mean square of a burst's samples, 1 = full scale of the converter. OFDM has peaks 12 dB above it,
        with ``scramble: false`` even 17 dB
    :param lead: zero samples before each burst, while the amplifier settles
    :param tail: zero samples behind each burst at least
    :param multiple: samples a burst is filled up to a multiple of, for drivers that send whole transfers only
    :param turnaround_s: s, with ``half_duplex``: from the end of a burst until the device hears again and what it heard
        of the burst has come through its buffers; nothing is sent in it either
    """

    frequency: Annotated[float, Field(gt=0, le=300e9, title="Frequency (Hz)")]
    args: Annotated[Text, Field(title="Device arguments")] = AUTO
    frequency_rx: Annotated[float, Field(gt=0, le=300e9, title="Receive frequency (Hz)")] | Auto = AUTO
    gain_tx: Annotated[Decibels, Field(title="Transmit gain (dB)")] = 0.0
    gain_rx: Annotated[Decibels, Field(title="Receive gain (dB)")] = 30.0
    antenna_tx: Annotated[Text, Field(title="Transmit antenna")] = AUTO
    antenna_rx: Annotated[Text, Field(title="Receive antenna")] = AUTO
    bandwidth: Annotated[Hertz | Auto, Field(title="Analogue bandwidth (Hz)")] = AUTO
    level: Annotated[float, Field(gt=0, le=1, title="Burst level (share of full scale)")] = 0.1
    lead: Annotated[int, Field(ge=0, le=_MOST_ZEROS, title="Zeros before a burst (samples)")] = 32
    tail: Annotated[int, Field(ge=0, le=_MOST_ZEROS, title="Zeros behind a burst (samples)")] = 64
    multiple: Annotated[int, Field(ge=1, le=1 << 22, title="Burst length in steps of (samples)")] = 1
    turnaround_s: Annotated[Seconds, Field(title="Turn-around time (s)")] = 0.005

    @property
    def receive_frequency(self) -> float:
        """The frequency to receive at, Hz."""
        return self.frequency if self.frequency_rx == AUTO else self.frequency_rx


class DeviceFrontEnd(FrontEnd):
    """A radio. A subclass opens the transmitter and the receiver of its device, and sets both up completely.

    :raises RadioError: when there is no such device, or it refuses a setting
    :ivar checks: compare what the device has with what was asked of it
    """

    Options = DeviceOptions
    has_radio = True
    may_return = True
    any_length = True
    example_args: ClassVar[str]
    """Example of ``args``, for error messages."""

    def __init__(self, phy: Phy, **options: Any) -> None:
        super().__init__(phy, **options)
        chosen = self.options
        self.layout = BurstLayout(phy.airtime_samples(), chosen.lead, chosen.tail, chosen.multiple)
        scale = chosen.level / sqrt(phy.burst_power())
        self.checks = DeviceChecks(self.name, chosen, phy.sample_rate)
        self._shaper = BurstShaper(self.layout, scale, phy.sample_rate, tagged=phy.any_length)
        self._blanker: Blanker | None = None
        if chosen.half_duplex and self.transmits:
            self._blanker = Blanker(self._shaper.sent, chosen.turnaround_s, phy.sample_rate)
        blanked_in = None if self._blanker is None else self._blanker.blanked_in
        self._gaps, self._energy = GapCounter(), EnergyCounter(phy.sample_rate, blanked_in)
        self._given, self._taken = Watch(), Watch()
        self._transmitting: Any = None
        self._receiving: Any = None
        self._offset: float | None = None
        self._offset_at = 0.0
        with self.one_line():
            if self.transmits:
                self._transmitting = self._open_transmitter()
            try:
                self._receiving = self._open_receiver()
                self._follow_clock()
            except BaseException:
                self.close()
                raise

    @classmethod
    def on_air(cls, options: Mapping[str, Any]) -> str:
        chosen: Any = build(cls.Options, options, f"front_end {cls.name}")
        power = cls._power_dbm(chosen.gain_tx, chosen.level)
        power_said = "a power that is not known here" if power is None else f"about {power:.0f} dBm"
        return f"at {chosen.frequency:,.0f} Hz with gain_tx {chosen.gain_tx:g} dB, level {chosen.level:g}, {power_said}"

    @classmethod
    def _power_dbm(cls, gain_db: float, level: float) -> float | None:  # noqa: ARG003
        """Mean power of a burst at the port, dBm; None if it is not known."""
        return None

    @property
    def receive_frequency(self) -> float:
        frequency: float = self.options.receive_frequency
        return frequency

    @property
    def device_args(self) -> str:
        """``args`` as a driver takes them: '' for the first device found."""
        return "" if self.options.args == AUTO else str(self.options.args)

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
            self.timing_error_s, self._shaper.clock_offset = _TIMED_S, self._device_offset

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
        alone = self._blanker is not None and self.options.receive_frequency == self.options.frequency
        return self._energy.is_above if alone else None

    @classmethod
    def airtime_with(cls, phy: Phy, chosen: Any, packet_len: int | None = None, mcs: int = 0) -> float:
        samples = phy.on_mcs(mcs).airtime_samples(packet_len)
        burst = BurstLayout(samples, chosen.lead, chosen.tail, chosen.multiple)
        return burst.total / phy.sample_rate + _silence(chosen)

    def ahead(self) -> float:
        return 0.0 if _silence(self.options) else _LEAD_S

    def check(self, now: float) -> None:
        if self._offset is not None and now - self._offset_at > _FOLLOWED_S:
            self._follow_clock()
        if self._given.still_s(self._gaps.nitems_read(0), now) > SILENT_S:
            raise self._dead("no samples")
        if self._transmitting is None:
            return
        taken = self._transmitting.nitems_read(0)
        waiting = taken < self._shaper.nitems_written(0)
        if self._taken.still_s(taken if waiting else None, now) > SILENT_S + self.layout.total / self.phy.sample_rate:
            raise self._dead("a burst to send was not taken")

    def _dead(self, symptom: str) -> RadioError:
        return RadioError(
            f"front_end {self.name}: args = {self.options.args!r}: {symptom} for {SILENT_S:g} s; was the device "
            "unplugged, or is the machine too slow for phy.sample_rate?"
        )

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

    @contextmanager
    def one_line(self) -> Iterator[None]:
        """Turns an exception of a vendor's library into a RadioError of one line."""
        try:
            yield
        except (RuntimeError, ValueError, IndexError) as error:
            if isinstance(error, RadioError):
                raise
            reason = " ".join(str(error).split()).removeprefix("RuntimeError: ") or type(error).__name__
            raise RadioError(
                f"front_end {self.name}: args = {self.options.args!r}: {reason}; is the device plugged in, and free? "
                f"{self.find_with} lists devices, args look like {self.example_args}"
            ) from error


def _silence(chosen: DeviceOptions) -> float:
    """How long nothing is sent after each burst, s."""
    return chosen.guard_s + (chosen.turnaround_s if chosen.half_duplex else 0.0)
