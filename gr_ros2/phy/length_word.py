"""How a burst says how long its packet is: 32 bits of which any two differ in 8 at least.

Invariant: the word of a length is the 32 bits of the header of GNU Radio's OFDM frames (``packet_header_default``): 12
bits length, 12 bits frame number, CRC-8. GNU Radio counts frames in the number; here it is the parity of the length in
the extended Golay code (24, 12, 8), so that the likeliest length is right where a packet with a code can be read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.fec import Bits, Soft

WORD_BITS = 32
LENGTHS = 1 << 12
"""Lengths told apart."""
_FIELD_BITS, _CRC_BITS = 12, 8
_WEIGHTS = 1 << np.arange(_FIELD_BITS)
_GOLAY = 0xAE3
"""Generator of the Golay code (23, 12, 7): x^11 + x^9 + x^7 + x^6 + x^5 + x + 1."""
_GOLAY_CHECKS = 11


class LengthWord:
    """The words of some lengths.

    :param lengths: of packets, bytes
    :param fields: what the length field of each word holds, modulo 4096
    :param marks: what is added to the number field of each word, for lengths whose length fields are the same
    """

    def __init__(self, lengths: range, fields: Sequence[int], marks: Sequence[int] | int = 0) -> None:
        self._first, self._last = lengths[0], lengths[-1]
        self._longest = fields[-1] % LENGTHS
        numbers = _table(golay_parity)[np.asarray(fields) % LENGTHS] ^ np.asarray(marks)
        same = [place for place, field in enumerate(fields) if field % LENGTHS == self._longest]
        self._numbered = {int(numbers[place]): lengths[place] for place in same}
        """Of the longest frames' own numbers: the lengths."""
        self.bits = header_bits(fields, numbers)
        """One row per length."""
        self.signs = self.bits.astype(np.float32) * 2 - 1

    def word(self, length: int) -> Bits:
        """The bits that say this length."""
        row: Bits = self.bits[length - self._first]
        return row

    def read(self, soft: Soft) -> int:
        """The likeliest length.

        :param soft: of a word's bits; more may follow
        """
        return self._first + int(np.argmax(self.signs @ soft[:WORD_BITS]))

    def read_header(self, soft: Soft) -> int:
        """The likeliest length, in headers by GNU Radio's blocks too: these count, and send the longest frames only.

        :param soft: of a header's bits; more may follow
        """
        hard = (soft[:WORD_BITS] > 0).astype(np.uint8)
        length, number = (int(hard[at : at + _FIELD_BITS] @ _WEIGHTS) for at in (0, _FIELD_BITS))
        check = int(hard[2 * _FIELD_BITS :] @ _WEIGHTS[:_CRC_BITS])
        if length == self._longest and check == header_crc(length, number):
            return self._numbered.get(number, self._last)
        return self.read(soft)


def header_bits(lengths: Sequence[int], numbers: Any) -> Bits:
    """Headers by rows, bits in the order they are sent in.

    :param lengths: what the length fields hold, modulo 4096
    :param numbers: what the number fields hold, below 4096
    """
    fields = np.asarray(lengths) % LENGTHS
    zeros = header_crc(0, 0)
    # A CRC is linear, but for what it is of zeros.
    of_length = _table(lambda value: header_crc(value, 0) ^ zeros)
    of_number = _table(lambda value: header_crc(0, value) ^ zeros)
    checks = of_length[fields] ^ of_number[numbers] ^ zeros
    whole = fields | numbers << _FIELD_BITS | checks << 2 * _FIELD_BITS
    return np.asarray((whole[:, None] >> np.arange(WORD_BITS)) & 1, np.uint8)


def golay_parity(value: int) -> int:
    """12 bits that any two 12-bit values differ in together with themselves in 8 of 24 places at least."""
    rest = value << _GOLAY_CHECKS
    for place in range(_FIELD_BITS + _GOLAY_CHECKS - 1, _GOLAY_CHECKS - 1, -1):
        if rest >> place & 1:
            rest ^= _GOLAY << place - _GOLAY_CHECKS
    return rest << 1 | (value.bit_count() + rest.bit_count()) & 1


def header_crc(length: int, number: int) -> int:
    """CRC-8 of the header of GNU Radio's OFDM frames: polynomial 0x07, start 0xFF, highest bit first."""
    crc = 0xFF
    for byte in length.to_bytes(2, "little") + number.to_bytes(2, "little"):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x07 if crc & 0x80 else 0)) & 0xFF
    return crc


def _table(linear: Callable[[int], int]) -> NDArray[np.int64]:
    """A function for which f(a ^ b) = f(a) ^ f(b), for all values of a field."""
    table = np.zeros(1, np.int64)
    for bit in range(_FIELD_BITS):
        table = np.concatenate((table, table ^ linear(1 << bit)))
    return table
