"""GNU Radio's OFDM blocks as a transmitter and a receiver: `detection_threshold: stock`.

Invariants: the blocks are connected as in GNU Radio's ``ofdm_tx`` and ``ofdm_rx``, and give the same samples at equal
settings; every packet is followed by ``gap`` zero samples, so that the receiver never gets two frames back to back (its
header/payload demultiplexer would sometimes miss a trigger) and the last frame leaves it at once; transmitter and
receiver use different tag keys, so that a loopback cannot pass a length around the channel; every buffer holds a whole
frame, since a tagged stream block that cannot get one stalls the flowgraph; frames whose bits do not fill whole points
are filled up with bytes that the receiver removes, since the stock header cannot describe parts of a point.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pmt
from gnuradio import analog, blocks, digital, fft, gr, pdu

from gr_ros2.phy.flowgraph import HierBlock, ReceiverBlock, TransmitterBlock
from gr_ros2.phy.ofdm_layout import BITS, CRC_LEN, SCRAMBLER, OfdmLayout, constellation
from gr_ros2.phy.tap import SYMBOLS_SHOWN, Tap
from gr_ros2.phy.threads import lift_message_limit, log_warnings_only

STOCK_THRESHOLD = 0.9
"""The threshold of GNU Radio's ``ofdm_rx``. A lower one gains some dB, but sometimes triggers outside a frame."""

_TX_KEY, _RX_KEY, _RX_FRAME_KEY, _RX_PACKET_KEY = (
    f"gr_ros2_{name}" for name in ("tx_len", "rx_len", "rx_frame", "rx_packet")
)
_SPINNING_THREAD = "header_pay"
"""First letters of the name of the demultiplexer's thread: the kernel keeps 15 characters, GNU Radio's block number
included."""
SPINNING_NICE = 10
"""Added to the nice value of such a thread: a tenth of the weight of the others."""
_THREADS_WAIT_S = 0.2
_SMALLEST_BUFFER = 32768
"""Bytes that GNU Radio gives every buffer by default."""


@dataclass(frozen=True)
class StockFrame:
    """The frame of a packet.

    A ``packet_len`` above 4091 leaves no space for the CRC-32 in the header's 12-bit length. Such frames have none:
    only the packet's own CRC-16 protects them, and damaged ones reach the sink, which refuses and counts them.

    :param gap: zero samples after each packet
    """

    layout: OfdmLayout
    packet_len: int
    gap: int

    @property
    def with_crc32(self) -> bool:
        """Whether the header has space for the length with a CRC-32."""
        return self.layout.fits_header(self.packet_len)

    @property
    def fill(self) -> int:
        """Zero bytes after the packet."""
        return self.layout.fill(self.packet_len if self.with_crc32 else self.packet_len - CRC_LEN)

    @property
    def bits(self) -> int:
        """Bits of the payload."""
        return 8 * (self.packet_len + self.fill + (CRC_LEN if self.with_crc32 else 0))

    @property
    def airtime_samples(self) -> int:
        """Samples of a frame, gap included."""
        return self.layout.symbols(self.bits) * self.layout.symbol_samples + self.gap

    def fit_buffers(self, parts: list[Any]) -> None:
        """Give each block buffer space for two frames where GNU Radio's default is too small.

        Other blocks keep the default: for small frames, larger buffers lower the throughput to a half or a third.
        """
        for part in parts:
            signature = part.output_signature()
            if not signature.max_streams():
                continue
            size = signature.sizeof_stream_item(0)
            symbols = self.layout.symbols(self.bits)
            items = symbols if size >= self.layout.fft_len else max(self.airtime_samples, self.bits)
            if 2 * items * size > _SMALLEST_BUFFER:
                # Port by port: on blocks with a variable number of outputs the setter for all ports does nothing.
                for port in range(max(1, signature.max_streams())):
                    part.set_min_output_buffer(port, 2 * items)


def idle_spinning_threads() -> None:
    """Lower the priority of the receiver's demultiplexer threads: they spin while waiting for their header.

    It uses a nice value, not SCHED_IDLE. If there is processor time to spare, SCHED_IDLE is a little better (single
    packets of 64 B, p99: 3 ms; here 6 ms, without any change 7 ms). If other programs keep every core busy, however, a
    SCHED_IDLE thread hardly runs at all, and packets wait in the receiver (beyond their airtime, p50: 1.7 s; here
    13 ms).
    """
    tasks = Path("/proc/self/task")
    deadline = time.monotonic() + _THREADS_WAIT_S
    nice = os.getpriority(os.PRIO_PROCESS, 0) + SPINNING_NICE
    found = False
    while tasks.is_dir() and not found and time.monotonic() < deadline:
        for task in tasks.iterdir():
            with suppress(OSError):  # threads may end at any time
                if (task / "comm").read_text().startswith(_SPINNING_THREAD):
                    os.setpriority(os.PRIO_PROCESS, int(task.name), nice)
                    found = True


