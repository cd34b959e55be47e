"""Push-to-talk: keys a transmitter while a burst sounds.

Invariants: a key is pressed when a burst begins and let go when its last frame has sounded, never before; it stays
pressed between bursts that follow each other; it is let go when the link stops, and nothing that fails leaves it
pressed as far as this process can help it. No thread of the sound card waits for a key.
"""

from __future__ import annotations

import atexit
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gr_ros2.core.errors import RadioError
from gr_ros2.radio.audio_bursts import Played

_TOGETHER_S = 0.05
"""Silence between two bursts, s, in which the key stays pressed: a relay needs as long to fall and close again."""
_ANSWER_S = 2.0
"""s that rigctld may take to answer."""
_RIGCTLD_PORT = 4532
_CM108_PIN = 3
"""The pin of a CM108 sound chip that interfaces for radios key with."""


class KeyLine(ABC):
    """A line that keys a transmitter.

    :param where: device or address
    :raises OSError: when it cannot be opened
    """

    example = ""
    """Example of ``where``."""

    @abstractmethod
    def __init__(self, where: str) -> None: ...

    @abstractmethod
    def press(self, *, on: bool) -> None:
        """Press or let go.

        :raises OSError: when that failed
        """

    def close(self) -> None:  # noqa: B027 - most have nothing to release
        """Release the line."""


class _SerialLine(KeyLine):
    example = "/dev/ttyUSB0"
    line = ""

    def __init__(self, where: str) -> None:
        import serial

        self._port: Any = serial.serial_for_url(where, do_not_open=True)
        self._port.rts = self._port.dtr = False  # before it is open, so that nothing is keyed while it opens
        self._port.open()

    def press(self, *, on: bool) -> None:
        setattr(self._port, self.line, on)

    def close(self) -> None:
        self._port.close()


class RtsLine(_SerialLine):
    """The line RTS of a serial port."""

    line = "rts"


class DtrLine(_SerialLine):
    """The line DTR of a serial port."""

    line = "dtr"


class RigctldLine(KeyLine):
    """Hamlib's ``rigctld``, over TCP."""

    example = f"localhost:{_RIGCTLD_PORT}"

    def __init__(self, where: str) -> None:
        host, _, port = where.partition(":")
        self._socket = socket.create_connection((host, int(port or _RIGCTLD_PORT)), _ANSWER_S)
        self._answers = self._socket.makefile("r")

    def press(self, *, on: bool) -> None:
        self._socket.sendall(b"T %d\n" % on)
        answer = self._answers.readline().strip()
        if answer != "RPRT 0":
            raise OSError(f"rigctld answered {answer!r}" if answer else "rigctld closed the connection")

    def close(self) -> None:
        self._answers.close()
        self._socket.close()


class Cm108Line(KeyLine):
    """A pin of a CM108 or CM119 sound chip, by its HID device."""

    example = "/dev/hidraw0"

    def __init__(self, where: str) -> None:
        self._device = Path(where).open("wb", buffering=0)

    def press(self, *, on: bool) -> None:
        pin = 1 << (_CM108_PIN - 1)
        self._device.write(bytes([0, 0, pin if on else 0, pin, 0]))  # report, 0, values, directions, 0

    def close(self) -> None:
        self._device.close()


KEYS: Mapping[str, type[KeyLine]] = {"rts": RtsLine, "dtr": DtrLine, "rigctld": RigctldLine, "cm108": Cm108Line}
"""By the name that ``ptt`` takes."""


class Keyer:
    """Presses a key while bursts sound.

    :param kind: a name of ``KEYS``
    :param where: device or address
    :raises RadioError: when it cannot be opened
    """

    def __init__(self, kind: str, where: str) -> None:
        self._said = f"ptt = {kind!r}, ptt_device = {where!r}"
        try:
            self._key = KEYS[kind](where)
            self._key.press(on=False)  # whoever keyed it last may have died
        except (OSError, ValueError) as error:
            raise RadioError(
                f"front_end audio: {self._said}: {' '.join(str(error).split())}; ptt_device looks like "
                f"{KEYS[kind].example}"
            ) from error
        self._times: deque[Played] = deque()
        self._changed = threading.Condition()
        self._open = True
        self._trouble: RadioError | None = None
        self._thread = threading.Thread(target=self._run, name="ptt", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # a program may end without closing its radio

    def key(self, played: Played) -> None:
        """Press from the begin of a burst to its end. Bursts come in order."""
        with self._changed:
            if self._times and played.begin <= self._times[-1].end + _TOGETHER_S:
                played = Played(self._times.pop().begin, played.end)
            self._times.append(played)
            self._changed.notify()

    def check(self) -> None:
        """:raises RadioError: when a key could not be pressed or let go"""
        if self._trouble is not None:
            raise self._trouble

    def close(self) -> None:
        """Let go. Idempotent."""
        atexit.unregister(self.close)
        with self._changed:
            self._open = False
            self._changed.notify()
        self._thread.join(2 * _ANSWER_S)

    def _run(self) -> None:
        pressed = False
        try:
            while self._open:
                with self._changed:
                    now = time.monotonic()
                    while self._times and self._times[0].end <= now:
                        self._times.popleft()
                    first = self._times[0] if self._times else None
                    wanted = first is not None and first.begin <= now
                    if wanted == pressed and self._open:
                        at = None if first is None else first.end if wanted else first.begin
                        self._changed.wait(None if at is None else at - now)
                        continue
                # No lock: a key may take a while, and the sound card must not wait.
                self._key.press(on=wanted)
                pressed = wanted
        except (OSError, ValueError) as error:
            self._trouble = RadioError(f"front_end audio: {self._said}: {' '.join(str(error).split())}")
        finally:
            with suppress(OSError, ValueError):
                self._key.press(on=False)
            with suppress(OSError, ValueError):
                self._key.close()
