"""IEEE 802.11 a/g/p frames without GNU Radio's scheduler: packets to frames, and decided symbols back to frames.

Invariants: sans-IO, bytes and arrays in and out; a packet is the payload of one broadcast data frame (IEEE 802.11-2020,
9.3.2) with an LLC/SNAP header (IEEE 802); a decoded frame has the right FCS. Sections, equations and figures named here
are those of IEEE 802.11-2020.
"""

from __future__ import annotations

import zlib
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.fec import GNU_RADIO, Bits, Convolutional, Decoders

MAX_PSDU = 1528
"""Bytes of the longest frame that gr-ieee802-11 sends with any encoding, header and FCS included."""
HEADER_LEN, FCS_LEN = 32, 4
"""Bytes; LLC/SNAP belongs to the header."""
MAX_PACKET = MAX_PSDU - HEADER_LEN - FCS_LEN
FFT_LEN, CP_LEN = 64, 16
CARRIERS, USED_CARRIERS = 48, 52
"""Carriers with data, and with power: these and the pilots."""
PREAMBLE, SIGNAL_BITS = 4, 24
"""Symbols of the preamble: two of short training, two of long training. Data bits of the symbol behind it."""
ROLLOFF = 2
"""Samples in which a symbol passes into the next; a frame is one sample longer for it."""
_DATA, _BROADCAST = b"\x08\x00\x00\x00", b"\xff" * 6
"""Frame control and duration of a data frame within no infrastructure; the receiver's address."""
_SNAP = bytes.fromhex("aaaa03000000 88b5")
"""LLC/SNAP header with the first EtherType for local experiments."""
_SERVICE_BITS, _TAIL_BITS = 16, 6
_RESIDUE = 0x2144DF1C
"""CRC-32 of a whole frame, FCS included."""
_KEPT = {(1, 2): (1, 1), (2, 3): (1, 1, 1, 0), (3, 4): (1, 1, 1, 0, 0, 1)}
"""By code rate: which bits of the rate 1/2 code are sent (figure 17-9)."""
_DECIDED = 10.0
"""Magnitude of a hard decision as a soft bit."""
_CODES = 64
"""Codes kept by a decoder, one for each length of a frame."""
_SHORT = np.sqrt(13 / 6) * (1 + 1j) * np.array([1, -1, 1, -1, -1, 1, 0, -1, -1, 1, 1, 1, 1])
"""Carriers -24, -20, ... 24 of the short training symbols (equation 17-7)."""
_LONG = "++--++-+-++++++--++-+-++++0+--++-+-+-----++--+-+-++++"
"""Carriers -26 to 26 of the long training symbols (equation 17-8)."""


