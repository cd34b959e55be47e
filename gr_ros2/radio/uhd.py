"""The `uhd` front end: USRPs. Bursts begin and end at the tags of the shaper; between them the USRP sends nothing."""

from __future__ import annotations

import os
from typing import Any, Literal

# Otherwise its library greets on stderr before every word of ours; what it warns of still comes.
os.environ.setdefault("UHD_LOG_CONSOLE_LEVEL", "warning")

from gnuradio import uhd
from pydantic.dataclasses import dataclass

from gr_ros2.errors import RadioError
from gr_ros2.radio.device import DeviceFrontEnd, DeviceOptions
from gr_ros2.radio.front_end import STRICT

_CHANNEL = 0


@dataclass(frozen=True, kw_only=True, config=STRICT)
class UhdOptions(DeviceOptions):
    """Settings of this front end.

    :param clock_source: '' = the device's default, or internal, external, gpsdo
    :param subdev_tx: frontend to send with, as in ``A:A``, '' = the device's default
    :param subdev_rx: frontend to receive with, '' = the device's default
    """

    clock_source: str = ""
    subdev_tx: str = ""
    subdev_rx: str = ""


class UhdFrontEnd(DeviceFrontEnd):
    """See :class:`UhdOptions` and :class:`DeviceOptions`; ``args`` as in ``type=b200`` or ``addr=192.168.10.2``."""

    name = "uhd"
    Options = UhdOptions
    example_args = "type=b200 or addr=192.168.10.2"
    find_with = "uhd_find_devices"

    def _open_transmitter(self) -> Any:
        return self._open(uhd.usrp_sink, "tx")

    def _open_receiver(self) -> Any:
        return self._open(uhd.usrp_source, "rx")

    def _open(self, kind: Any, direction: Literal["tx", "rx"]) -> Any:
        options, sending = self.options, direction == "tx"
        block = kind(options.args, uhd.stream_args(cpu_format="fc32", channels=[_CHANNEL]))
        if options.clock_source:
            block.set_clock_source(options.clock_source)
        if subdev := options.subdev_tx if sending else options.subdev_rx:
            block.set_subdev_spec(subdev)
        block.set_samp_rate(self.phy.sample_rate)
        self.check_rate(block.get_samp_rate())
        if options.bandwidth:
            block.set_bandwidth(options.bandwidth, _CHANNEL)
        antenna = options.antenna_tx if sending else options.antenna_rx
        if antenna and antenna not in block.get_antennas(_CHANNEL):
            known = ", ".join(block.get_antennas(_CHANNEL))
            raise RadioError(f"front_end uhd: antenna_{direction} = {antenna!r}: the device has {known}")
        if antenna:
            block.set_antenna(antenna, _CHANNEL)
        block.set_center_freq(options.frequency if sending else options.receive_frequency, _CHANNEL)
        block.set_gain(options.gain_tx if sending else options.gain_rx, _CHANNEL)
        return block
