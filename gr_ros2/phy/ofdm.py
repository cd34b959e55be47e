"""The `ofdm` PHY: GNU Radio's OFDM blocks, wired so that no packet is lost on the way.

Laws: every packet is followed by ``gap`` zero samples, so that the receiver never sees two frames back to back
(its header/payload demultiplexer then swallows a trigger now and then) and the last frame is pushed out of it at
once; transmitter and receiver use different tag keys, so that a loopback cannot leak a length past the channel;
every buffer holds a whole frame, since a tagged stream block that cannot get one stalls the flowgraph; frames whose
bits do not fill whole points are filled up with bytes the receiver takes off again, since the stock header cannot
tell it of parts of a point.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import pmt
from gnuradio import blocks, gr, pdu
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.config import build
from gr_ros2.errors import ConfigError
from gr_ros2.phy.base import Phy
from gr_ros2.phy.ofdm_wiring import BITS, Layout, OfdmDemodulator, OfdmModulator, only_warnings, point_power
from gr_ros2.phy.tap import Tap
from gr_ros2.phy.theory import packet_success, psk_symbol_error, qam_symbol_error
from gr_ros2.phy.threads import keep_messages

HEAD_SYMBOLS = 3
"""Two sync words and one header symbol."""
STOCK_THRESHOLD = 0.9
"""What GNU Radio's ``ofdm_rx`` uses: 4 to 5 dB less sensitive in white noise."""