class Encoding(NamedTuple):
    """Modulation and code rate of a frame's data.

    :param constant: its name in the module
    :param carrier_bits: coded bits of a carrier
    :param symbol_bits: bits of a symbol before coding
    """

    constant: str
    carrier_bits: int
    symbol_bits: int

    def symbols(self, packet_len: int) -> int:
        """Symbols with data of a packet of ``packet_len`` bytes."""
        return -(-data_bits(packet_len) // self.symbol_bits)

    @property
    def rate(self) -> tuple[int, int]:
        """Code rate."""
        share = Fraction(self.symbol_bits, self.carrier_bits * CARRIERS)
        return share.numerator, share.denominator

    def samples(self, packet_len: int) -> int:
        """Samples of its frame."""
        return (PREAMBLE + 1 + self.symbols(packet_len)) * (FFT_LEN + CP_LEN) + ROLLOFF - 1


def data_bits(packet_len: int) -> int:
    """Bits that the code carries for a packet, before padding."""
    return _SERVICE_BITS + 8 * (HEADER_LEN + packet_len + FCS_LEN) + _TAIL_BITS


ENCODINGS = {
    "bpsk-1/2": Encoding("BPSK_1_2", 1, 24),
    "bpsk-3/4": Encoding("BPSK_3_4", 1, 36),
    "qpsk-1/2": Encoding("QPSK_1_2", 2, 48),
    "qpsk-3/4": Encoding("QPSK_3_4", 2, 72),
    "16qam-1/2": Encoding("QAM16_1_2", 4, 96),
    "16qam-3/4": Encoding("QAM16_3_4", 4, 144),
    "64qam-2/3": Encoding("QAM64_2_3", 6, 192),
    "64qam-3/4": Encoding("QAM64_3_4", 6, 216),
}


class DataFrames:
    """The broadcast data frames of a network.

    :param network: address 3 (BSSID), six octets in hexadecimal with colons
    :param address: address 2, of the sender
    """

    def __init__(self, network: str, address: str) -> None:
        self._network = bytes.fromhex(network.replace(":", ""))
        self._addresses = _BROADCAST + bytes.fromhex(address.replace(":", "")) + self._network

    def wrap(self, packet: bytes, number: int) -> bytes:
        """The frame of a packet, FCS included.

        :param number: sequence number; its lowest 12 bits are sent
        """
        body = _DATA + self._addresses + (number % 4096 << 4).to_bytes(2, "little") + _SNAP + packet
        return body + zlib.crc32(body).to_bytes(FCS_LEN, "little")

    def unwrap(self, frame: bytes) -> bytes | None:
        """The packet of a frame without FCS; None if it is not a frame of this network."""
        ours = _DATA[:2], _BROADCAST, self._network, _SNAP
        return frame[HEADER_LEN:] if (frame[:2], frame[4:10], frame[16:22], frame[24:HEADER_LEN]) == ours else None


def training() -> list[list[complex]]:
    """The four symbols of the preamble, by carrier from -32 on."""
    short, long = np.zeros(FFT_LEN, np.complex128), np.zeros(FFT_LEN, np.complex128)
    short[8:57:4] = _SHORT
    long[6:59] = [{"+": 1, "-": -1, "0": 0}[sign] for sign in _LONG]
    # The first symbol of long training has a cyclic prefix of 32 samples, and so begins 16 samples early.
    early = long * (-1j) ** (np.arange(FFT_LEN) % 4)
    return [symbol.tolist() for symbol in (short, short, early, long)]


@lru_cache
def scrambler() -> Bits:
    """One period of x^7 + x^4 + 1, all ones at the start (section 17.3.5.5): 127 bits."""
    state, bits = 0x7F, np.empty(127, np.uint8)
    for place in range(len(bits)):
        bits[place] = (state >> 6 ^ state >> 3) & 1
        state = state << 1 & 0x7F | int(bits[place])
    return bits


@lru_cache
def interleaving(carrier_bits: int) -> NDArray[np.int64]:
    """For each coded bit of a symbol, its place among the bits of the carriers (section 17.3.5.7)."""
    count = carrier_bits * CARRIERS
    k = np.arange(count)
    i: NDArray[np.int64] = count // 16 * (k % 16) + k // 16
    s = max(carrier_bits // 2, 1)
    return s * (i // s) + (i + count - 16 * i // count) % s


class FrameDecoder:
    """Decides what frames say; each receiver has its own.

    :param decoders: what decodes the convolutional code
    """

    def __init__(self, decoders: Decoders = GNU_RADIO) -> None:
        self._decoders = decoders
        self._code = lru_cache(maxsize=_CODES)(lambda bits: Convolutional(bits, self._decoders))

    def decode(self, encoding: Encoding, length: int, symbols: NDArray[np.uint8]) -> bytes | None:
        """The frame of these symbols without its FCS; None if the FCS is wrong.

        :param length: bytes of the frame, FCS included
        :param symbols: array (symbols, 48): the point of each carrier, its first bit in the lowest
        """
        bits = (symbols[:, :, None] >> np.arange(encoding.carrier_bits, dtype=np.uint8) & 1).reshape(len(symbols), -1)
        coded = bits[:, interleaving(encoding.carrier_bits)].reshape(-1)
        data = _SERVICE_BITS + 8 * length
        sent = np.resize(np.array(_KEPT[encoding.rate], bool), 2 * (data + _TAIL_BITS))
        soft = np.zeros(len(sent), np.float32)
        soft[sent] = _DECIDED * (2.0 * coded[: np.count_nonzero(sent)] - 1)
        # GNU Radio's code has the two polynomials in the other order.
        scrambled = self._code(data).decode(soft.reshape(-1, 2)[:, ::-1].reshape(-1))
        # The first seven bits are those of the scrambler.
        whole = np.resize(scrambler(), 127 + 7)
        starts = np.flatnonzero((np.lib.stride_tricks.sliding_window_view(whole, 7)[:127] == scrambled[:7]).all(axis=1))
        if not len(starts):
            return None
        clear = scrambled ^ np.resize(np.roll(scrambler(), -int(starts[0])), data)
        frame = np.packbits(clear[_SERVICE_BITS:], bitorder="little").tobytes()
        return frame[:-FCS_LEN] if zlib.crc32(frame) == _RESIDUE else None
