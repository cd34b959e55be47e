"""The `ofdm` PHY: GNU Radio's stock OFDM transmitter and receiver, wired so that no packet is lost on the way.

Laws: every packet is followed by ``gap`` zero samples, so that the receiver never sees two frames back to back
(its header/payload demultiplexer then swallows a trigger now and then) and the last frame is pushed out of it at
once; transmitter and receiver use different tag keys, so that a loopback cannot leak a length past the channel;
every buffer holds a whole frame, since a tagged stream block that cannot get one stalls the flowgraph.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pmt
from gnuradio import blocks, digital, gr, pdu
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.config import build
from gr_ros2.phy.base import Phy

FFT_LEN, CP_LEN = 64, 16
DATA_CARRIERS, PILOT_CARRIERS = 48, 4
HEAD_SYMBOLS = 3
"""Two sync words and one header symbol."""

_CRC32_LEN = 4
_MAX_FRAME_LEN = 4095
"""The stock header counts the bytes of its frame, CRC-32 included, in 12 bits."""
_BITS = {"bpsk": 1, "qpsk": 2}
_POINT_POWER = {"bpsk": 1, "qpsk": 4}
"""Squared magnitude of a constellation point: GNU Radio's ``constellation_qpsk`` is not normalised."""
_TX_KEY, _RX_KEY, _RX_FRAME_KEY = "gr_ros2_tx_len", "gr_ros2_rx_len", "gr_ros2_rx_frame"
_SPINNING_THREAD = "header_pay"
"""How the name of the demultiplexer's thread begins: the kernel keeps 15 characters, GNU Radio's block number too."""
_THREADS_WAIT_S = 0.2
_SMALLEST_BUFFER = 32768
"""Bytes GNU Radio gives every buffer anyway."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class OfdmOptions:
    """Settings of this PHY beside packet length and sample rate.

    :param payload_modulation: of the payload symbols; preamble and header are BPSK always
    :param gap: zero samples after each packet, 1..100000; below 112 the last packet stays in the receiver
    :param scramble: scramble header and payload bits (measured: makes no difference to loss)
    """

    payload_modulation: Literal["bpsk", "qpsk"] = "bpsk"
    gap: Annotated[int, Field(ge=1, le=100_000)] = 160
    scramble: bool = False


class OfdmPhy(Phy):
    """GNU Radio's stock OFDM: FFT 64, cyclic prefix 16, 48 data carriers, CRC-32 per frame.

    A ``packet_len`` above 4091 leaves no room for the CRC-32 in the header's 12-bit length. Such frames go without
    it: the packet's own CRC-16 alone protects them, and damaged ones reach the sink, which refuses and counts them.

    :param options: see :class:`OfdmOptions`
    :raises ConfigError: for an option that is unknown or out of range
    """

    name = "ofdm"
    has_samples = True

    def __init__(self, packet_len: int, sample_rate: float, **options: Any) -> None:
        super().__init__(packet_len, sample_rate)
        self.options = build(OfdmOptions, options, "phy ofdm")
        self.with_crc32 = packet_len + _CRC32_LEN <= _MAX_FRAME_LEN

    @property
    def bits_per_carrier(self) -> int:
        """Payload bits on one carrier of one symbol."""
        return _BITS[self.options.payload_modulation]

    def frame_bits(self) -> int:
        """Payload bits of one frame, CRC-32 included."""
        return 8 * (self.packet_len + (_CRC32_LEN if self.with_crc32 else 0))

    def frame_symbols(self) -> int:
        """OFDM symbols of one frame: sync words, header, payload."""
        return HEAD_SYMBOLS + -(-self.frame_bits() // (self.bits_per_carrier * DATA_CARRIERS))

    def airtime_samples(self) -> int:
        return self.frame_symbols() * (FFT_LEN + CP_LEN) + self.options.gap

    def burst_power(self) -> float:
        # The transmitter's inverse FFT is not normalised, so a symbol's mean power is the sum over its carriers.
        # The first sync word has every other carrier, at twice the power; unused carriers of the last symbol are 0.
        head = HEAD_SYMBOLS * (DATA_CARRIERS + PILOT_CARRIERS)
        pilots = (self.frame_symbols() - HEAD_SYMBOLS) * PILOT_CARRIERS
        points = -(-self.frame_bits() // self.bits_per_carrier)
        return (head + pilots + points * _POINT_POWER[self.options.payload_modulation]) / self.frame_symbols()

    def prefer_latency(self) -> None:
        """Run the receiver's demultiplexers when nothing else wants to run: they spin while waiting for their header.

        Measured for single packets of 64 B: p50 2.0 to 1.1 ms, p99 6.5 to 2 ms, at the cost of throughput.
        """
        tasks = Path("/proc/self/task")
        deadline = time.monotonic() + _THREADS_WAIT_S
        found = False
        while tasks.is_dir() and not found and time.monotonic() < deadline:
            for task in tasks.iterdir():
                with suppress(OSError):  # threads come and go
                    if (task / "comm").read_text().startswith(_SPINNING_THREAD):
                        os.sched_setscheduler(int(task.name), os.SCHED_IDLE, os.sched_param(0))
                        found = True

    def transmitter(self) -> OfdmTransmitter:
        return OfdmTransmitter(self)

    def receiver(self) -> OfdmReceiver:
        return OfdmReceiver(self)

    def stock_arguments(self) -> dict[str, Any]:
        """What GNU Radio's transmitter and receiver must agree on."""
        return {
            "fft_len": FFT_LEN,
            "cp_len": CP_LEN,
            "bps_header": 1,
            "bps_payload": self.bits_per_carrier,
            "scramble_bits": self.options.scramble,
        }

    def fit_buffers(self, parts: list[Any]) -> None:
        """Give each block room for two frames where GNU Radio's own size would not do.

        Only there: larger buffers than needed cost small frames a factor of two to three in throughput.
        """
        for part in parts:
            signature = part.output_signature()
            if not signature.max_streams():
                continue
            size = signature.sizeof_stream_item(0)
            items = self.frame_symbols() if size >= FFT_LEN else max(self.airtime_samples(), self.frame_bits())
            if 2 * items * size > _SMALLEST_BUFFER:
                # Port by port: on blocks with any number of outputs the setter for all ports does nothing.
                for port in range(max(1, signature.max_streams())):
                    part.set_min_output_buffer(port, 2 * items)


