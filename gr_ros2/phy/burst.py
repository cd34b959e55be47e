"""Bursts without GNU Radio: frames, the interface of a modem, and extracting packets from a stream of samples.

Invariants: sans-IO, arrays in and bytes out; every frame ends in a CRC-32, so each output packet equals the packet
sent; a packet comes out as soon as its last sample is in; samples between bursts are examined once; a damaged frame is
counted and the search continues right after its first sample, so that it cannot hide the next one.
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from math import isfinite, log10
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.fec import GNU_RADIO, Bits, Code, CodeName, Codes, Decoders, Soft
from gr_ros2.phy.soft import BitOrder

Samples = NDArray[np.complex64]
Octets = NDArray[np.uint8]

CRC_LEN = 4
_KEPT = 128
"""Number of frames kept: the code of a long frame takes some 100 kB."""
_LOOKED_BACK = 16
"""Packets whose SNRs are averaged (median): a single preamble is short, and gives the SNR only to 1 dB."""
_LEAST_SNR_DB, _MOST_SNR_DB = -40.0, 60.0
"""Limits of a measured SNR: no packet arrives below it; only rounding errors remain above it."""
_HUGE = 1e15
"""Magnitude from which on the power of a burst is no finite number in single precision."""
_SPARE = 1 << 16
"""Samples that a receiver's memory holds in addition to one burst; a larger memory is moved less often."""


class Frame:
    """Packet, fill bytes, CRC-32 (IEEE 802.3, little-endian, as GNU Radio's ``crc32_bb``); whitened, then coded.

    :param packet_len: bytes of the packet
    :param fill: zero bytes after the packet, covered by the CRC
    :param mask: whitening sequence of the bytes
    :param code: code for all bits of the frame
    :param order: whether a byte's highest or lowest bit is sent first
    :param head: what the head of the burst says and the CRC covers too, before the packet
    """

    def __init__(
        self, packet_len: int, fill: int, mask: Octets, code: Code, *, order: BitOrder, head: bytes = b""
    ) -> None:
        self.packet_len = packet_len
        self._fill, self._mask, self._code, self._order = bytes(fill), mask, code, order
        self._crc = zlib.crc32(head)

    @property
    def bits(self) -> int:
        """Bits sent."""
        return self._code.coded_bits

    @property
    def data_bits(self) -> int:
        """Bits before coding."""
        return self._code.bits

    def wrap(self, packet: bytes) -> Bits:
        """A frame's bits, in the order in which they are sent."""
        filled = packet + self._fill
        whole = filled + zlib.crc32(filled, self._crc).to_bytes(CRC_LEN, "little")
        return self._code.encode(np.unpackbits(np.frombuffer(whole, np.uint8) ^ self._mask, bitorder=self._order))

    def unwrap(self, soft: Soft) -> bytes | None:
        """The packet of these soft bits, or None if the CRC-32 does not match."""
        whole = (np.packbits(self._code.decode(soft[: self.bits]), bitorder=self._order) ^ self._mask).tobytes()
        filled = whole[:-CRC_LEN]
        if zlib.crc32(filled, self._crc) != int.from_bytes(whole[-CRC_LEN:], "little"):
            return None
        return filled[: self.packet_len]


