"""The frame format of the `ofdm` PHY: carriers, sync words and constellations, as in GNU Radio's blocks.

Invariants: with equal settings every implementation makes the same samples. ``gnuradio.digital``, which would make the
same words and points, is not imported: it takes 14 MB of memory, which a robot's link does not need.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.length_word import WORD_BITS

BITS = {"bpsk": 1, "qpsk": 2, "8psk": 3, "16qam": 4, "64qam": 6}
"""Payload bits on one carrier of one symbol, by modulation."""
SCRAMBLER = {"mask": 0x8A, "seed": 0x7F, "len": 7}


HEAD_SYMBOLS = 3
"""Two sync words and one header symbol."""
CRC_LEN = 4
_MAX_FRAME_LEN = 4095
"""The stock header counts the bytes of its frame, CRC-32 included, in 12 bits."""
_HEADER_SEED = 0x6F
_SYNC_SEED = 42
"""Of numpy's legacy generator, from which GNU Radio's ``ofdm_txrx`` draws its sync words."""


@dataclass(frozen=True)
class OfdmLayout:
    """The settings on which transmitter and receiver must agree.

    :param fft_len: carriers, used or not, a power of 2 from 64 on
    :param cp_len: samples of the cyclic prefix
    :param modulation: modulation of the payload, a name of ``BITS``
    :param scramble: scramble header and payload bits
    :param edge: outermost carrier used, on either side of the unused middle carrier; None = 26 of 64
    :param pilot_places: carriers of the pilots; None = 7 and 21 on either side for 64 carriers, scaled for more
    :raises ConfigError: for carriers that do not exist, or too few carriers for data
    """

    fft_len: int
    cp_len: int
    modulation: str
    scramble: bool
    edge: int | None = None
    pilot_places: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        places, left = self.pilots[0], len(self.data[0])
        if self.outermost >= self.fft_len // 2:
            raise ConfigError(
                f"phy ofdm: carriers = {self.outermost}: at most {self.fft_len // 2 - 1} with this fft_len"
            )
        if left < WORD_BITS:
            raise ConfigError(
                f"phy ofdm: {left} carriers are left for data, the header needs {WORD_BITS}; "
                "use more carriers, or fewer pilots"
            )
        if self.pilot_places is None and self.outermost < max(places):
            raise ConfigError(
                f"phy ofdm: carriers = {self.outermost}: unless set, pilots are {places}; "
                f"give pilots too, at most {self.outermost} either side"
            )
        for place in places:
            if not 0 < abs(place) <= self.outermost:
                raise ConfigError(
                    f"phy ofdm: pilots: {place} is not one of the carriers 1 to {self.outermost} either side"
                )
        if len(set(places)) < max(len(places), 2):
            raise ConfigError(f"phy ofdm: pilots = {places}: at least two are needed, each once")

    @property
    def symbol_samples(self) -> int:
        """Samples of one symbol, cyclic prefix included."""
        return self.fft_len + self.cp_len

    @property
    def bits_per_carrier(self) -> int:
        """Payload bits on one carrier of one symbol."""
        return BITS[self.modulation]

    @property
    def multiple(self) -> int:
        """A frame's bytes are a multiple of this, so that it takes whole constellation points."""
        return 3 if self.bits_per_carrier % 3 == 0 else 1

    def fill(self, packet_len: int) -> int:
        """Fill bytes of a packet, so that packet and CRC-32 take an integer number of constellation points."""
        return -(packet_len + CRC_LEN) % self.multiple

    def fits_header(self, packet_len: int) -> bool:
        """Whether the header has space for the length of a frame with a CRC-32."""
        return packet_len + self.fill(packet_len) + CRC_LEN <= _MAX_FRAME_LEN

    def symbols(self, bits: int) -> int:
        """Symbols of a frame with ``bits`` payload bits: sync words, header, payload."""
        return HEAD_SYMBOLS + -(-bits // (self.bits_per_carrier * len(self.data[0])))

    def power(self, bits: int) -> float:
        """Mean squared magnitude of the samples of such a frame."""
        # The transmitter's inverse FFT is not normalised, so a symbol's mean power is the sum over its carriers.
        # The first sync word has every other carrier, at twice the power; unused carriers of the last symbol are 0.
        data, pilots = len(self.data[0]), len(self.pilots[0])
        symbols = self.symbols(bits)
        points = -(-bits // self.bits_per_carrier)
        head = HEAD_SYMBOLS * (data + pilots)
        tail = (symbols - HEAD_SYMBOLS) * pilots
        return (head + tail + points * point_power(self.modulation)) / symbols

    def mask(self, length: int) -> NDArray[np.uint8]:
        """The scrambling sequence for the bytes of a payload; zeros if scrambling is off."""
        seed = SCRAMBLER["seed"] if self.scramble else 0
        return np.packbits(_register(seed, 8 * length), bitorder="little")

    def header_mask(self) -> NDArray[np.uint8]:
        """The scrambling sequence for the bits of the header; zeros if scrambling is off, and after its 32 bits."""
        return _register(_HEADER_SEED if self.scramble else 0, len(self.data[0]))

    @cached_property
    def pilots(self) -> tuple[tuple[int, ...], ...]:
        """Pilot carriers."""
        if self.pilot_places is not None:
            return (tuple(sorted(self.pilot_places)),)
        scale = self.fft_len // 64
        return (tuple(place * scale for place in (-21, -7, 7, 21)),)

    @property
    def outermost(self) -> int:
        """Outermost carrier used, on either side."""
        return 26 * self.fft_len // 64 if self.edge is None else self.edge

    @cached_property
    def data(self) -> tuple[tuple[int, ...], ...]:
        """Data carriers: all up to the edge, without pilots and the middle carrier."""
        edge = self.outermost
        return (tuple(place for place in range(-edge, edge + 1) if place and place not in self.pilots[0]),)

    @property
    def pilot_symbols(self) -> tuple[tuple[int, ...], ...]:
        """Symbols of the pilots."""
        return (tuple((1, 1, 1, -1)[place % 4] for place in range(len(self.pilots[0]))),)

    def sync_words(self) -> list[list[complex]]:
        """The sync words of the stock blocks: BPSK, of the first one every second carrier, at twice the power."""
        used = {place % self.fft_len for place in (*self.data[0], *self.pilots[0])}
        odd = {place for place in used if place % 2}
        return [self._sync_word(odd, sqrt(2)), self._sync_word(used, 1.0)]

    def _sync_word(self, used: set[int], size: float) -> list[complex]:
        draw = np.random.RandomState(_SYNC_SEED).randint
        word = [size * (1 - 2 * draw(2)) if place in used else 0.0 for place in range(self.fft_len)]
        return [complex(point) for point in np.fft.fftshift(word)]


def constellation(modulation: str) -> NDArray[np.complex128]:
    """Points of mean magnitude 1, in GNU Radio's order. Its own QPSK has magnitude 2, 6 dB above preamble and header.

    :param modulation: a name of ``BITS``
    """
    number = np.arange(1 << BITS[modulation])
    if modulation == "bpsk":
        return np.array([-1, 1], np.complex128)
    if modulation == "8psk":
        near, far = np.sin(np.pi / 8), np.cos(np.pi / 8)
        steep = number & 4 > 0
        across, up = np.where(steep, near, far), np.where(steep, far, near)
        return np.asarray(across * (1 - 2 * (number & 1)) + 1j * up * (1 - (number & 2)))
    side = 1 << BITS[modulation] // 2
    gray = np.argsort(np.arange(side) ^ np.arange(side) >> 1)
    levels = 2.0 * gray - (side - 1)
    grid = (levels[:, None] + 1j * levels).reshape(-1)
    return np.asarray(grid / np.abs(grid).mean())


@lru_cache
def point_power(modulation: str) -> float:
    """Mean squared magnitude of the points."""
    return float(np.mean(np.abs(constellation(modulation)) ** 2))


def _register(seed: int, count: int) -> NDArray[np.uint8]:
    """Bits of GNU Radio's linear feedback shift register."""
    state, bits = seed, np.empty(count, np.uint8)
    for place in range(count):
        bits[place] = state & 1
        state = state >> 1 | ((state & SCRAMBLER["mask"]).bit_count() & 1) << SCRAMBLER["len"]
    return bits