class OfdmTransmitter(gr.hier_block2):  # type: ignore[misc]
    """Message port `pdus` in, complex stream out: each packet at once, with its gap behind it."""

    def __init__(self, phy: OfdmPhy) -> None:
        super().__init__("gr_ros2_ofdm_tx", gr.io_signature(0, 0, 0), gr.io_signature(1, 1, gr.sizeof_gr_complex))
        self.message_port_register_hier_in("pdus")
        self._airtime_samples = phy.airtime_samples()
        to_stream = pdu.pdu_to_tagged_stream(gr.types.byte_t, _TX_KEY)
        modulator = _StockTransmitter(phy.with_crc32, packet_length_tag_key=_TX_KEY, **phy.stock_arguments())
        zeros = blocks.vector_source_c([0j] * phy.options.gap, True, 1, [_length_tag(phy.options.gap)])
        self._mux = blocks.tagged_stream_mux(gr.sizeof_gr_complex, _TX_KEY)
        self.msg_connect((self, "pdus"), (to_stream, "pdus"))
        self.connect(to_stream, modulator, (self._mux, 0))
        self.connect(zeros, (self._mux, 1))
        self.connect(self._mux, self)
        phy.fit_buffers([to_stream, *modulator.parts, zeros, self._mux])

    def packets_sent(self) -> int:
        """Packets that have left as samples; 0 before the flowgraph runs."""
        try:
            return int(self._mux.nitems_written(0)) // self._airtime_samples
        except RuntimeError:  # GNU Radio's counters exist while the block is part of a running flowgraph only
            return 0


class OfdmReceiver(gr.hier_block2):  # type: ignore[misc]
    """Complex stream in, message port `pdus` out: the packets whose CRC-32 is right."""

    def __init__(self, phy: OfdmPhy) -> None:
        super().__init__("gr_ros2_ofdm_rx", gr.io_signature(1, 1, gr.sizeof_gr_complex), gr.io_signature(0, 0, 0))
        self.message_port_register_hier_out("pdus")
        demodulator = _StockReceiver(
            phy.with_crc32,
            packet_length_tag_key=_RX_KEY,
            frame_length_tag_key=_RX_FRAME_KEY,
            **phy.stock_arguments(),
        )
        to_pdu = pdu.tagged_stream_to_pdu(gr.types.byte_t, _RX_KEY)
        self.connect(self, demodulator, to_pdu)
        self.msg_connect((to_pdu, "pdus"), (self, "pdus"))
        phy.fit_buffers(demodulator.parts)


class _Wiring:
    """Mixed into a stock hier block, this sees it wire itself: it notes the parts and can leave the CRC-32 out.

    The stock blocks keep no reference to their parts, but each needs its buffer sized.
    """

    def __init__(self, with_crc32: bool, **arguments: Any) -> None:
        self.parts: list[Any] = []
        self._with_crc32 = with_crc32
        with _numpy_state_kept(), _only_warnings():
            super().__init__(**arguments)

    def connect(self, *points: Any) -> None:
        if not self._with_crc32:
            points = tuple(self if _is_crc32(point) and i == 0 else point for i, point in enumerate(points))
            points = tuple(point for point in points if not _is_crc32(point))
        for point in points:
            block = point[0] if isinstance(point, tuple) else point
            if block is not self and all(block is not part for part in self.parts):
                self.parts.append(block)
        super().connect(*points)  # type: ignore[misc]


class _StockTransmitter(_Wiring, digital.ofdm_tx):  # type: ignore[misc]
    pass


class _StockReceiver(_Wiring, digital.ofdm_rx):  # type: ignore[misc]
    pass


def _is_crc32(point: Any) -> bool:
    return hasattr(point, "name") and point.name() == "crc32_bb"


def _length_tag(length: int) -> Any:
    tag = gr.tag_t()
    tag.offset = 0
    tag.key = pmt.intern(_TX_KEY)
    tag.value = pmt.from_long(length)
    return tag


@contextmanager
def _numpy_state_kept() -> Iterator[None]:
    """The stock blocks reseed numpy's global generator for their sync words; that is the user's, so put it back."""
    state = np.random.get_state()
    try:
        yield
    finally:
        np.random.set_state(state)


@contextmanager
def _only_warnings() -> Iterator[None]:
    """Blocks made in here log warnings only: the synchroniser's parts announce each buffer set on them."""
    logging = gr.logging()
    level = logging.default_level()
    logging.set_default_level(gr.log_levels.warn)
    try:
        yield
    finally:
        logging.set_default_level(level)
