"""GNU Radio's OFDM blocks wired as in its ``ofdm_tx`` and ``ofdm_rx``, with the settings these do not offer.

Laws: at equal settings the samples are those of the stock hier blocks; every part is noted in ``parts``, so that its
buffer can be sized; numpy's global generator, which the stock sync words reseed, is left as it was.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from gnuradio import analog, blocks, digital, fft, gr
from gnuradio.digital import ofdm_txrx

BITS = {"bpsk": 1, "qpsk": 2, "8psk": 3, "16qam": 4, "64qam": 6}
"""Payload bits on one carrier of one symbol, by modulation."""
_SCRAMBLER = {"mask": 0x8A, "seed": 0x7F, "len": 7}


@dataclass(frozen=True)
class Layout:
    """What transmitter and receiver must agree on.

    :param fft_len: carriers, used or not, a power of 2 from 64 on
    :param cp_len: samples of the cyclic prefix
    :param modulation: of the payload, a name of ``BITS``
    :param scramble: header and payload bits
    :param with_crc32: a CRC-32 at the end of each frame
    """

    fft_len: int
    cp_len: int
    modulation: str
    scramble: bool
    with_crc32: bool

    @property
    def pilots(self) -> tuple[tuple[int, ...], ...]:
        """Pilot carriers: 7 and 21 either side of 64, spread over more as far."""
        scale = self.fft_len // 64
        return (tuple(place * scale for place in (-21, -7, 7, 21)),)

    @property
    def data(self) -> tuple[tuple[int, ...], ...]:
        """Data carriers: 26 either side of 64 without pilots and the middle one."""
        edge = 26 * self.fft_len // 64
        return (tuple(place for place in range(-edge, edge + 1) if place and place not in self.pilots[0]),)

    @property
    def pilot_symbols(self) -> tuple[tuple[int, ...], ...]:
        """What the pilots carry."""
        return ((1, 1, 1, -1),)

    def sync_words(self) -> list[list[complex]]:
        """Those of the stock blocks."""
        with _numpy_state_kept():
            arguments = (self.fft_len, self.data, self.pilots)
            return [
                [complex(point) for point in make(*arguments)]
                for make in (ofdm_txrx._make_sync_word1, ofdm_txrx._make_sync_word2)
            ]

    def header(self, packet_key: str, frame_key: str) -> Any:
        """The stock header's format: length, number, CRC-8; one symbol of BPSK."""
        bits = BITS[self.modulation]
        return digital.packet_header_ofdm(
            self.data, 1, packet_key, frame_key, "packet_num", 1, bits, scramble_header=self.scramble
        )

    def scrambler(self, key: str) -> Any:
        """Scrambles or descrambles bytes, afresh with each packet."""
        seed = _SCRAMBLER["seed"] if self.scramble else 0
        return digital.additive_scrambler_bb(
            _SCRAMBLER["mask"], seed, _SCRAMBLER["len"], 0, bits_per_byte=8, reset_tag_key=key
        )


def constellation(modulation: str) -> Any:
    """Points of mean magnitude 1. GNU Radio's own QPSK has magnitude 2, 6 dB above preamble and header.

    :param modulation: a name of ``BITS``
    """
    if modulation == "bpsk":
        return digital.constellation_bpsk()
    if modulation == "8psk":
        return digital.constellation_8psk()
    side = 1 << BITS[modulation] // 2
    gray = np.argsort(np.arange(side) ^ np.arange(side) >> 1)
    levels = 2.0 * gray - (side - 1)
    points = (levels[:, None] + 1j * levels).reshape(-1)
    size = float(np.abs(points).mean())
    symmetry, width = 4, 2 / size
    order = list(range(side * side))
    return digital.constellation_rect(list(points / size), order, symmetry, side, side, width, width)


@lru_cache
def point_power(modulation: str) -> float:
    """Mean squared magnitude of the points."""
    return float(np.mean(np.abs(constellation(modulation).points()) ** 2))