class StockTransmitter(TransmitterBlock):
    """Message port `pdus` in, complex stream out: each packet is sent at once, followed by its gap."""

    def __init__(self, frame: StockFrame) -> None:
        super().__init__("gr_ros2_ofdm_tx", frame.airtime_samples)
        lift_message_limit()
        to_stream = pdu.pdu_to_tagged_stream(gr.types.byte_t, _TX_KEY)
        modulator = OfdmModulator(frame.layout, _TX_KEY, frame.with_crc32)
        zeros = blocks.vector_source_c([0j] * frame.gap, True, 1, [_length_tag(frame.gap)])
        mux = blocks.tagged_stream_mux(gr.sizeof_gr_complex, _TX_KEY)
        parts = [to_stream, *modulator.parts, zeros, mux]
        self.msg_connect((self, "pdus"), (to_stream, "pdus"))
        last = to_stream
        if frame.fill:
            filling = blocks.vector_source_b([0] * frame.fill, True, 1, [_length_tag(frame.fill)])
            last = blocks.tagged_stream_mux(1, _TX_KEY)
            self.connect(to_stream, (last, 0))
            self.connect(filling, (last, 1))
            parts += [filling, last]
        self.connect(last, modulator, (mux, 0))
        self.connect(zeros, (mux, 1))
        self.leave_by(mux)
        frame.fit_buffers(parts)


class StockReceiver(ReceiverBlock):
    """Complex stream in, message port `pdus` out: the packets whose CRC-32 is right."""

    def __init__(self, frame: StockFrame) -> None:
        super().__init__("gr_ros2_ofdm_rx")
        self._frame = frame
        self._demodulator = OfdmDemodulator(frame.layout, _RX_KEY, _RX_FRAME_KEY, frame.with_crc32)
        # Header parser and demultiplexer log every header lost in noise.
        log_warnings_only(self._demodulator.parts)
        self.connect(self, self._demodulator)
        last, key, parts = self._demodulator, _RX_KEY, list(self._demodulator.parts)
        if frame.fill:
            # Frames come complete or not at all, so counting bytes is enough.
            key = _RX_PACKET_KEY
            packet = blocks.keep_m_in_n(1, frame.packet_len, frame.packet_len + frame.fill, 0)
            last = blocks.stream_to_tagged_stream(1, 1, frame.packet_len, key)
            self.connect(self._demodulator, packet, last)
            parts += [packet, last]
        to_pdu = pdu.tagged_stream_to_pdu(gr.types.byte_t, key)
        self.connect(last, to_pdu)
        self.msg_connect((to_pdu, "pdus"), (self, "pdus"))
        frame.fit_buffers(parts)

    def tap_symbols(self) -> Tap:
        """Make the payload's symbols visible, equalised and not yet decided. Call it once, before the start."""
        tap = Tap(SYMBOLS_SHOWN)
        self._frame.fit_buffers(self._demodulator.show_symbols(tap))
        return tap


def _length_tag(length: int) -> Any:
    tag = gr.tag_t()
    tag.offset = 0
    tag.key = pmt.intern(_TX_KEY)
    tag.value = pmt.from_long(length)
    return tag


class OfdmModulator(gr.hier_block2):  # type: ignore[misc]
    """Tagged bytes in, tagged samples out.

    :param key: name of the length tag
    :param with_crc32: whether each frame ends with one
    """

    def __init__(self, layout: OfdmLayout, key: str, with_crc32: bool) -> None:
        super().__init__("gr_ros2_ofdm_mod", gr.io_signature(1, 1, 1), gr.io_signature(1, 1, gr.sizeof_gr_complex))
        self.parts: list[Any] = []
        source: Any = self
        if with_crc32:
            source = digital.crc32_bb(False, key)
            self._chain(self, source)
        mux = blocks.tagged_stream_mux(gr.sizeof_gr_complex, key, 1)
        header = digital.packet_headergenerator_bb(_header(layout, key, "").base(), key)
        self._chain(source, header, digital.chunks_to_symbols_bc(constellation("bpsk")), (mux, 0))
        self._chain(
            source,
            _scrambler(layout, key),
            blocks.repack_bits_bb(8, BITS[layout.modulation], key),
            digital.chunks_to_symbols_bc(constellation(layout.modulation)),
            (mux, 1),
        )
        words = layout.sync_words()
        self._chain(
            mux,
            digital.ofdm_carrier_allocator_cvc(
                layout.fft_len, layout.data, layout.pilots, layout.pilot_symbols, words, key
            ),
            fft.fft_vcc(layout.fft_len, False, (), True),
            digital.ofdm_cyclic_prefixer(layout.fft_len, layout.fft_len + layout.cp_len, 0, key),
            self,
        )

    def _chain(self, *points: Any) -> None:
        self.connect(*points)
        note(self.parts, self, points)


