"""The length word: 32 bits in a burst that carry the length of its packet. Any two words differ in at least 8 bits.

Invariant: the word of a length has the format of the 32-bit header of GNU Radio's OFDM frames
(``packet_header_default``): 12 bits length, 12 bits frame number, CRC-8. In the number field, GNU Radio counts frames.
Here the field holds the parity of the length in the extended Golay code (24, 12, 8). So the most likely length is
right wherever a packet with a code can be decoded. With an adaptive rate the field also holds the MCS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from operator import xor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.fec import Bits, Soft

WORD_BITS = 32
LENGTHS = 1 << 12
"""Number of lengths that can be distinguished."""
RATES = 8
"""Number of rates of an adaptive rate that can be distinguished."""
_MCS_MARKS = (0x01C, 0x1C0, 0x2E2)
"""Value added to the number field for each bit of an MCS. They were searched for: with all lengths and rates, any two
words still differ in 8 bits."""
_FIELD_BITS, _CRC_BITS = 12, 8
_WEIGHTS = 1 << np.arange(_FIELD_BITS)
_GOLAY = 0xAE3
"""Generator of the Golay code (23, 12, 7): x^11 + x^9 + x^7 + x^6 + x^5 + x + 1."""
_GOLAY_CHECKS = 11


class LengthWord:
    """The words of some packet lengths.

    :param lengths: packet lengths, bytes
    :param fields: value of the length field of each word, modulo 4096
    :param marks: value added to the number field of each word, for lengths with the same length field
    """

    def __init__(self, lengths: range, fields: Sequence[int], marks: Sequence[int] | int = 0) -> None:
        self._first, self._last = lengths[0], lengths[-1]
        self._longest = fields[-1] % LENGTHS
        numbers = _table(golay_parity)[np.asarray(fields) % LENGTHS] ^ np.asarray(marks)
        same = [place for place, field in enumerate(fields) if field % LENGTHS == self._longest]
        self._numbered = {int(numbers[place]): lengths[place] for place in same}
        """Packet length by number field, for the words whose length field is that of the longest frame."""
        self.bits = header_bits(fields, numbers)
        """Bits of the words, one row per length."""
        self.signs = self.bits.astype(np.float32) * 2 - 1

    def word(self, length: int) -> Bits:
        """The bits of the word for this length."""
        row: Bits = self.bits[length - self._first]
        return row

    def read(self, soft: Soft) -> int:
        """The most likely length.

        :param soft: soft bits of a word; more may follow
        """
        return self._first + int(np.argmax(self.signs @ soft[:WORD_BITS]))

    def read_header(self, soft: Soft) -> int:
        """The most likely length, also for headers sent by GNU Radio's blocks. These blocks use the number field as a
        counter, and send only the longest frames.

        :param soft: soft bits of a header; more may follow
        """
        hard = (soft[:WORD_BITS] > 0).astype(np.uint8)
        length, number = (int(hard[at : at + _FIELD_BITS] @ _WEIGHTS) for at in (0, _FIELD_BITS))
        check = int(hard[2 * _FIELD_BITS :] @ _WEIGHTS[:_CRC_BITS])
        if length == self._longest and check == header_crc(length, number):
            return self._numbered.get(number, self._last)
        return self.read(soft)


def mcs_mark(mcs: int) -> int:
    """Value added to the number field of the words of an MCS, 0 to 7."""
    return reduce(xor, (mark for bit, mark in enumerate(_MCS_MARKS) if mcs >> bit & 1), 0)


def header_bits(lengths: Sequence[int], numbers: Any) -> Bits:
    """Bits of headers, one header per row, in the order in which they are sent.

    :param lengths: values of the length fields, modulo 4096
    :param numbers: values of the number fields, below 4096
    """
    fields = np.asarray(lengths) % LENGTHS
    zeros = header_crc(0, 0)
    # A CRC is linear, except for its constant, which is the CRC of zeros.
    of_length = _table(lambda value: header_crc(value, 0) ^ zeros)
    of_number = _table(lambda value: header_crc(0, value) ^ zeros)
    checks = of_length[fields] ^ of_number[numbers] ^ zeros
    whole = fields | numbers << _FIELD_BITS | checks << 2 * _FIELD_BITS
    return np.asarray((whole[:, None] >> np.arange(WORD_BITS)) & 1, np.uint8)


def golay_parity(value: int) -> int:
    """12 parity bits. With them appended, any two 12-bit values differ in at least 8 of 24 bits."""
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
    """Values of a function for which f(a ^ b) = f(a) ^ f(b), for all values of a field."""
    table = np.zeros(1, np.int64)
    for bit in range(_FIELD_BITS):
        table = np.concatenate((table, table ^ linear(1 << bit)))
    return table