_CRC32_LEN = 4
_MAX_FRAME_LEN = 4095
"""The stock header counts the bytes of its frame, CRC-32 included, in 12 bits."""
_TX_KEY, _RX_KEY, _RX_FRAME_KEY, _RX_PACKET_KEY = (
    f"gr_ros2_{name}" for name in ("tx_len", "rx_len", "rx_frame", "rx_packet")
)
_SPINNING_THREAD = "header_pay"
"""How the name of the demultiplexer's thread begins: the kernel keeps 15 characters, GNU Radio's block number too."""
_THREADS_WAIT_S = 0.2
_SYMBOLS_SHOWN = 480
_SMALLEST_BUFFER = 32768
"""Bytes GNU Radio gives every buffer anyway."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class OfdmOptions:
    """Settings of this PHY beside packet length and sample rate.

    :param payload_modulation: of the payload symbols; preamble and header are BPSK always
    :param fft_len: carriers, used or not; about 13 of 16 are used
    :param cp_len: samples of the cyclic prefix, a quarter to a half of ``fft_len``; None = a quarter. With a shorter
        one the stock synchroniser loses packets even without noise
    :param gap: zero samples after each packet; None = two symbols. Below one symbol and half an FFT length, which is
        refused, the last packet would stay in the receiver
    :param scramble: scramble header and payload bits (measured: makes no difference to loss)
    :param detection_threshold: of the preamble's metric, 0.5..0.95, or stock = 0.9 as in GNU Radio's ``ofdm_rx``. A
        lower one gains up to 5 dB in white noise (0.6) and now and then triggers beside a frame: single packets
        offered one by one without noise lost 6 of 18,000 at 0.6, 1 of 22,000 at 0.7 and none of 18,000 at stock
    """

    payload_modulation: Literal["bpsk", "qpsk", "8psk", "16qam", "64qam"] = "bpsk"
    fft_len: Literal[64, 128, 256, 512] = 64
    cp_len: Annotated[int, Field(ge=16, le=256)] | None = None
    gap: Annotated[int, Field(ge=1, le=100_000)] | None = None
    scramble: bool = False
    detection_threshold: Annotated[float, Field(ge=0.5, le=0.95)] | Literal["stock"] = "stock"


class OfdmPhy(Phy):
    """GNU Radio's stock OFDM: by default FFT 64, cyclic prefix 16, 48 data carriers, CRC-32 per frame.

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
        bytes_per_points = 3 if self.bits_per_carrier in (3, 6) else 1
        self.with_crc32 = True
        self.fill = -(packet_len + _CRC32_LEN) % bytes_per_points
        """Bytes a packet is filled up with, so that its frame takes whole constellation points."""
        if packet_len + self.fill + _CRC32_LEN > _MAX_FRAME_LEN:
            self.with_crc32 = False
            self.fill = -packet_len % bytes_per_points
        fft_len = self.options.fft_len
        cp_len = fft_len // 4 if self.options.cp_len is None else self.options.cp_len
        if not fft_len <= 4 * cp_len <= 2 * fft_len:
            raise ConfigError(
                f"phy ofdm: cp_len = {cp_len}: {fft_len // 4} to {fft_len // 2} samples with fft_len = {fft_len}"
            )
        self.layout = Layout(fft_len, cp_len, self.options.payload_modulation, self.options.scramble, self.with_crc32)
        least = self.symbol_samples + self.options.fft_len // 2
        self.gap = 2 * self.symbol_samples if self.options.gap is None else self.options.gap
        if self.gap < least:
            raise ConfigError(f"phy ofdm: gap = {self.gap}: below {least} the last packet stays in the receiver")

    @property
    def symbol_samples(self) -> int:
        """Samples of one OFDM symbol, cyclic prefix included."""
        return self.layout.fft_len + self.layout.cp_len

    @property
    def bits_per_carrier(self) -> int:
        """Payload bits on one carrier of one symbol."""
        return BITS[self.options.payload_modulation]

    def frame_bits(self) -> int:
        """Payload bits of one frame, CRC-32 and filling included."""
        return 8 * (self.packet_len + self.fill + (_CRC32_LEN if self.with_crc32 else 0))

    def frame_symbols(self) -> int:
        """OFDM symbols of one frame: sync words, header, payload."""
        return HEAD_SYMBOLS + -(-self.frame_bits() // (self.bits_per_carrier * len(self.layout.data[0])))

    def airtime_samples(self) -> int:
        return self.frame_symbols() * self.symbol_samples + self.gap

    def burst_power(self) -> float:
        # The transmitter's inverse FFT is not normalised, so a symbol's mean power is the sum over its carriers.
        # The first sync word has every other carrier, at twice the power; unused carriers of the last symbol are 0.
        data, pilots = len(self.layout.data[0]), len(self.layout.pilots[0])
        head = 3 * (data + pilots)
        tail = (self.frame_symbols() - HEAD_SYMBOLS) * pilots
        points = -(-self.frame_bits() // self.bits_per_carrier)
        return (head + tail + points * point_power(self.options.payload_modulation)) / self.frame_symbols()

    def computed_pdr(self, snr_db: float) -> float:
        noise = self.burst_power() / 10 ** (snr_db / 10)
        power = point_power(self.options.payload_modulation)
        snr, points = power * self.options.fft_len / noise, self.frame_bits() // self.bits_per_carrier
        order = 1 << self.bits_per_carrier
        error = psk_symbol_error(order, snr) if order <= 8 else qam_symbol_error(order, snr)
        return packet_success(error, points)

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

    def fit_buffers(self, parts: list[Any]) -> None:
        """Give each block room for two frames where GNU Radio's own size would not do.

        Only there: larger buffers than needed cost small frames a factor of two to three in throughput.
        """
        for part in parts:
            signature = part.output_signature()
            if not signature.max_streams():
                continue
            size = signature.sizeof_stream_item(0)
            items = (
                self.frame_symbols() if size >= self.options.fft_len else max(self.airtime_samples(), self.frame_bits())
            )
            if 2 * items * size > _SMALLEST_BUFFER:
                # Port by port: on blocks with any number of outputs the setter for all ports does nothing.
                for port in range(max(1, signature.max_streams())):
                    part.set_min_output_buffer(port, 2 * items)


class OfdmTransmitter(gr.hier_block2):  # type: ignore[misc]
    """Message port `pdus` in, complex stream out: each packet at once, with its gap behind it."""

    def __init__(self, phy: OfdmPhy) -> None:
        super().__init__("gr_ros2_ofdm_tx", gr.io_signature(0, 0, 0), gr.io_signature(1, 1, gr.sizeof_gr_complex))
        keep_messages()
        self.message_port_register_hier_in("pdus")
        self._airtime_samples = phy.airtime_samples()
        to_stream = pdu.pdu_to_tagged_stream(gr.types.byte_t, _TX_KEY)
        modulator = OfdmModulator(phy.layout, _TX_KEY)
        zeros = blocks.vector_source_c([0j] * phy.gap, True, 1, [_length_tag(phy.gap)])
        self._mux = blocks.tagged_stream_mux(gr.sizeof_gr_complex, _TX_KEY)
        parts = [to_stream, *modulator.parts, zeros, self._mux]
        self.msg_connect((self, "pdus"), (to_stream, "pdus"))
        last = to_stream
        if phy.fill:
            filling = blocks.vector_source_b([0] * phy.fill, True, 1, [_length_tag(phy.fill)])
            last = blocks.tagged_stream_mux(1, _TX_KEY)
            self.connect(to_stream, (last, 0))
            self.connect(filling, (last, 1))
            parts += [filling, last]
        self.connect(last, modulator, (self._mux, 0))
        self.connect(zeros, (self._mux, 1))
        self.connect(self._mux, self)
        phy.fit_buffers(parts)

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
        threshold = phy.options.detection_threshold
        self._phy = phy
        level = STOCK_THRESHOLD if threshold == "stock" else float(threshold)
        # Header parser and demultiplexer tell of every header lost in noise.
        with only_warnings():
            self._demodulator = OfdmDemodulator(phy.layout, level, _RX_KEY, _RX_FRAME_KEY)
        self.connect(self, self._demodulator)
        last, key, parts = self._demodulator, _RX_KEY, list(self._demodulator.parts)
        if phy.fill:
            # Frames come whole or not at all, so counting bytes is enough.
            key = _RX_PACKET_KEY
            packet = blocks.keep_m_in_n(1, phy.packet_len, phy.packet_len + phy.fill, 0)
            last = blocks.stream_to_tagged_stream(1, 1, phy.packet_len, key)
            self.connect(self._demodulator, packet, last)
            parts += [packet, last]
        to_pdu = pdu.tagged_stream_to_pdu(gr.types.byte_t, key)
        self.connect(last, to_pdu)
        self.msg_connect((to_pdu, "pdus"), (self, "pdus"))
        phy.fit_buffers(parts)

    def tap_symbols(self) -> Tap:
        """Let the payload's symbols be seen, equalised and not yet decided. Before the start, once."""
        tap = Tap(_SYMBOLS_SHOWN)
        self._phy.fit_buffers(self._demodulator.show_symbols(tap))
        return tap


def _length_tag(length: int) -> Any:
    tag = gr.tag_t()
    tag.offset = 0
    tag.key = pmt.intern(_TX_KEY)
    tag.value = pmt.from_long(length)
    return tag