class OfdmDemodulator(HierBlock):
    """Samples in, tagged bytes out: frames whose CRC-32 is right.

    :param packet_key, frame_key: names of the length tags of packets and frames, not that of the transmitter
    :param with_crc32: whether each frame ends with one
    """

    def __init__(self, layout: OfdmLayout, packet_key: str, frame_key: str, with_crc32: bool) -> None:
        super().__init__("gr_ros2_ofdm_demod", gr.io_signature(1, 1, gr.sizeof_gr_complex), gr.io_signature(1, 1, 1))
        self.parts: list[Any] = []
        self._layout, self._frame_key = layout, frame_key
        fft_len, cp_len = layout.fft_len, layout.cp_len
        words = layout.sync_words()
        sync = digital.ofdm_sync_sc_cfb(fft_len, cp_len, False, STOCK_THRESHOLD)
        mixer = blocks.multiply_cc()
        demux = digital.header_payload_demux(len(words) + 1, fft_len, cp_len, frame_key, "", True)
        self._chain(self, sync)
        self._chain(self, blocks.delay(gr.sizeof_gr_complex, fft_len + cp_len), (mixer, 0), (demux, 0))
        self._chain((sync, 0), analog.frequency_modulator_fc(-2.0 / fft_len), (mixer, 1))
        self._chain((sync, 1), (demux, 1))
        bpsk = _decider("bpsk")
        parser = digital.packet_headerparser_b(_header(layout, packet_key, frame_key).formatter())
        self._chain(
            (demux, 0),
            fft.fft_vcc(fft_len, True, (), True),
            digital.ofdm_chanest_vcvc(words[0], words[1], 1),
            digital.ofdm_frame_equalizer_vcvc(self._equalizer(bpsk, 0).base(), cp_len, frame_key, True, 1),
            digital.ofdm_serializer_vcc(fft_len, layout.data, frame_key),
            digital.constellation_decoder_cb(bpsk.base()),
            parser,
        )
        self.msg_connect(parser, "header_data", demux, "header_data")
        symbols = _decider(layout.modulation)
        self._carriers = fft.fft_vcc(fft_len, True, (), True)
        self._chain(
            (demux, 1),
            self._carriers,
            digital.ofdm_frame_equalizer_vcvc(self._equalizer(symbols, 1).base(), cp_len, frame_key),
            digital.ofdm_serializer_vcc(fft_len, layout.data, frame_key, packet_key, 1),
            digital.constellation_decoder_cb(symbols.base()),
            blocks.repack_bits_bb(BITS[layout.modulation], 8, packet_key, True),
            _scrambler(layout, packet_key),
            *([digital.crc32_bb(True, packet_key)] if with_crc32 else []),
            self,
        )

    def show_symbols(self, sink: Any) -> list[Any]:
        """Connect a sink to the payload's symbols, equalised and not yet decided; returns the blocks that this needs.

        The receiver's equaliser also decides, so a second equaliser without decisions runs in parallel.
        """
        layout = self._layout
        symbols = _decider(layout.modulation)
        equalizer = self._equalizer(symbols, 1, enable_soft_output=True)
        soft = digital.ofdm_frame_equalizer_vcvc(equalizer.base(), layout.cp_len, self._frame_key)
        serializer = digital.ofdm_serializer_vcc(layout.fft_len, layout.data, self._frame_key, "", 1)
        self.connect(self._carriers, soft, serializer, sink)
        return [soft, serializer]

    def _equalizer(self, symbols: Any, skipped: int, **more: Any) -> Any:
        layout = self._layout
        return digital.ofdm_equalizer_simpledfe(
            layout.fft_len,
            symbols.base(),
            layout.data,
            layout.pilots,
            layout.pilot_symbols,
            symbols_skipped=skipped,
            alpha=0.1,
            **more,
        )

    def _chain(self, *points: Any) -> None:
        self.connect(*points)
        note(self.parts, self, points)


def note(parts: list[Any], owner: Any, points: tuple[Any, ...]) -> None:
    """Add the blocks among these end points to a list, each once."""
    for point in points:
        block = point[0] if isinstance(point, tuple) else point
        if block is not owner and all(block is not part for part in parts):
            parts.append(block)


def _header(layout: OfdmLayout, packet_key: str, frame_key: str) -> Any:
    """The stock header's format: length, number, CRC-8; one symbol of BPSK."""
    bits = BITS[layout.modulation]
    return digital.packet_header_ofdm(
        layout.data, 1, packet_key, frame_key, "packet_num", 1, bits, scramble_header=layout.scramble
    )


def _scrambler(layout: OfdmLayout, key: str) -> Any:
    """Block that scrambles or descrambles bytes, reset for each packet."""
    seed = SCRAMBLER["seed"] if layout.scramble else 0
    return digital.additive_scrambler_bb(
        SCRAMBLER["mask"], seed, SCRAMBLER["len"], 0, bits_per_byte=8, reset_tag_key=key
    )


def _decider(modulation: str) -> Any:
    """GNU Radio's form of :func:`constellation`, which decides by it."""
    if modulation == "bpsk":
        return digital.constellation_bpsk()
    if modulation == "8psk":
        return digital.constellation_8psk()
    grid = constellation(modulation)
    side = 1 << BITS[modulation] // 2
    width = 2 * abs(grid[0].real) / (side - 1)
    return digital.constellation_rect(list(grid), list(range(side * side)), 4, side, side, width, width)
