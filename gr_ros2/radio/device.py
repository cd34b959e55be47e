"""Common parts of all radios: frequencies, gains and antennas.

Invariant: errors of a vendor's library become one line that names front end, args and remedy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, ClassVar

from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import RadioError
from gr_ros2.radio.burst_device import BurstDeviceOptions, BurstFrontEnd
from gr_ros2.radio.bursts import BurstLayout
from gr_ros2.radio.device_checks import DeviceChecks
from gr_ros2.radio.front_end import Hertz
from gr_ros2.settings.config import STRICT, Text, build
from gr_ros2.settings.fields import AUTO, Auto

_MOST_ZEROS = 1 << 20
"""Samples."""
LEAD = 32
"""Zero samples before each burst, while the amplifier settles."""
Decibels = Annotated[float, Field(ge=-200, le=200)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DeviceOptions(BurstDeviceOptions):
    """Settings of every radio."""

    frequency: Annotated[float, Field(gt=0, le=300e9, title="Frequency (Hz)")]
    """Hz, to send at, and to receive at without `frequency_rx`"""
    args: Annotated[Text, Field(title="Device arguments")] = AUTO
    """which device, in the words of its driver; auto takes the first found"""
    frequency_rx: Annotated[float, Field(gt=0, le=300e9, title="Receive frequency (Hz)")] | Auto = AUTO
    """Hz, to receive at; auto = ``frequency``"""
    gain_tx: Annotated[Decibels, Field(title="Transmit gain (dB)")] = 0.0
    """dB, of the transmitter"""
    gain_rx: Annotated[Decibels, Field(title="Receive gain (dB)")] = 30.0
    """dB, of the receiver"""
    antenna_tx: Annotated[Text, Field(title="Transmit antenna")] = AUTO
    """port to send from, auto = the device's default"""
    antenna_rx: Annotated[Text, Field(title="Receive antenna")] = AUTO
    """port to receive from, auto = the device's default"""
    bandwidth: Annotated[Hertz | Auto, Field(title="Analogue bandwidth (Hz)")] = AUTO
    """Hz, of the analogue filters, auto = the device's choice"""
    tail: Annotated[int, Field(ge=0, le=_MOST_ZEROS, title="Zeros behind a burst (samples)")] = 64
    """zero samples behind each burst at least"""
    multiple: Annotated[int, Field(ge=1, le=1 << 22, title="Burst length in steps of (samples)")] = 1
    """samples of a transfer, for drivers that send whole ones only"""

    @property
    def receive_frequency(self) -> float:
        """The frequency to receive at, Hz."""
        return self.frequency if self.frequency_rx == AUTO else self.frequency_rx

    def layout(self, samples: int, sample_rate: float) -> BurstLayout:  # noqa: ARG002 - all are counted in samples
        return BurstLayout(samples, LEAD, self.tail, self.multiple)


class DeviceFrontEnd(BurstFrontEnd):
    """A radio. See :class:`gr_ros2.radio.burst_device.BurstFrontEnd`.

    :ivar checks: compare what the device has with what was asked of it
    """

    Options: ClassVar[type[DeviceOptions]] = DeviceOptions
    example_args: ClassVar[str]
    """Example of ``args``, for error messages."""

    def _open(self) -> None:
        self.checks = DeviceChecks(self.name, self.options, self.phy.sample_rate)
        with self.one_line():
            super()._open()

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

    def _hears_where_it_sends(self) -> bool:
        return bool(self.options.receive_frequency == self.options.frequency)

    def _device_said(self) -> str:
        return f"args = {self.options.args!r}"

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
