"""A SoapySDR device's transmitter as a GNU Radio block, through the C interface of SoapySDR's own library.

`soapy.sink` of GNU Radio 3.10 does not initialise its count of the samples left in a burst. Sometimes it drops the
first packets, or it passes a negative length to the driver and the process dies.

Invariants: one call brings a whole burst and ends it. Samples that a device does not take in time are dropped and
counted, so that a device that hangs does not block the link. After each burst the device is asked for its events,
without waiting for them.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import logging
import threading
import time
from collections import Counter
from ctypes import POINTER, byref, c_bool, c_char_p, c_double, c_int, c_long, c_longlong, c_size_t, c_void_p
from math import inf
from typing import Any

import numpy as np
from gnuradio import gr
from numpy.typing import NDArray

from gr_ros2.core.watch import Watch
from gr_ros2.phy.threads import ThreadState
from gr_ros2.radio.bursts import BurstCutter
from gr_ros2.radio.stream_events import BURSTS_OUT

_TX, _CHANNEL = 0, 0
_END_BURST, _HAS_TIME = 1 << 1, 1 << 2
_TIMEOUT, _NOT_SUPPORTED, _UNDERFLOW = -1, -5, -7
_EVENTS = {_UNDERFLOW: "underflows", -6: "late", -3: "corrupted"}
"""Names of the events that a device reports, by SoapySDR's code."""
_MOST_EVENTS = 256
"""Largest number of events read at a time, because a driver may report events without end."""
_AGAIN = (0, _TIMEOUT, _UNDERFLOW)
"""Results of a write that took no samples. The write is then repeated."""
_CALL_US = 100_000
_PATIENCE_S = 1.0
"""Time beyond its airtime in which the device must take a burst, s."""
_log = logging.getLogger(__name__)


class _Range(ctypes.Structure):
    """SoapySDR's range of a gain, in dB."""

    _fields_ = (("minimum", c_double), ("maximum", c_double), ("step", c_double))


def _library() -> Any:
    """SoapySDR's library, with the types of the functions that are called here.

    :raises ImportError: when it is not installed
    """
    name = ctypes.util.find_library("SoapySDR")
    if name is None:
        raise ImportError("libSoapySDR is not installed")
    library = ctypes.CDLL(name)
    for function, result, arguments in (
        ("makeStrArgs", c_void_p, [c_char_p]),
        ("unmake", c_int, [c_void_p]),
        ("lastError", c_char_p, []),
        ("getNumChannels", c_size_t, [c_void_p, c_int]),
        ("setSampleRate", c_int, [c_void_p, c_int, c_size_t, c_double]),
        ("getSampleRate", c_double, [c_void_p, c_int, c_size_t]),
        ("setBandwidth", c_int, [c_void_p, c_int, c_size_t, c_double]),
        ("setAntenna", c_int, [c_void_p, c_int, c_size_t, c_char_p]),
        ("setFrequency", c_int, [c_void_p, c_int, c_size_t, c_double, c_void_p]),
        ("getFrequency", c_double, [c_void_p, c_int, c_size_t]),
        ("setGain", c_int, [c_void_p, c_int, c_size_t, c_double]),
        ("getGain", c_double, [c_void_p, c_int, c_size_t]),
        ("getGainRange", _Range, [c_void_p, c_int, c_size_t]),
        ("listAntennas", POINTER(c_char_p), [c_void_p, c_int, c_size_t, POINTER(c_size_t)]),
        ("hasHardwareTime", c_bool, [c_void_p, c_char_p]),
        ("getHardwareTime", c_longlong, [c_void_p, c_char_p]),
        ("setupStream", c_void_p, [c_void_p, c_int, c_char_p, POINTER(c_size_t), c_size_t, c_void_p]),
        ("activateStream", c_int, [c_void_p, c_void_p, c_int, c_longlong, c_size_t]),
        ("deactivateStream", c_int, [c_void_p, c_void_p, c_int, c_longlong]),
        ("closeStream", c_int, [c_void_p, c_void_p]),
        (
            "writeStream",
            c_int,
            [c_void_p, c_void_p, POINTER(c_void_p), c_size_t, POINTER(c_int), c_longlong, c_long],
        ),
        (
            "readStreamStatus",
            c_int,
            [c_void_p, c_void_p, POINTER(c_size_t), POINTER(c_int), POINTER(c_longlong), c_long],
        ),
    ):
        entry = getattr(library, f"SoapySDRDevice_{function}")
        entry.restype, entry.argtypes = result, arguments
    library.SoapySDRStrings_clear.argtypes = [POINTER(POINTER(c_char_p)), c_size_t]
    library.SoapySDR_errToStr.restype, library.SoapySDR_errToStr.argtypes = c_char_p, [c_int]
    return library


