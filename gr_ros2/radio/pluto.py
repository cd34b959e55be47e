"""The `pluto` front end: ADALM-Pluto through IIO.

Its transmitter takes whole buffers, so a buffer is exactly one burst and leaves at once; between bursts the converter
has nothing to send, and each burst ends in zeros.
"""

from __future__ import annotations

from typing import Annotated, Any

from gnuradio import iio
from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.errors import RadioError
from gr_ros2.radio.device import DeviceFrontEnd, DeviceOptions
from gr_ros2.radio.front_end import STRICT

SLOWEST, FASTEST = 521e3, 61.44e6
"""samples/s; below 2.083 million with the decimating filter that GNU Radio's block loads by itself."""

_CHANNELS = [True, True]
_LARGEST_ATTENUATION = 89.75
_AUTOMATIC_FILTER = ("Auto", "", 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PlutoOptions(DeviceOptions):
    """Settings of this front end.

    :param gain_tx: dB, 0 = full power, down to -89.75; -40 unless set
    :param buffer_rx: samples the receiver hands over at a time, 0 = 5 ms
    """

    gain_tx: Annotated[float, Field(ge=-_LARGEST_ATTENUATION, le=0)] = -40.0
    gain_rx: Annotated[float, Field(ge=-3, le=76)] = 30.0
    buffer_rx: Annotated[int, Field(ge=0, le=1 << 22)] = 0


class PlutoFrontEnd(DeviceFrontEnd):
    """See :class:`PlutoOptions` and :class:`DeviceOptions`; ``args`` is the URI, ``ip:192.168.2.1`` or ``usb:``."""

    name = "pluto"
    Options = PlutoOptions
    example_args = "ip:192.168.2.1 or usb:1.5.5"
    find_with = "iio_info -S"

    def _open_transmitter(self) -> Any:
        rate, options = self.phy.sample_rate, self.options
        if not SLOWEST <= rate <= FASTEST:
            raise RadioError(
                f"front_end pluto: phy.sample_rate = {rate:,.0f}: a Pluto has {SLOWEST:,.0f} to {FASTEST:,.0f}"
            )
        if options.antenna_tx or options.antenna_rx:
            raise RadioError("front_end pluto: a Pluto has one port to send and one to receive; leave antennas out")
        block = iio.fmcomms2_sink_fc32(options.args, _CHANNELS, self.layout.total, False)
        block.set_filter_params(*_AUTOMATIC_FILTER)
        block.set_samplerate(int(rate))
        block.set_bandwidth(int(options.bandwidth or rate))
        block.set_frequency(int(options.frequency))
        block.set_attenuation(0, -options.gain_tx)
        return block

    def _open_receiver(self) -> Any:
        rate, options = self.phy.sample_rate, self.options
        block = iio.fmcomms2_source_fc32(options.args, _CHANNELS, options.buffer_rx or max(1024, int(rate * 0.005)))
        block.set_filter_params(*_AUTOMATIC_FILTER)
        block.set_samplerate(int(rate))
        block.set_frequency(int(options.receive_frequency))
        block.set_gain_mode(0, "manual")
        block.set_gain(0, options.gain_rx)
        block.set_quadrature(True)
        block.set_rfdc(True)
        block.set_bbdc(True)
        return block
