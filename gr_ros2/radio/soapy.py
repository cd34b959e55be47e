"""The `soapy` front end: any device SoapySDR has a driver for (HackRF, LimeSDR, BladeRF, Pluto, USRP, …)."""

from __future__ import annotations

from typing import Any

from gnuradio import soapy

from gr_ros2.errors import RadioError
from gr_ros2.radio.device import DeviceFrontEnd
from gr_ros2.radio.soapy_sink import SoapySink

_CHANNEL = 0


class SoapyFrontEnd(DeviceFrontEnd):
    """See :class:`DeviceOptions`; ``args`` as in ``driver=hackrf,serial=…``."""

    name = "soapy"
    example_args = "driver=hackrf,serial=0123"
    find_with = "SoapySDRUtil --find"

    def _open_transmitter(self) -> Any:
        options = self.options
        block = SoapySink(options.args, self.layout.total, self.phy.sample_rate)
        try:
            self.check_rate(block.sample_rate)
            self._check_antenna("tx", block.antennas())
            block.tune(options.frequency, options.gain_tx, options.bandwidth, options.antenna_tx)
        except RuntimeError:
            block.close()
            raise
        return block

    def _open_receiver(self) -> Any:
        options = self.options
        block = soapy.source(options.args, "fc32", 1, "", "", [""], [""])
        block.set_sample_rate(_CHANNEL, self.phy.sample_rate)
        self.check_rate(block.get_sample_rate(_CHANNEL))
        if options.bandwidth:
            block.set_bandwidth(_CHANNEL, options.bandwidth)
        self._check_antenna("rx", block.list_antennas(_CHANNEL))
        if options.antenna_rx:
            block.set_antenna(_CHANNEL, options.antenna_rx)
        block.set_frequency(_CHANNEL, options.receive_frequency)
        if block.has_gain_mode(_CHANNEL):
            block.set_gain_mode(_CHANNEL, False)
        block.set_gain(_CHANNEL, options.gain_rx)
        return block

    def counters(self) -> dict[str, int]:
        """Also ``unsent``: samples the device did not take in time."""
        sink = self._transmitting
        return {**super().counters(), "unsent": 0 if sink is None else sink.unsent}

    def close(self) -> None:
        if self._transmitting is not None:
            self._transmitting.close()
        super().close()

    def _check_antenna(self, direction: str, known: list[str]) -> None:
        antenna = getattr(self.options, f"antenna_{direction}")
        if antenna and antenna not in known:
            raise RadioError(f"front_end soapy: antenna_{direction} = {antenna!r}: the device has {', '.join(known)}")
