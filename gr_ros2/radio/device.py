"""What all radios have in common: frequencies, gains, antennas, and a transmitter that works in bursts.

Laws: a device gets its samples at the time they go on the air, whole bursts only, none beyond full scale; a device
that cannot run at the PHY's sample rate is refused, since packets at another rate are noise; whatever the vendor's
library throws, and a device that falls silent, becomes one line that names front end, args and remedy.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from math import sqrt
from typing import Annotated, Any, ClassVar

from gnuradio import blocks, gr
from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.config import Count, Seconds
from gr_ros2.errors import RadioError
from gr_ros2.phy import Phy
from gr_ros2.radio.bursts import Blanker, BurstLayout, BurstShaper
from gr_ros2.radio.front_end import STRICT, FrontEnd, FrontEndOptions, Hertz

RATE_TOLERANCE = 1e-4
"""How far from the sample rate asked for a device may run; the PHYs are made for clocks within 100 ppm."""

SILENT_S = 3.0
"""s without a sample after which a device is taken for dead; changing direction takes some a tenth of that."""

_LEAD_S = 0.002
"""s before its airtime begins at which a device gets a packet, so that one follows the other without a pause."""

Decibels = Annotated[float, Field(ge=-200, le=200)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DeviceOptions(FrontEndOptions):
    """Settings of every radio.

    :param args: which device, in the words of its driver; '' takes the first found
    :param frequency: Hz, to send at, and to receive at unless ``frequency_rx`` says otherwise
    :param frequency_rx: Hz, to receive at; None = ``frequency``
    :param gain_tx: dB, of the transmitter; 0 unless set, so that nothing loud happens unasked
    :param gain_rx: dB, of the receiver
    :param antenna_tx: port to send from, '' = the device's default
    :param antenna_rx: port to receive from, '' = the device's default
    :param bandwidth: Hz, of the analogue filters, 0 = the device's choice
    :param level: root mean square of a burst's samples, 1 = full scale of the converter. OFDM has peaks 12 dB above it,
        with ``scramble: false`` even 17 dB
    :param lead: zero samples before each burst, while the amplifier settles
    :param tail: zero samples behind each burst at least
    :param multiple: samples a burst is filled up to a multiple of, for drivers that send whole transfers only
    :param half_duplex: receive nothing while sending, and ``turnaround`` s afterwards
    :param turnaround: s, with ``half_duplex``: from the end of a burst until the device hears again and what it heard
        of the burst has come through its buffers; nothing is sent in it either
    """

    frequency: Annotated[float, Field(gt=0, le=300e9)]
    args: str = ""
    frequency_rx: Annotated[float, Field(gt=0, le=300e9)] | None = None
    gain_tx: Decibels = 0.0
    gain_rx: Decibels = 30.0
    antenna_tx: str = ""
    antenna_rx: str = ""
    bandwidth: Hertz = 0.0
    level: Annotated[float, Field(gt=0, le=1)] = 0.1
    lead: Count = 32
    tail: Count = 64
    multiple: Annotated[int, Field(ge=1, le=1 << 22)] = 1
    half_duplex: bool = False
    turnaround: Seconds = 0.005

    @property
    def receive_frequency(self) -> float:
        """Hz."""
        return self.frequency if self.frequency_rx is None else self.frequency_rx


class DeviceFrontEnd(FrontEnd):
    """A radio. A subclass opens the two halves of its device, both set up completely.

    :raises RadioError: when there is no such device, or it refuses a setting
    """

    Options = DeviceOptions
    has_radio = True
    example_args: ClassVar[str]
    """What ``args`` may look like, for errors."""
    find_with: ClassVar[str]
    """Command that lists the devices present, for errors."""

    def __init__(self, phy: Phy, **options: Any) -> None:
        super().__init__(phy, **options)
        chosen = self.options
        self.layout = BurstLayout(phy.airtime_samples(), chosen.lead, chosen.tail, chosen.multiple)
        scale = chosen.level / sqrt(phy.burst_power())
        self._shaper = BurstShaper(self.layout, scale, phy.sample_rate)
        self._blanker: Blanker | None = None
        if chosen.half_duplex:
            self._blanker = Blanker(self._shaper.sent, chosen.turnaround, phy.sample_rate)
        self._arrivals = self._blanker or blocks.copy(gr.sizeof_gr_complex)
        self._heard, self._heard_at = -1, float("-inf")
        self._transmitting: Any = None
        self._receiving: Any = None
        with self.one_line():
            self._transmitting = self._open_transmitter()
            try:
                self._receiving = self._open_receiver()
            except BaseException:
                self.close()
                raise

    @abstractmethod
    def _open_transmitter(self) -> Any:
        """The block that sends, ready to run."""

    @abstractmethod
    def _open_receiver(self) -> Any:
        """The block that receives, ready to run."""

    @property
    def sink(self) -> Any:
        return self._shaper

    @property
    def source(self) -> Any:
        return self._arrivals

    def wire(self, graph: Any) -> None:
        graph.connect(self._shaper, self._transmitting)
        graph.connect(self._receiving, self._arrivals)

    def airtime(self) -> float:
        deaf = self.options.turnaround if self.options.half_duplex else 0.0
        return self.layout.total / self.phy.sample_rate + float(self.options.guard) + float(deaf)

    def early(self) -> float:
        return self.airtime() + _LEAD_S

    def check(self, now: float) -> None:
        heard = int(self._arrivals.nitems_written(0))
        if heard != self._heard:
            self._heard, self._heard_at = heard, now
        elif now - self._heard_at > SILENT_S:
            raise RadioError(
                f"front_end {self.name}: args = {self.options.args!r}: no samples for {SILENT_S:g} s; was the device "
                "unplugged, or is the machine too slow for phy.sample_rate?"
            )

    def counters(self) -> dict[str, int]:
        """``clipped``: samples beyond full scale; ``blanked``: samples not heard because we were sending."""
        blanked = {} if self._blanker is None else {"blanked": self._blanker.blanked}
        return {"clipped": self._shaper.clipped, **blanked}

    def close(self) -> None:
        # The device is let go when nothing holds its blocks.
        self._transmitting = self._receiving = None

    def check_rate(self, got: float) -> None:
        """:raises RadioError: when a device runs at another sample rate than the PHY"""
        wanted = self.phy.sample_rate
        if abs(got - wanted) > RATE_TOLERANCE * wanted:
            raise RadioError(
                f"front_end {self.name}: args = {self.options.args!r}: the device runs at {got:,.0f} samples/s, not at "
                f"{wanted:,.0f}; set phy.sample_rate to one it has"
            )

    @contextmanager
    def one_line(self) -> Iterator[None]:
        """Turns what a vendor's library throws into one line of ours."""
        try:
            yield
        except (RuntimeError, ValueError, IndexError) as error:
            if isinstance(error, RadioError):
                raise
            said = " ".join(str(error).split()).removeprefix("RuntimeError: ") or type(error).__name__
            raise RadioError(
                f"front_end {self.name}: args = {self.options.args!r}: {said}; is the device plugged in, and free? "
                f"{self.find_with} lists devices, args look like {self.example_args}"
            ) from error
