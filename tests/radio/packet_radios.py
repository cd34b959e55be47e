"""Packet radios on pseudo terminals, which lose what real ones lose: bytes for which their buffer has no room, packets
that overlap on the air, and packets that arrive while their receiver sends.

Times are real. The figures are those of the makers: buffers and turns of SiK's firmware (serial.c, tdm.c), E22 and E32
manuals and Semtech's formula of the airtime of LoRa, and the KISS paper.
"""

from __future__ import annotations

import os
import pty
import random
import select
import termios
import threading
import time
import tty
from collections import deque
from contextlib import suppress
from math import ceil
from pathlib import Path
from types import TracebackType

_STEP_S = 0.001
_CHUNK = 4096
_FEND = b"\xc0"


class Radio:
    """One radio: what the computer writes waits in ``buffer`` until the air takes it.

    :param line: the device that a program opens
    """

    room = 1024
    """Bytes of the buffer."""
    byte_s = 10 / 57_600
    """s that a byte takes on the serial line."""

    def __init__(self, line: Path) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        os.set_blocking(self.master, False)
        line.unlink(missing_ok=True)
        line.symlink_to(os.ttyname(self._slave))
        self.buffer = bytearray()
        self.overflowed = self.heard = self.deaf = 0
        """Bytes for which the buffer had no room; packets received; packets not received while sending."""
        self.sends_until = 0.0
        self._line_free = 0.0
        self._written = 0.0

    def read_line(self, now: float) -> None:
        """Take what the serial line has brought by now, at its speed."""
        most = int((now - self._line_free) / self.byte_s)
        if most <= 0:
            return
        data = b""
        if select.select([self.master], [], [], 0)[0]:
            data = os.read(self.master, min(most, _CHUNK))
        self._line_free = now if len(data) < most else self._line_free + len(data) * self.byte_s
        if data:
            self._written = now
            room = self.room - len(self.buffer)
            self.overflowed += max(0, len(data) - room)
            self.buffer += data[:room]

    def next(self, now: float, busy: bool) -> tuple[bytes, float] | None:
        """The packet that it sends now, and s that it is on the air."""
        raise NotImplementedError

    def receive(self, packet: bytes) -> None:
        """A packet has arrived. What the computer does not read in time is lost, as at any UART."""
        self.heard += 1
        with suppress(BlockingIOError):
            os.write(self.master, packet)

    def close(self) -> None:
        os.close(self.master)
        os.close(self._slave)


class LoraUart(Radio):
    """An E22 or E32 module at 57,600 baud and 19.2k on the air: packets of 58 bytes, sent when they are full or when no
    byte has come for a while."""

    room = 512
    packet = 58
    idle_s = 0.003

    def next(self, now: float, busy: bool) -> tuple[bytes, float] | None:  # noqa: ARG002 - it does not listen first
        if len(self.buffer) < self.packet and (not self.buffer or now < self._written + self.idle_s):
            return None
        data = bytes(self.buffer[: self.packet])
        del self.buffer[: self.packet]
        # Semtech SX1276, 4.1.1.7: SF 7, 500 kHz, code rate 4/5, header and CRC.
        symbols = 12.25 + 8 + 5 * max(ceil((8 * len(data) - 4 * 7 + 28 + 16) / (4 * 7)), 0)
        return data, symbols * 2**7 / 500e3

    def receive(self, packet: bytes) -> None:
        super().receive(packet + bytes([256 - 71]))


class Sik(Radio):
    """A SiK radio: 64,000 bits/s, and by turns with the other one. In its turn it sends packets of 232 bytes."""

    room = 1850
    window_s, silence_s = 0.11, 0.006
    packet, headers = 232, 20

    def __init__(self, line: Path, turn: int) -> None:
        super().__init__(line)
        self._turn = turn

    def next(self, now: float, busy: bool) -> tuple[bytes, float] | None:  # noqa: ARG002 - nobody else has the turn
        whole = self.window_s + self.silence_s
        turn, into = divmod(now, whole)
        data = bytes(self.buffer[: self.packet])
        airtime = (len(data) + self.headers) * 8 / 64_000
        if int(turn) % 2 != self._turn or not data or into + airtime > self.window_s:
            return None
        del self.buffer[: self.packet]
        return data, airtime


class Tnc(Radio):
    """A KISS TNC at 9,600 bits/s that listens before it sends, with room for 4 frames."""

    room = 1024
    frames = 4
    txdelay_s, bit_rate, slot_s, persistence = 0.1, 9600, 0.05, 0.25

    def __init__(self, line: Path, rng: random.Random) -> None:
        super().__init__(line)
        self._rng = rng
        self._waiting: deque[bytes] = deque()
        self._look_at = 0.0

    def next(self, now: float, busy: bool) -> tuple[bytes, float] | None:
        while _FEND in self.buffer:
            frame, _, rest = bytes(self.buffer).partition(_FEND)
            self.buffer[:] = rest
            if frame and len(self._waiting) < self.frames:
                self._waiting.append(frame)
            elif frame:
                self.overflowed += len(frame)
        if not self._waiting or now < self._look_at:
            return None
        self._look_at = now + self.slot_s
        if busy or self._rng.random() > self.persistence:
            return None
        frame = self._waiting.popleft()
        return _FEND + frame + _FEND, self.txdelay_s + 8 * len(frame) / self.bit_rate


class SlowTnc(Tnc):
    """The same at 1,200 bits/s, with the TXDELAY and the slots of the KISS paper."""

    txdelay_s, bit_rate, slot_s = 0.3, 1200, 0.1


class Channel:
    """The air between radios on one frequency, while it is entered.

    :ivar collided: packets that another one overlapped
    """

    def __init__(self, *radios: Radio) -> None:
        self.radios = radios
        self.collided = 0
        self._flying: list[_Flight] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        while not self._stop.wait(_STEP_S):
            now = time.monotonic()
            for flight in [flight for flight in self._flying if flight.end <= now]:
                self._flying.remove(flight)
                self._land(flight)
            for radio in self.radios:
                radio.read_line(now)
                if radio.sends_until <= now and (leaving := radio.next(now, bool(self._flying))) is not None:
                    data, airtime = leaving
                    radio.sends_until = now + airtime
                    flight = _Flight(radio, data, now + airtime)
                    for other in self._flying:
                        other.touched.add(radio)
                        flight.touched.add(other.sender)
                    self._flying.append(flight)

    def _land(self, flight: _Flight) -> None:
        self.collided += bool(flight.touched)
        for radio in self.radios:
            if radio in flight.touched:
                radio.deaf += 1
            elif radio is not flight.sender and not flight.touched:
                radio.receive(flight.data)

    def __enter__(self) -> Channel:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        for radio in self.radios:
            radio.close()


class _Flight:
    """A packet on the air.

    :ivar touched: the senders of packets that overlap it
    """

    def __init__(self, sender: Radio, data: bytes, end: float) -> None:
        self.sender, self.data, self.end = sender, data, end
        self.touched: set[Radio] = set()
