"""The `pluto` front end: ADALM-Pluto through IIO.

The transmitter takes whole buffers. One buffer is exactly one burst and leaves at once. Each burst ends in zeros, and
between bursts the converter has nothing to send. All buffers of a Pluto have the same length, so all bursts have it
too: another length would need new buffers, and the old ones would be lost while they are sent.

Invariants: GNU Radio's blocks continue if the device refuses a setting, so each important setting is read back. What
libiio writes to stderr while a device is opened is held back. It is written afterwards if the device was opened. If
not, it goes to the debug log, and our error line says what went wrong. The connection stays open until the process
ends.
"""

from __future__ import annotations

import ctypes
import logging
import os
import struct
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import log10
from typing import Annotated, Any

from gnuradio import blocks, iio
from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import RadioError
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.radio.device import DeviceFrontEnd, DeviceOptions
from gr_ros2.radio.device_checks import Direction
from gr_ros2.radio.front_end import Hertz
from gr_ros2.settings.config import STRICT
from gr_ros2.settings.fields import AUTO, Auto

SLOWEST, FASTEST = 521e3, 61.44e6
"""Range of the sample rate, samples/s. Below 2.083 million, GNU Radio's block loads a decimating filter by itself."""

_FULL_POWER_DBM = 7.0
"""Of a sine at full scale, as Analog Devices' data of the ADALM-PLUTO has it."""
_CHANNELS = [True, True]
_LARGEST_ATTENUATION = 89.75
_AUTOMATIC_FILTER = ("Auto", "", 0.0, 0.0)
_HANDED_OVER_S = 0.005
"""s of samples that the receiver hands over at a time."""
_PHY = "ad9361-phy"
_CONVERTERS = {"tx": "cf-ad9361-dds-core-lpc", "rx": "cf-ad9361-lpc"}
_OSCILLATORS = {"tx": "altvoltage1", "rx": "altvoltage0"}
_DOUBLE = struct.Struct("=d")
_EVERY_MS, _PATIENCE_S = 5, 10.0
"""Interval at which a setting is read, ms, and time until reading is given up, s. libiio waits less for an answer."""
_STDERR = 2
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PlutoOptions(DeviceOptions):
    """Settings of this front end."""

    gain_tx: Annotated[float, Field(ge=-_LARGEST_ATTENUATION, le=0, title="Transmit gain (dB)")] = -40.0
    """dB, 0 = full power"""
    gain_rx: Annotated[float, Field(ge=-3, le=76, title="Receive gain (dB)")] = 30.0
    bandwidth: Annotated[Hertz | Auto, Field(title="Analogue bandwidth (Hz)")] = AUTO
    """Hz, of the transmitter's analogue filter, auto = ``sample_rate``"""