class OfdmModulator(gr.hier_block2):  # type: ignore[misc]
    """Tagged bytes in, tagged samples out.

    :param key: name of the length tag
    """

    def __init__(self, layout: Layout, key: str) -> None:
        super().__init__("gr_ros2_ofdm_mod", gr.io_signature(1, 1, 1), gr.io_signature(1, 1, gr.sizeof_gr_complex))
        self.parts: list[Any] = []
        source: Any = self
        if layout.with_crc32:
            source = digital.crc32_bb(False, key)
            self._chain(self, source)
        mux = blocks.tagged_stream_mux(gr.sizeof_gr_complex, key, 1)
        header = digital.packet_headergenerator_bb(layout.header(key, "").base(), key)
        self._chain(source, header, digital.chunks_to_symbols_bc(constellation("bpsk").points()), (mux, 0))
        self._chain(
            source,
            layout.scrambler(key),
            blocks.repack_bits_bb(8, BITS[layout.modulation], key),
            digital.chunks_to_symbols_bc(constellation(layout.modulation).points()),
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


class OfdmDemodulator(gr.hier_block2):  # type: ignore[misc]
    """Samples in, tagged bytes out: frames whose CRC-32 is right.

    :param threshold: of Schmidl and Cox' metric, 0..1, above which a preamble is seen
    :param packet_key, frame_key: names of the length tags of packets and frames, not that of the transmitter
    """

    def __init__(self, layout: Layout, threshold: float, packet_key: str, frame_key: str) -> None:
        super().__init__("gr_ros2_ofdm_demod", gr.io_signature(1, 1, gr.sizeof_gr_complex), gr.io_signature(1, 1, 1))
        self.parts: list[Any] = []
        self._layout, self._frame_key = layout, frame_key
        fft_len, cp_len = layout.fft_len, layout.cp_len
        words = layout.sync_words()
        sync = digital.ofdm_sync_sc_cfb(fft_len, cp_len, False, threshold)
        mixer = blocks.multiply_cc()
        demux = digital.header_payload_demux(len(words) + 1, fft_len, cp_len, frame_key, "", True)
        self._chain(self, sync)
        self._chain(self, blocks.delay(gr.sizeof_gr_complex, fft_len + cp_len), (mixer, 0), (demux, 0))
        self._chain((sync, 0), analog.frequency_modulator_fc(-2.0 / fft_len), (mixer, 1))
        self._chain((sync, 1), (demux, 1))
        bpsk = constellation("bpsk")
        parser = digital.packet_headerparser_b(layout.header(packet_key, frame_key).formatter())
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
        points = constellation(layout.modulation)
        self._carriers = fft.fft_vcc(fft_len, True, (), True)
        self._chain(
            (demux, 1),
            self._carriers,
            digital.ofdm_frame_equalizer_vcvc(self._equalizer(points, 1).base(), cp_len, frame_key),
            digital.ofdm_serializer_vcc(fft_len, layout.data, frame_key, packet_key, 1),
            digital.constellation_decoder_cb(points.base()),
            blocks.repack_bits_bb(BITS[layout.modulation], 8, packet_key, True),
            layout.scrambler(packet_key),
            *([digital.crc32_bb(True, packet_key)] if layout.with_crc32 else []),
            self,
        )

    def show_symbols(self, sink: Any) -> list[Any]:
        """Connect a sink to the payload's symbols, equalised and not yet decided; returns the parts that needs.

        The equaliser of the receiver decides at once, so a second one without that runs beside it.
        """
        layout = self._layout
        points = constellation(layout.modulation)
        equalizer = self._equalizer(points, 1, enable_soft_output=True)
        soft = digital.ofdm_frame_equalizer_vcvc(equalizer.base(), layout.cp_len, self._frame_key)
        serializer = digital.ofdm_serializer_vcc(layout.fft_len, layout.data, self._frame_key, "", 1)
        self.connect(self._carriers, soft, serializer, sink)
        return [soft, serializer]

    def _equalizer(self, points: Any, skipped: int, **more: Any) -> Any:
        layout = self._layout
        return digital.ofdm_equalizer_simpledfe(
            layout.fft_len,
            points.base(),
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


@contextmanager
def _numpy_state_kept() -> Iterator[None]:
    """The stock sync words reseed numpy's global generator; that is the user's, so put it back."""
    state = np.random.get_state()
    try:
        yield
    finally:
        np.random.set_state(state)


@contextmanager
def only_warnings() -> Iterator[None]:
    """Blocks made in here log warnings only, not each buffer set on them."""
    logging = gr.logging()
    level = logging.default_level()
    logging.set_default_level(gr.log_levels.warn)
    try:
        yield
    finally:
        logging.set_default_level(level)
