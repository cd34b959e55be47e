"""The `uhd` front end: USRPs. The shaper's tag sets the end of a burst. Between bursts the USRP sends nothing."""

from __future__ import annotations

import os
from typing import Annotated, Any

# Otherwise the UHD library prints a greeting to stderr before our first line. Its warnings are still printed.
os.environ.setdefault("UHD_LOG_CONSOLE_LEVEL", "warning")

from gnuradio import uhd
from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.phy import Phy
from gr_ros2.phy.base import LENGTH_TAG
from gr_ros2.radio.device import DeviceFrontEnd, DeviceOptions
from gr_ros2.radio.device_checks import Direction
from gr_ros2.radio.stream_events import UsrpEvents
from gr_ros2.settings.config import STRICT, Text
from gr_ros2.settings.fields import AUTO

_CHANNEL = 0


@dataclass(frozen=True, kw_only=True, config=STRICT)
class UhdOptions(DeviceOptions):
    """Settings of this front end."""

    clock_source: Annotated[str, Field(examples=[AUTO, "internal", "external", "mimo", "gpsdo"], min_length=1)] = AUTO
    """auto = the device's default"""
    subdev_tx: Annotated[Text, Field(title="Transmit subdevice")] = AUTO
    """frontend to send with, as in ``A:A``, auto = the device's default"""
    subdev_rx: Annotated[Text, Field(title="Receive subdevice")] = AUTO
    """frontend to receive with, auto = the device's default"""


class UhdFrontEnd(DeviceFrontEnd):
    """Bursts to and from a USRP."""

    name = "uhd"
    Options = UhdOptions
    example_args = "type=b200 or addr=192.168.10.2"
    find_with = "uhd_find_devices"

    def __init__(self, phy: Phy, **options: Any) -> None:
        self._events = UsrpEvents()
        super().__init__(phy, **options)

    def wire(self, graph: Any) -> None:
        super().wire(graph)
        if self.transmits:
            graph.msg_connect(self._transmitting, "async_msgs", self._events, "async_msgs")

    def _device_counters(self) -> dict[str, int]:
        return dict(self._events.counted)

    def _device_time(self) -> float | None:
        return None if self._receiving is None else float(self._receiving.get_time_now().get_real_secs())

    def _open_transmitter(self) -> Any:
        return self._set_up(uhd.usrp_sink(self.device_args, _stream(), LENGTH_TAG), "tx")

    def _open_receiver(self) -> Any:
        return self._set_up(uhd.usrp_source(self.device_args, _stream()), "rx")

    def _set_up(self, block: Any, direction: Direction) -> Any:
        options, sending = self.options, direction == "tx"
        if options.clock_source != AUTO:
            block.set_clock_source(options.clock_source)
        if (subdev := options.subdev_tx if sending else options.subdev_rx) != AUTO:
            block.set_subdev_spec(subdev)
        block.set_samp_rate(self.phy.sample_rate)
        self.checks.rate(block.get_samp_rate())
        if options.bandwidth != AUTO:
            block.set_bandwidth(options.bandwidth, _CHANNEL)
        if antenna := self.checks.antenna(direction, block.get_antennas(_CHANNEL)):
            block.set_antenna(antenna, _CHANNEL)
        block.set_center_freq(options.frequency if sending else options.receive_frequency, _CHANNEL)
        self.checks.frequency(direction, block.get_center_freq(_CHANNEL))
        block.set_gain(options.gain_tx if sending else options.gain_rx, _CHANNEL)
        has = block.get_gain_range(_CHANNEL)
        self.checks.gain(direction, block.get_gain(_CHANNEL), has.start(), has.stop(), has.step())
        return block


def _stream() -> Any:
    return uhd.stream_args(cpu_format="fc32", channels=[_CHANNEL])
