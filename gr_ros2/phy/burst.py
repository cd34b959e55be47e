"""Bursts of fixed length without GNU Radio: frames, what a modem is, and cutting packets out of a stream of samples.

Laws: sans-IO, arrays in and bytes out; every frame is whitened and ends in a CRC-32, so what comes out is what went in;
a packet comes out as soon as its last sample is in; samples between bursts are looked at once, a damaged frame is
counted and the search goes on right behind its first sample, so that it cannot hide the next one.
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.complex64]
Octets = NDArray[np.uint8]

CRC_LEN = 4
_SPARE = 1 << 16
"""Samples a receiver's memory holds beside one burst; more of it means less moving."""

_STRETCH = 8192
"""Samples searched at a time beside a preamble."""


class Frame:
    """A packet with its CRC-32 (IEEE 802.3, little-endian, as GNU Radio's ``crc32_bb``), whitened with PN9.

    :param packet_len: bytes per packet
    """

    def __init__(self, packet_len: int) -> None:
        self.packet_len = packet_len
        self.length = packet_len + CRC_LEN
        self._whitening = whitening(self.length)

    def wrap(self, packet: bytes) -> Octets:
        """The bytes of a frame."""
        whole = packet + zlib.crc32(packet).to_bytes(CRC_LEN, "little")
        return np.frombuffer(whole, np.uint8) ^ self._whitening

    def unwrap(self, frame: Octets) -> bytes | None:
        """The packet, or None where the CRC-32 does not match."""
        whole = (frame ^ self._whitening).tobytes()
        packet = whole[: self.packet_len]
        return packet if zlib.crc32(packet) == int.from_bytes(whole[self.packet_len :], "little") else None


@lru_cache
def whitening(length: int) -> Octets:
    """PN9 (x^9 + x^5 + 1, all ones at the start), as many bytes as asked for."""
    state, bits = 0x1FF, np.empty(8 * length, np.uint8)
    for i in range(8 * length):
        bits[i] = state & 1
        state = state >> 1 | ((state ^ state >> 5) & 1) << 8
    return np.packbits(bits)


@dataclass(frozen=True)
class Search:
    """What a modem found in samples: where a burst begins, or how far there is none.

    :param searched: samples from the front that need not be looked at again
    :param start: index of a burst's reference sample, None where there is none (yet)
    """

    searched: int
    start: int | None = None


class BurstModem(ABC):
    """A modulation for frames of one length.

    :param packet_len: bytes per packet
    """

    margin = 0
    """Samples before a burst's reference sample that ``demodulate`` may look at."""

    def __init__(self, packet_len: int) -> None:
        self.frame = Frame(packet_len)

    @property
    @abstractmethod
    def burst_samples(self) -> int:
        """Samples of a burst as sent, without gap."""

    @property
    @abstractmethod
    def span(self) -> int:
        """Samples from the reference sample on that ``end`` needs, at most those of the whole burst."""

    @property
    @abstractmethod
    def preamble_samples(self) -> int:
        """Samples that ``find`` needs to see a burst."""

    @property
    @abstractmethod
    def peak_samples(self) -> int:
        """Samples from the reference sample on that may look like the same burst."""

    @abstractmethod
    def modulate(self, packet: bytes) -> Samples:
        """One burst."""

    @abstractmethod
    def find(self, samples: Samples) -> Search:
        """Look for the first burst."""

    def end(self, samples: Samples, start: int) -> int:  # noqa: ARG002
        """Index behind the last sample that ``demodulate`` needs of the burst whose reference sample is ``start``."""
        return start + self.span

    @abstractmethod
    def demodulate(self, samples: Samples, start: int) -> bytes | None:
        """The packet of the burst whose reference sample stands at ``start``, None where it is damaged."""


class BurstReceiver:
    """Samples in, packets out.

    :param modem: modulation and frame length
    """

    def __init__(self, modem: BurstModem) -> None:
        self._modem = modem
        self._buffer = np.zeros(modem.margin + modem.burst_samples + modem.preamble_samples + _SPARE, np.complex64)
        self._cursor = self._end = modem.margin
        self._stretch = modem.preamble_samples + _STRETCH
        self._start: int | None = None
        self._last: int | None = None
        self.damaged = 0
        """Bursts found whose CRC-32 was wrong; noise taken for a preamble counts too."""

    def feed(self, samples: Samples) -> list[bytes]:
        """Take the next samples; returns the packets they complete."""
        packets = []
        while len(samples):
            room = self._make_room()
            self._buffer[self._end : self._end + len(samples[:room])] = samples[:room]
            self._end += len(samples[:room])
            samples = samples[room:]
            packets += self._take()
        return packets

    def _make_room(self) -> int:
        if self._end == len(self._buffer):
            first = self._cursor - self._modem.margin
            self._buffer[: self._end - first] = self._buffer[first : self._end].copy()
            self._cursor -= first
            self._end -= first
            if self._start is not None:
                self._start -= first
            if self._last is not None:
                self._last -= first
        return len(self._buffer) - self._end

    def _take(self) -> list[bytes]:
        packets: list[bytes] = []
        while True:
            if self._start is None:
                # A stretch at a time, since what lies behind a burst is looked at again after it.
                stretch = self._buffer[self._cursor : min(self._end, self._cursor + self._stretch)]
                found = self._modem.find(stretch)
                if found.start is not None:
                    self._start = self._cursor + found.start
                self._cursor += found.searched
                if found.start is None and found.searched:
                    continue
            if self._start is None or self._end - self._start < self._modem.span:
                return packets
            if self._last is None:
                self._last = self._modem.end(self._buffer[: self._end], self._start)
            if self._end < self._last:
                return packets
            packet = self._modem.demodulate(self._buffer[: self._end], self._start)
            if packet is None:
                self.damaged += 1
                self._cursor = self._start + self._modem.peak_samples
            else:
                packets.append(packet)
                self._cursor = self._last - self._modem.margin
            self._start = self._last = None