_soapy = _library()


def _call(function: str, *arguments: Any) -> Any:
    """Call a function of the library. Its error becomes an exception.

    :raises RuntimeError: with the driver's message
    """
    result = getattr(_soapy, f"SoapySDRDevice_{function}")(*arguments)
    # After an error, functions that make an object return None. The others return a code other than 0.
    failed = result is None if function in ("makeStrArgs", "setupStream") else isinstance(result, int) and result != 0
    if failed:
        reason = _soapy.SoapySDRDevice_lastError() or (_soapy.SoapySDR_errToStr(result) if result else b"")
        raise RuntimeError(reason.decode("utf-8", "replace") or f"{function} failed")
    return result


class SoapySink(gr.sync_block):  # type: ignore[misc]
    """Takes samples, and sends them in bursts. Each burst begins with a tag, see :class:`BurstCutter`.

    :param args: which device
    :param longest: samples of the longest burst
    :param sample_rate: samples/s
    :param counted: counters of bursts, by name. ``unsent``: samples that the device did not take in time. Each of the
        others appears when the device first reports it. ``bursts_out``: bursts sent completely; ``underflows``: the
        device ran out of samples; ``late``: bursts that came too late; ``corrupted``: bursts damaged on their way to
        the device
    :raises RuntimeError: when there is no such device, or it cannot send
    """

    def __init__(self, args: str, longest: int, sample_rate: float, counted: Counter[str]) -> None:
        super().__init__("gr_ros2_soapy_sink", [np.complex64], None)
        self._cutter = BurstCutter(longest, tagged=True)
        self._patience = longest / sample_rate + _PATIENCE_S
        self._stream: Any = None
        self._counted = counted
        self._tells = True
        self._asking = threading.Lock()
        self._thread_state = ThreadState()
        self.trouble = ""
        """Why the device does not begin to send. GNU Radio ignores this error."""
        self._device: Any = _call("makeStrArgs", args.encode())
        try:
            if not _soapy.SoapySDRDevice_getNumChannels(self._device, _TX):
                raise RuntimeError("the device has no transmitter")
            _call("setSampleRate", self._device, _TX, _CHANNEL, sample_rate)
        except RuntimeError:
            self.close()
            raise

    @property
    def sample_rate(self) -> float:
        """Sample rate of the device, samples/s."""
        return float(_soapy.SoapySDRDevice_getSampleRate(self._device, _TX, _CHANNEL))

    def device_time(self) -> float | None:
        """s of the device's clock; None if it has none."""
        if not _soapy.SoapySDRDevice_hasHardwareTime(self._device, b""):
            return None
        return float(_soapy.SoapySDRDevice_getHardwareTime(self._device, b"")) * 1e-9

    def antennas(self) -> list[str]:
        """Names of the ports that the device can send from."""
        count = c_size_t()
        names = _soapy.SoapySDRDevice_listAntennas(self._device, _TX, _CHANNEL, byref(count))
        known = [names[number].decode() for number in range(count.value)]
        _soapy.SoapySDRStrings_clear(byref(names), count)
        return known

    @property
    def frequency(self) -> float:
        """Frequency of the device, Hz."""
        return float(_soapy.SoapySDRDevice_getFrequency(self._device, _TX, _CHANNEL))

    @property
    def gain(self) -> float:
        """Gain of the device, dB."""
        return float(_soapy.SoapySDRDevice_getGain(self._device, _TX, _CHANNEL))

    def gains(self) -> tuple[float, float, float]:
        """Possible gains, dB: smallest, largest and step. The step is 0 if the device does not report one."""
        has = _soapy.SoapySDRDevice_getGainRange(self._device, _TX, _CHANNEL)
        return has.minimum, has.maximum, has.step

    def tune(self, frequency: float, gain: float, bandwidth: float, antenna: str) -> None:
        """Set up the device and open its stream. A bandwidth of 0 Hz and an antenna '' leave the choice to the device.

        :raises RuntimeError: when the device refuses
        """
        if bandwidth:
            _call("setBandwidth", self._device, _TX, _CHANNEL, bandwidth)
        if antenna:
            _call("setAntenna", self._device, _TX, _CHANNEL, antenna.encode())
        _call("setFrequency", self._device, _TX, _CHANNEL, frequency, None)
        _call("setGain", self._device, _TX, _CHANNEL, gain)
        self._stream = _call("setupStream", self._device, _TX, b"CF32", byref(c_size_t(_CHANNEL)), 1, None)

    def start(self) -> bool:
        self._thread_state.keep()
        try:
            _call("activateStream", self._device, self._stream, 0, 0, 0)
        except RuntimeError as error:
            self.trouble = str(error)
        return not self.trouble

    def stop(self) -> bool:
        _soapy.SoapySDRDevice_deactivateStream(self._device, self._stream, 0, 0)
        self._thread_state.release()
        return True

    def close(self) -> None:
        """Release the device. Idempotent."""
        with self._asking:
            if self._stream is not None:
                _soapy.SoapySDRDevice_closeStream(self._device, self._stream)
            if self._device is not None:
                _soapy.SoapySDRDevice_unmake(self._device)
            self._device = self._stream = None

    def ask(self) -> None:
        """Count the events of bursts that the device has reported so far. Any thread may call this."""
        with self._asking:
            for _ in range(_MOST_EVENTS):
                if not self._tells or self._stream is None or not self._look():
                    break

    def _look(self) -> bool:
        """Count one event of the device. Returns whether there was one."""
        channels, flags, when = c_size_t(1 << _CHANNEL), c_int(), c_longlong()
        result = _soapy.SoapySDRDevice_readStreamStatus(
            self._device, self._stream, byref(channels), byref(flags), byref(when), 0
        )
        self._tells = result != _NOT_SUPPORTED
        if result in _EVENTS:
            self._counted[_EVENTS[result]] += 1
        elif result >= 0 and flags.value & _END_BURST:
            self._counted[BURSTS_OUT] += 1
        return result >= 0 or result in _EVENTS

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        bursts, taken = self._cutter.cut(self, input_items[0])
        for burst in bursts:
            self._send(burst.samples, burst.leave_at)
            self.ask()
        return taken

    def _send(self, burst: NDArray[np.complex64], leave_at: float | None) -> None:
        """:param leave_at: s of the device's clock; None for now"""
        watch = Watch(_PATIENCE_S / 4)
        at_ns = 0 if leave_at is None else round(leave_at * 1e9)
        done = result = 0
        while done < len(burst) and (
            result > 0 or (result in _AGAIN and watch.age(inf, time.monotonic()) < self._patience)
        ):
            rest = burst[done:]
            timed = leave_at is not None and not done  # the rest of a burst follows its begin
            where, flags = c_void_p(rest.ctypes.data), c_int(_END_BURST | (_HAS_TIME if timed else 0))
            result = _soapy.SoapySDRDevice_writeStream(
                self._device, self._stream, byref(where), len(rest), byref(flags), at_ns, _CALL_US
            )
            done += max(0, result)
            if result == _UNDERFLOW:
                self._note(_EVENTS[result])
        if done < len(burst):
            if not self._counted["unsent"]:
                _log.warning("front_end soapy: the device did not take a burst (SoapySDR error %d)", result)
            self._note("unsent", len(burst) - done)

    def _note(self, name: str, count: int = 1) -> None:
        with self._asking:
            self._counted[name] += count
