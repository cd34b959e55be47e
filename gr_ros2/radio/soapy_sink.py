"""A SoapySDR device's transmitter as a GNU Radio block, through the C interface of SoapySDR's own library.

`soapy.sink` of GNU Radio 3.10 does not initialise its count of what remains of a burst: now and then it drops the first
packets, or hands the driver a negative length and the process dies. Laws: one call brings a whole burst and ends it;
what a device does not take in time is dropped and counted, so that a device that hangs does not hang the link.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import logging
import time
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_long, c_longlong, c_size_t, c_void_p
from typing import Any

import numpy as np
from gnuradio import gr
from numpy.typing import NDArray

from gr_ros2.phy.threads import BlockThread

_TX, _CHANNEL = 0, 0
_END_BURST = 1 << 1
_TIMEOUT = -1
_CALL_US = 100_000
_PATIENCE_S = 1.0
"""s beyond its airtime that a burst may take to be taken."""
_log = logging.getLogger(__name__)


def _library() -> Any:
    """SoapySDR's library with the types of what we call.

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
        ("setGain", c_int, [c_void_p, c_int, c_size_t, c_double]),
        ("listAntennas", POINTER(c_char_p), [c_void_p, c_int, c_size_t, POINTER(c_size_t)]),
        ("setupStream", c_void_p, [c_void_p, c_int, c_char_p, POINTER(c_size_t), c_size_t, c_void_p]),
        ("activateStream", c_int, [c_void_p, c_void_p, c_int, c_longlong, c_size_t]),
        ("deactivateStream", c_int, [c_void_p, c_void_p, c_int, c_longlong]),
        ("closeStream", c_int, [c_void_p, c_void_p]),
        (
            "writeStream",
            c_int,
            [c_void_p, c_void_p, POINTER(c_void_p), c_size_t, POINTER(c_int), c_longlong, c_long],
        ),
    ):
        entry = getattr(library, f"SoapySDRDevice_{function}")
        entry.restype, entry.argtypes = result, arguments
    return library


_soapy = _library()


def _call(function: str, *arguments: Any) -> Any:
    """Call it; what it says went wrong becomes an error.

    :raises RuntimeError: with the driver's words
    """
    result = getattr(_soapy, f"SoapySDRDevice_{function}")(*arguments)
    # Functions that make something return nothing, the others a code other than 0.
    failed = result is None if function in ("makeStrArgs", "setupStream") else isinstance(result, int) and result != 0
    if failed:
        raise RuntimeError(
            (_soapy.SoapySDRDevice_lastError() or b"").decode("utf-8", "replace") or f"{function} failed"
        )
    return result


class SoapySink(gr.sync_block):  # type: ignore[misc]
    """Samples in, bursts of ``burst`` samples out on the air.

    :param args: which device
    :param sample_rate: samples/s
    :raises RuntimeError: when there is no such device, or it cannot send
    """

    def __init__(self, args: str, burst: int, sample_rate: float) -> None:
        super().__init__("gr_ros2_soapy_sink", [np.complex64], None)
        self._burst = burst
        self._patience = burst / sample_rate + _PATIENCE_S
        self._stream: Any = None
        self.unsent = 0
        """Samples the device did not take."""
        self._block_thread = BlockThread()
        self.set_output_multiple(burst)
        self._device: Any = _call("makeStrArgs", args.encode())
        if not _soapy.SoapySDRDevice_getNumChannels(self._device, _TX):
            self.close()
            raise RuntimeError("the device has no transmitter")
        _call("setSampleRate", self._device, _TX, _CHANNEL, sample_rate)

    @property
    def sample_rate(self) -> float:
        """samples/s the device runs at."""
        return float(_soapy.SoapySDRDevice_getSampleRate(self._device, _TX, _CHANNEL))

    def antennas(self) -> list[str]:
        """Its ports to send from."""
        count = c_size_t()
        names = _soapy.SoapySDRDevice_listAntennas(self._device, _TX, _CHANNEL, byref(count))
        return [names[number].decode() for number in range(count.value)]

    def tune(self, frequency: float, gain: float, bandwidth: float, antenna: str) -> None:
        """Set it up and open its stream; 0 Hz of bandwidth and '' leave the device's choice.

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
        self._block_thread.keep()
        return bool(_soapy.SoapySDRDevice_activateStream(self._device, self._stream, 0, 0, 0) == 0)

    def stop(self) -> bool:
        _soapy.SoapySDRDevice_deactivateStream(self._device, self._stream, 0, 0)
        self._block_thread.release()
        return True

    def close(self) -> None:
        """Let the device go. Idempotent."""
        if self._stream is not None:
            _soapy.SoapySDRDevice_closeStream(self._device, self._stream)
        if self._device is not None:
            _soapy.SoapySDRDevice_unmake(self._device)
        self._device = self._stream = None

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        samples = input_items[0]
        for begin in range(0, len(samples), self._burst):
            self._send(samples[begin : begin + self._burst])
        return len(samples)

    def _send(self, burst: NDArray[np.complex64]) -> None:
        deadline = time.monotonic() + self._patience
        done, result = 0, _TIMEOUT
        while done < len(burst) and (result >= 0 or (result == _TIMEOUT and time.monotonic() < deadline)):
            rest = burst[done:]
            where, flags = c_void_p(rest.ctypes.data), c_int(_END_BURST)
            result = _soapy.SoapySDRDevice_writeStream(
                self._device, self._stream, byref(where), len(rest), byref(flags), 0, _CALL_US
            )
            done += max(0, result)
        if done < len(burst):
            self.unsent += len(burst) - done
            if self.unsent == len(burst) - done:
                _log.warning("front_end soapy: the device did not take a burst (SoapySDR error %d)", result)