class Frames:
    """The frames of a link, one for each packet length.

    :param packet_len: bytes of the longest packet
    :param fec: name of the code
    :param fixed: every packet has that many bytes; otherwise 1 to that many, and each burst carries the number
    :param order: whether a byte's highest or lowest bit is sent first
    :param multiple: a frame's bytes are filled up with zeros to a multiple of this
    :param mask: whitening sequence of the longest frame; shorter frames use its beginning; None = PN9
    :param mcs: with an adaptive rate the number of its MCS. The CRC-32 then covers MCS and packet length too, so
        that no frame is taken for one of another MCS or length
    :param decoders: what decodes the code
    :param carriers: see :class:`gr_ros2.phy.fec.Codes`
    """

    def __init__(
        self,
        packet_len: int,
        fec: CodeName = "none",
        *,
        fixed: bool = False,
        order: BitOrder = "big",
        multiple: int = 1,
        mask: Octets | None = None,
        mcs: int | None = None,
        decoders: Decoders = GNU_RADIO,
        carriers: tuple[int, int] = (0, 1),
    ) -> None:
        form: dict[str, Any] = {"fixed": fixed, "order": order, "multiple": multiple, "mask": mask, "mcs": mcs}
        form["carriers"] = carriers
        self._again = partial(Frames, packet_len, fec, **form, decoders=decoders)
        self._mcs = mcs
        self.packet_len, self.fixed, self.coded = packet_len, fixed, fec != "none"
        self.plain = not self.coded and mcs is None
        """Whether a frame is packet, filling and their CRC-32, whitened, and nothing else."""
        self.order, self.multiple = order, multiple
        self.mask = whitening(self.length(packet_len)) if mask is None else mask
        self.decoders = decoders
        self._codes = Codes(fec, decoders, carriers)
        self.of = lru_cache(maxsize=_KEPT)(self._make)
        """The frame by the bytes of its packet."""

    def __reduce__(self) -> Any:
        # Codes hold GNU Radio objects, which cannot be sent to another process: that process makes its own.
        return self._again, ()

    @property
    def lengths(self) -> range:
        """Allowed packet lengths, bytes."""
        return range(self.packet_len if self.fixed else 1, self.packet_len + 1)

    def length(self, packet_len: int) -> int:
        """Bytes of the frame of a packet of ``packet_len`` bytes."""
        return packet_len + self.fill(packet_len) + CRC_LEN

    def fill(self, packet_len: int) -> int:
        """Zero bytes after a packet of ``packet_len`` bytes."""
        return -(packet_len + CRC_LEN) % self.multiple

    def data_bits(self, packet_len: int) -> int:
        """Bits of the frame of a packet of ``packet_len`` bytes, before coding."""
        return 8 * self.length(packet_len)

    def bits(self, packet_len: int) -> int:
        """Bits of that frame after coding."""
        return self._codes.coded_bits(self.data_bits(packet_len))

    def _make(self, packet_len: int) -> Frame:
        mask = self.mask[: self.length(packet_len)]
        code = self._codes.of(self.data_bits(packet_len))
        head = b"" if self._mcs is None else bytes((self._mcs,)) + packet_len.to_bytes(2, "big")
        return Frame(packet_len, self.fill(packet_len), mask, code, order=self.order, head=head)


@lru_cache
def whitening(length: int) -> Octets:
    """PN9 (x^9 + x^5 + 1, all ones at the start), ``length`` bytes."""
    state, bits = 0x1FF, np.empty(8 * length, np.uint8)
    for i in range(8 * length):
        bits[i] = state & 1
        state = state >> 1 | ((state ^ state >> 5) & 1) << 8
    return np.packbits(bits)


@dataclass(frozen=True)
class Search:
    """Result of a search: where a burst begins, or how many samples contain none.

    :param searched: samples from the front that need not be examined again
    :param start: index of a burst's reference sample, None if there is none (yet)
    """

    searched: int
    start: int | None = None


@dataclass(frozen=True)
class Reading:
    """A demodulated burst, or what its head says while samples are missing.

    :param length: bytes of its packet
    :param soft: log-likelihood ratios of the frame's bits, above 0 for a 1; fill bits may follow. None while the burst
        is cut: the samples given end before ``end``
    :param points: the received constellation points, for display; magnitude about 1
    :param snr: mean power of the burst over that of the noise in the sampled band, measured on its preamble
    :param end: index after the last sample that is needed
    :param mcs: with an adaptive rate the MCS that it was sent with, an index of :attr:`BurstModem.rates`
    """

    length: int
    soft: Soft | None
    points: Samples
    snr: float
    end: int
    mcs: int = 0


