"""The `soapy` front end: any device SoapySDR has a driver for (HackRF, LimeSDR, BladeRF, Pluto, USRP, …)."""

from __future__ import annotations

from collections import Counter
from typing import Any

from gnuradio import soapy

from gr_ros2.core.errors import RadioError
from gr_ros2.phy import Phy
from gr_ros2.radio.device import DeviceFrontEnd
from gr_ros2.radio.soapy_sink import SoapySink
from gr_ros2.settings.fields import AUTO

_CHANNEL = 0


class SoapyFrontEnd(DeviceFrontEnd):
    """Bursts to and from a device of SoapySDR."""

    name = "soapy"
    example_args = "driver=hackrf,serial=0123"
    find_with = "SoapySDRUtil --find"

    def __init__(self, phy: Phy, **options: Any) -> None:
        self._counted = Counter(unsent=0)
        super().__init__(phy, **options)

    def _open_transmitter(self) -> Any:
        options = self.options
        block = SoapySink(self.device_args, self.layout.total, self.phy.sample_rate, self._counted)
        try:
            self.checks.rate(block.sample_rate)
            antenna = self.checks.antenna("tx", block.antennas())
            block.tune(
                options.frequency, options.gain_tx, 0.0 if options.bandwidth == AUTO else options.bandwidth, antenna
            )
            self.checks.frequency("tx", block.frequency)
            self.checks.gain("tx", block.gain, *block.gains())
        except BaseException:
            block.close()
            raise
        return block

    def _open_receiver(self) -> Any:
        options = self.options
        block = soapy.source(self.device_args, "fc32", 1, "", "", [""], [""])
        block.set_sample_rate(_CHANNEL, self.phy.sample_rate)
        self.checks.rate(block.get_sample_rate(_CHANNEL))
        if options.bandwidth != AUTO:
            block.set_bandwidth(_CHANNEL, options.bandwidth)
        if antenna := self.checks.antenna("rx", block.list_antennas(_CHANNEL)):
            block.set_antenna(_CHANNEL, antenna)
        block.set_frequency(_CHANNEL, options.receive_frequency)
        self.checks.frequency("rx", block.get_frequency(_CHANNEL))
        if block.has_gain_mode(_CHANNEL):
            block.set_gain_mode(_CHANNEL, False)
        block.set_gain(_CHANNEL, options.gain_rx)
        has = block.get_gain_range(_CHANNEL)
        self.checks.gain("rx", block.get_gain(_CHANNEL), has.minimum(), has.maximum(), has.step())
        return block

    def _device_time(self) -> float | None:
        at: float | None = None if self._transmitting is None else self._transmitting.device_time()
        return at

    def check(self, now: float) -> None:
        if self._transmitting is not None and (trouble := self._transmitting.trouble):
            raise RadioError(
                f"front_end soapy: args = {self.options.args!r}: the device does not begin to send ({trouble}); "
                "is another program using it?"
            )
        super().check(now)

    def _device_counters(self) -> dict[str, int]:
        if self._transmitting is not None:
            self._transmitting.ask()
        return dict(self._counted)

    def close(self) -> None:
        if self._transmitting is not None:
            self._transmitting.close()
        super().close()