class PlutoFrontEnd(DeviceFrontEnd):
    """Bursts to and from an ADALM-Pluto."""

    name = "pluto"
    Options = PlutoOptions
    any_length = False
    refuses = frozenset({"antenna_tx", "antenna_rx"})
    example_args = "ip:192.168.2.1 or usb:1.5.5"
    find_with = "iio_info -S"

    @classmethod
    def _power_dbm(cls, gain_db: float, level: float) -> float | None:
        return _FULL_POWER_DBM + gain_db + 20 * log10(level)

    def _check_asked(self) -> None:
        """:raises RadioError: for what no Pluto has"""
        rate, options = self.phy.sample_rate, self.options
        if not SLOWEST <= rate <= FASTEST:
            raise RadioError(
                f"front_end pluto: phy.sample_rate = {rate:,.0f}: a Pluto has {SLOWEST:,.0f} to {FASTEST:,.0f}"
            )
        if any(getattr(options, name) != AUTO for name in self.refuses):
            raise RadioError("front_end pluto: a Pluto has one port to send and one to receive; leave antennas out")

    def _open_transmitter(self) -> Any:
        self._check_asked()
        rate, options = self.phy.sample_rate, self.options
        block = iio.fmcomms2_sink_fc32(self.device_args, _CHANNELS, self.layout.total, False)
        block.set_filter_params(*_AUTOMATIC_FILTER)
        block.set_samplerate(int(rate))
        block.set_bandwidth(int(rate if options.bandwidth == AUTO else options.bandwidth))
        block.set_frequency(int(options.frequency))
        block.set_attenuation(0, -options.gain_tx)
        self._check_settings("tx")
        return block

    def _open_receiver(self) -> Any:
        self._check_asked()
        rate, options = self.phy.sample_rate, self.options
        size = max(1024, int(rate * _HANDED_OVER_S))
        block = iio.fmcomms2_source_fc32(self.device_args, _CHANNELS, size)
        self._receiving = block  # for `close`, if a setting below is wrong
        block.set_filter_params(*_AUTOMATIC_FILTER)
        block.set_samplerate(int(rate))
        block.set_frequency(int(options.receive_frequency))
        block.set_gain_mode(0, "manual")
        block.set_gain(0, options.gain_rx)
        block.set_quadrature(True)
        block.set_rfdc(True)
        block.set_bbdc(True)
        self._check_settings("rx")
        return block

    def close(self) -> None:
        if self._receiving is not None:
            with suppress(RuntimeError):  # GNU Radio 3.10.9 and later: the block does not run
                self._receiving.stop()
            # The block is never deleted. Its destructor waits for its thread, and this thread never ends if the block
            # was not started or ran for less than a second.
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._receiving))
        super().close()

    @contextmanager
    def one_line(self) -> Iterator[None]:
        with _stderr_deferred(), super().one_line():
            yield

    def _check_settings(self, direction: Direction) -> None:
        """:raises RadioError: when the device does not have the requested settings"""
        output = direction == "tx"
        for device in (_CONVERTERS[direction], _PHY):
            # If the converters report no rate, they have no filter either, and run at the rate of the chip.
            if rate := self._read(device, "voltage0", "sampling_frequency", output=output):
                break
        self.checks.rate(rate)
        self.checks.frequency(direction, self._read(_PHY, _OSCILLATORS[direction], "frequency", output=True))
        self.checks.gain(direction, self._read(_PHY, "voltage0", "hardwaregain", output=output))

    def _read(self, device: str, channel: str, attribute: str, *, output: bool) -> float:
        """A setting as the device has it; 0 if the device does not report it."""
        kind = (iio.data_type_t.DOUBLE, iio.attr_type_t.CHANNEL)
        asked = iio.attr_source(self.device_args, device, channel, attribute, _EVERY_MS, 1, *kind, output, 0)
        asked.set_log_level("error")
        told = blocks.vector_sink_b(_DOUBLE.size)
        graph = Flowgraph("gr_ros2_pluto_setting", f"front_end {self.name}")
        graph.connect(asked, blocks.head(_DOUBLE.size, 1), told)
        with graph:  # ends the reading, which would continue otherwise
            end = time.monotonic() + _PATIENCE_S
            while not told.nitems_read(0) and time.monotonic() < end:
                time.sleep(_EVERY_MS * 1e-3)
        return float(_DOUBLE.unpack(bytes(told.data()))[0]) if told.nitems_read(0) else 0.0


@contextmanager
def _stderr_deferred() -> Iterator[None]:
    """Holds back what any thread writes to stderr. It is written afterwards, or logged after an error."""
    with tempfile.TemporaryFile() as kept, os.fdopen(os.dup(_STDERR), "wb") as real:
        os.dup2(kept.fileno(), _STDERR)
        try:
            yield
        except BaseException:
            os.dup2(real.fileno(), _STDERR)
            _log.debug("front_end pluto: while it was opened: %s", _content(kept).decode("utf-8", "replace").strip())
            raise
        os.dup2(real.fileno(), _STDERR)
        real.write(_content(kept))


def _content(file: Any) -> bytes:
    file.seek(0)
    return bytes(file.read())