class DemodulatedPacket(NamedTuple):
    """A packet that was received.

    :param data: its bytes
    :param snr: of its burst, as in :class:`Reading`
    :param end: the sample after the last one that was needed, counted from the first that the receiver was fed
    :param mcs: as in :class:`Reading`
    """

    data: bytes
    snr: float
    end: int
    mcs: int = 0

    @property
    def snr_db(self) -> float:
        """The SNR in dB, -40..60."""
        return _in_db(self.snr)


@dataclass(frozen=True)
class ModemConstants:
    """The parameters of a modem that a compiled kernel needs.

    :param kernel: name of the kernel
    :param values: the kernel's parameters by name
    :param soft_bits: most soft bits of a reading, including those of the length
    :param points: most points of a reading
    """

    kernel: str
    values: Mapping[str, Any]
    soft_bits: int
    points: int


class BurstModem(ABC):
    """A modulation for the frames of a link.

    :param frames: the frames that bursts carry; with an adaptive rate those of the most robust MCS
    """

    margin = 0
    """Samples before a burst's reference sample that ``read`` may use."""
    stretch = 8192
    """Samples searched at a time in addition to a preamble; the samples after a burst are searched again after it."""

    def __init__(self, frames: Frames) -> None:
        self.frames = frames

    @property
    def rates(self) -> Sequence[BurstModem]:
        """The modems that send the rates of an adaptive rate, the most robust one first; this modem alone where the
        rate is fixed. This modem reads the bursts of all of them."""
        return (self,)

    def on_mcs(self, mcs: int | None) -> BurstModem:
        """The modem of an MCS by its index; the most robust one for None, or one of other settings."""
        rates = self.rates
        return rates[mcs if mcs is not None and 0 <= mcs < len(rates) else 0]

    @abstractmethod
    def samples_of(self, packet_len: int) -> int:
        """Samples of the burst of a packet of ``packet_len`` bytes as sent, without gap."""

    @property
    def burst_samples(self) -> int:
        """Samples of the longest burst."""
        return self.samples_of(self.frames.packet_len)

    @property
    @abstractmethod
    def span(self) -> int:
        """Samples from the reference sample on that hold the head of a burst; at most those of the shortest burst."""

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

    def modulate_into(self, packets: Sequence[bytes], gap: int, out: Samples) -> None:
        """Write the bursts of these packets, each followed by ``gap`` zero samples, to the beginning of an array."""
        begin = 0
        for packet in packets:
            burst = self.modulate(packet)
            end = begin + len(burst)
            out[begin:end] = burst
            begin = end + gap
            out[end:begin] = 0

    @abstractmethod
    def find(self, samples: Samples) -> Search:
        """Look for the first burst."""

    @abstractmethod
    def read(self, samples: Samples, start: int) -> Reading | None:
        """The burst whose reference sample is at ``start``, of which at least ``span`` samples are given; None if the
        close examination finds no burst."""

    def unwrap(self, reading: Reading) -> bytes | None:
        """The packet of a burst, or None if it is cut or its CRC-32 does not match."""
        if reading.soft is None:
            return None
        return self.rates[reading.mcs].frames.of(reading.length).unwrap(reading.soft)

    def receiver(self) -> BurstReceiver:
        """A receiver for these bursts."""
        return BurstReceiver(self)

    def constants(self) -> ModemConstants | None:
        """The parameters of the compiled kernel of this modem; None where there is no kernel."""
        return None

    def lengths(self) -> dict[str, Any]:
        """The constants that describe packet lengths."""
        lengths = self.frames.lengths
        bits = [self.frames.bits(length) for length in lengths]
        return {"shortest": lengths[0], "longest": lengths[-1], "frame_bits": bits}


