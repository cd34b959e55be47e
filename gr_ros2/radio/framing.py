"""How packets are told apart in a stream of bytes: SLIP (RFC 1055), COBS and KISS. Sans-IO.

Invariants: whatever bytes arrive, memory is bounded by the longest frame, and reading starts again after the next
delimiter. A frame that is wrong or too long is dropped and counted. Nothing here tells whether a frame is damaged: the
packets inside have a check of their own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from typing import ClassVar

_END, _ESC, _ESC_END, _ESC_ESC = b"\xc0", b"\xdb", b"\xdc", b"\xdd"
_COBS_BLOCK = 254
"""Most bytes without a zero that one code byte of COBS can stand before."""
_DATA_FRAME = 0
"""KISS's command for data, in the low four bits of the first byte; the port is in the high four."""


class Framing(ABC):
    """Frames in one direction of a stream. A new stream needs a new one.

    :param longest: bytes of the longest packet that is accepted
    :param dropped: counts frames that are dropped, by reason: ``malformed``, ``too_long``
    :param rssi: the radio adds a byte behind each packet that it received: the strength of the signal
    :ivar rssi_dbm: that of the newest packet, dBm; None before the first
    """

    delimiter: ClassVar[bytes]

    def __init__(self, longest: int, dropped: Counter[str] | None = None, *, rssi: bool = False) -> None:
        self._longest = longest
        self._rssi = rssi
        self.rssi_dbm: int | None = None
        self._most = 2 * longest + 8  # SLIP may double every byte
        self._begun = bytearray()
        self._skipping = False
        self.dropped: Counter[str] = Counter() if dropped is None else dropped

    @property
    def held(self) -> int:
        """Bytes of the frame that has begun."""
        return len(self._begun)

    @abstractmethod
    def frame(self, packet: bytes) -> bytes:
        """A packet as bytes of the stream."""

    @abstractmethod
    def _content(self, frame: bytes) -> bytes | None:
        """The packet in what stood between two delimiters; None if there is none.

        :raises ValueError: when no sender writes such a frame
        """

    def feed(self, data: bytes) -> Iterator[bytes]:
        """The packets that are complete with these bytes of the stream."""
        *ended, rest = data.split(self.delimiter)
        for part in ended:
            self._add(part)
            frame, skipped = bytes(self._begun), self._skipping
            self._begun.clear()
            self._skipping = False
            if self._rssi and len(frame) == 1:
                self.rssi_dbm = frame[0] - 256  # as the modules' manuals have it
            elif frame and not skipped and (packet := self._packet(frame)) is not None:
                yield packet
        self._add(rest)

    def _add(self, part: bytes) -> None:
        if self._skipping:
            return
        if len(self._begun) + len(part) > self._most:
            self._begun.clear()
            self._skipping = True
            self.dropped["too_long"] += 1
        else:
            self._begun += part

    def _packet(self, frame: bytes) -> bytes | None:
        try:
            packet = self._content(frame)
        except ValueError:
            self.dropped["malformed"] += 1
            return None
        if packet is not None and len(packet) > self._longest:
            self.dropped["too_long"] += 1
            return None
        return packet


class Slip(Framing):
    """RFC 1055, with a delimiter also in front, which ends what noise has left."""

    delimiter = _END

    def frame(self, packet: bytes) -> bytes:
        return _END + packet.replace(_ESC, _ESC + _ESC_ESC).replace(_END, _ESC + _ESC_END) + _END

    def _content(self, frame: bytes) -> bytes | None:
        first, *parts = frame.split(_ESC)
        return first + b"".join(_unescaped(part) for part in parts)


def _unescaped(part: bytes) -> bytes:
    """What stands after an escape byte, the escape undone."""
    if part.startswith(_ESC_END):
        return _END + part[1:]
    if part.startswith(_ESC_ESC):
        return _ESC + part[1:]
    raise ValueError("an escape byte stands before a byte that it does not escape")


class Kiss(Slip):
    """KISS (Chepponis and Karn, 1987): SLIP with a byte of port and command in front.

    Frames for other ports, and commands that are not data, are ignored.

    :param port: of the TNC, 0..15
    """

    def __init__(self, longest: int, dropped: Counter[str] | None = None, *, port: int = 0) -> None:
        super().__init__(longest, dropped)
        self._command = bytes([port << 4 | _DATA_FRAME])

    def frame(self, packet: bytes) -> bytes:
        return super().frame(self._command + packet)

    def _content(self, frame: bytes) -> bytes | None:
        content = super()._content(frame)
        return content[1:] if content and content[:1] == self._command else None


class Cobs(Framing):
    """Consistent overhead byte stuffing (Cheshire and Baker, 1999), with a zero behind each packet and one in front.

    It adds one byte in 254 at most, where SLIP may double a packet.
    """

    delimiter = b"\0"

    def frame(self, packet: bytes) -> bytes:
        blocks = bytearray(self.delimiter)
        for run in packet.split(b"\0"):
            full = len(run) // _COBS_BLOCK
            for place in range(full):
                blocks += b"\xff" + run[place * _COBS_BLOCK : (place + 1) * _COBS_BLOCK]
            rest = run[full * _COBS_BLOCK :]
            blocks += bytes([len(rest) + 1]) + rest
        return bytes(blocks) + self.delimiter

    def _content(self, frame: bytes) -> bytes | None:
        packet = bytearray()
        place = 0
        while place < len(frame):
            code = frame[place]
            end = place + code
            if end > len(frame):
                raise ValueError("the last block is cut")
            packet += frame[place + 1 : end]
            place = end
            if code <= _COBS_BLOCK and place < len(frame):
                packet += b"\0"
        return bytes(packet)