class BurstReceiver:
    """Samples in, packets out.

    :param modem: modulation and frames
    """

    def __init__(self, modem: BurstModem) -> None:
        self._modem = modem
        self._buffer = np.zeros(modem.margin + modem.burst_samples + modem.preamble_samples + _SPARE, np.complex64)
        self._cursor = self._end = modem.margin
        self._stretch = modem.preamble_samples + modem.stretch
        self._start: int | None = None
        self._last: int | None = None
        self._dropped = -modem.margin
        """Samples fed that are not in the buffer any more; at first it begins with as many zeros."""
        self.points = np.empty(0, np.complex64)
        """The constellation points of the newest packet."""
        self.damaged = 0
        """Bursts found whose CRC-32 was wrong; noise taken for a preamble counts too."""
        self._snrs: tuple[float, ...] = ()

    @property
    def snr_db(self) -> float | None:
        """SNR over the sampled band, dB, -40..60: the median of the newest packets; None before the first.

        May be called from any thread.
        """
        if not self._snrs:
            return None
        return _in_db(median(self._snrs))

    def feed(self, samples: Samples) -> list[DemodulatedPacket]:
        """Take the next samples; returns the packets they complete."""
        packets: list[DemodulatedPacket] = []
        while len(samples):
            count = min(self._make_space(), len(samples))
            end = self._end + count
            self._buffer[self._end : end] = samples[:count]
            self._end, samples = end, samples[count:]
            packets += self._take()
        return packets

    def _make_space(self) -> int:
        if self._end == len(self._buffer):
            first = self._cursor - self._modem.margin
            self._buffer[: self._end - first] = self._buffer[first : self._end].copy()
            self._cursor -= first
            self._end -= first
            self._dropped += first
            if self._start is not None:
                self._start -= first
            if self._last is not None:
                self._last -= first
        return len(self._buffer) - self._end

    def _counted(self, place: int) -> int:
        """An index of the buffer, counted from the first sample fed."""
        return place + self._dropped

    def _usable(self) -> int:
        """Index of the first sample that is no finite number, in or near the burst; otherwise that after the last
        sample."""
        assert self._start is not None
        modem, first = self._modem, max(0, self._start - self._modem.margin)
        burst = self._buffer[first : min(self._start + modem.burst_samples + modem.margin, self._end)]
        return self._end if isfinite(np.vdot(burst, burst).real) else first + int(np.argmin(np.abs(burst) < _HUGE))

    def _remember(self, snrs: list[float]) -> None:
        self._snrs = (*self._snrs, *snrs)[-_LOOKED_BACK:]

    def _take(self) -> list[DemodulatedPacket]:
        packets: list[DemodulatedPacket] = []
        while True:
            if self._start is None:
                stretch = self._buffer[self._cursor : min(self._end, self._cursor + self._stretch)]
                found = self._modem.find(stretch)
                if found.start is not None:
                    self._start = self._cursor + found.start
                self._cursor += found.searched
                if found.start is None and found.searched:
                    continue
            if self._start is None or self._end - self._start < self._modem.span:
                return packets
            if self._last is not None and self._end < self._last:
                return packets
            usable = self._usable()
            whole = usable - self._start >= self._modem.span
            reading = self._modem.read(self._buffer[:usable], self._start) if whole else None
            if reading is not None and reading.soft is None and reading.end > self._end:
                self._last = reading.end
                return packets
            packet = None if reading is None else self._modem.unwrap(reading)
            if reading is None or packet is None:
                self.damaged += 1
                self._cursor = self._start + self._modem.peak_samples
            else:
                packets.append(DemodulatedPacket(packet, reading.snr, self._counted(reading.end), reading.mcs))
                self.points = reading.points
                self._remember([reading.snr])
                self._cursor = reading.end - self._modem.margin
            self._start = self._last = None


def _in_db(snr: float) -> float:
    return min(10 * log10(max(snr, 10 ** (_LEAST_SNR_DB / 10))), _MOST_SNR_DB)
