"""Other programs that send data as sound, as what makes sound of texts and texts of sound.

Each is left out where it is not installed: `ggwave` (PyPI), `minimodem`, `direwolf` and `libcodec2` (Debian).
"""

from __future__ import annotations

import ctypes
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import suppress
from ctypes.util import find_library
from importlib import import_module
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy import signal
from scipy.io import wavfile

from bench.sound_channels import Wave
from gr_ros2.radio.audio_bursts import CARD_RATE

TEXT_LEN = 64
"""Letters of each text."""
_PIECE = 1024


class Peer(ABC):
    """A program, and how it was set."""

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def spoken(self, text: str) -> Wave:
        """The sound of a text."""

    @abstractmethod
    def heard(self, sound: Wave) -> str:
        """All that it prints of a sound."""


class _Ggwave(Peer):
    def __init__(self, name: str, protocol: int) -> None:
        super().__init__(name)
        self._module: Any = import_module("ggwave")
        self._module.disableLog()
        self._protocol = protocol

    def spoken(self, text: str) -> Wave:
        return np.frombuffer(self._module.encode(text, protocolId=self._protocol, volume=25), np.float32)

    def heard(self, sound: Wave) -> str:
        own = self._module.init()
        samples = sound.astype(np.float32)
        pieces = (samples[at : at + _PIECE].tobytes() for at in range(0, len(samples) - _PIECE, _PIECE))
        found = [got.decode(errors="replace") for piece in pieces if (got := self._module.decode(own, piece))]
        self._module.free(own)
        return "\n".join(found)


class _Program(Peer):
    """One that reads and writes files of sound."""

    def __init__(self, name: str, sends: Sequence[str], takes: Sequence[str], form: str) -> None:
        super().__init__(name)
        self._sends, self._takes, self._form = sends, takes, form

    def spoken(self, text: str) -> Wave:
        with TemporaryDirectory() as folder:
            words, out = Path(folder) / "text", Path(folder) / "sound.wav"
            words.write_text(self._form.format(text))
            command = [word.format(text=words, sound=out) for word in self._sends]
            subprocess.run(command, stdin=words.open(), check=True, capture_output=True)
            rate, samples = wavfile.read(out)
        assert rate == CARD_RATE
        return np.asarray(samples / np.abs(samples).max())

    def heard(self, sound: Wave) -> str:
        with TemporaryDirectory() as folder:
            out = Path(folder) / "sound.wav"
            wavfile.write(out, CARD_RATE, np.int16(sound / np.abs(sound).max() * 30000))
            command = [word.format(sound=out) for word in self._takes]
            return subprocess.run(command, capture_output=True, check=False).stdout.decode(errors="replace")


class _FreeDv(Peer):
    """A data mode of FreeDV: each text is a burst of as few frames as hold it, each with its own check sum, as its
    program `freedv_data_raw_tx` makes it."""

    _RATE, _PEAK = 8000, 32767

    def __init__(self, name: str, mode: int) -> None:
        super().__init__(name)
        self._library = ctypes.CDLL(find_library("codec2"))
        self._library.freedv_open.restype = ctypes.c_void_p
        self._library.freedv_gen_crc16.restype = ctypes.c_ushort
        self._mode = mode

    def _open(self) -> ctypes.c_void_p:
        opened = ctypes.c_void_p(self._library.freedv_open(self._mode))
        assert opened
        return opened

    def _frame_bytes(self, opened: ctypes.c_void_p) -> int:
        return int(self._library.freedv_get_bits_per_modem_frame(opened)) // 8

    def spoken(self, text: str) -> Wave:
        opened = self._open()
        holds = self._frame_bytes(opened) - 2
        room = (ctypes.c_short * (self._library.freedv_get_n_tx_modem_samples(opened) + self._RATE))()
        parts = [np.array(room[: self._library.freedv_rawdatapreambletx(opened, room)])]
        for at in range(0, len(text), holds):
            data = text[at : at + holds].encode().ljust(holds, b"\0")
            check = self._library.freedv_gen_crc16(data, holds)
            self._library.freedv_rawdatatx(opened, room, data + check.to_bytes(2, "big"))
            parts.append(np.array(room[: self._library.freedv_get_n_tx_modem_samples(opened)]))
        parts.append(np.array(room[: self._library.freedv_rawdatapostambletx(opened, room)]))
        self._library.freedv_close(opened)
        return np.asarray(signal.resample_poly(np.concatenate(parts) / self._PEAK, CARD_RATE // self._RATE, 1))

    def heard(self, sound: Wave) -> str:
        opened = self._open()
        slow = signal.resample_poly(sound, 1, CARD_RATE // self._RATE)
        samples = (slow / np.abs(slow).max() * self._PEAK * 0.7).astype(np.int16)
        took, at = (ctypes.c_ubyte * self._frame_bytes(opened))(), 0
        holds = self._frame_bytes(opened) - 2
        found = []
        self._library.freedv_set_frames_per_burst(opened, -(-TEXT_LEN // holds))
        while at + (wants := int(self._library.freedv_nin(opened))) <= len(samples):
            block = np.ascontiguousarray(samples[at : at + wants])
            count = self._library.freedv_rawdatarx(opened, took, block.ctypes.data_as(ctypes.c_void_p))
            if count:
                found.append(bytes(took)[: count - 2].rstrip(b"\0").decode(errors="replace"))
            at += wants
        self._library.freedv_close(opened)
        return "".join(found)


def peers() -> Iterator[Peer]:
    """Those that are installed."""
    with suppress(ImportError):
        yield from (_Ggwave(f"ggwave, {name}", protocol) for name, protocol in (("slowest", 0), ("fastest", 2)))
    if which("minimodem"):
        for baud in ("300", "1200"):
            sends = ("minimodem", "--tx", baud, "-R", str(CARD_RATE), "-f", "{sound}")
            yield _Program(f"minimodem {baud}", sends, ("minimodem", "--rx", baud, "-q", "-f", "{sound}"), "\n{}\n")
    if which("gen_packets") and which("atest"):
        makes = ("gen_packets", "-r", str(CARD_RATE), "-o", "{sound}", "{text}")
        yield _Program("direwolf 1200", makes, ("atest", "{sound}"), "N0CALL>N0CALL:{}\n")
    if find_library("codec2"):
        yield from (_FreeDv(f"FreeDV {name}", mode) for name, mode in (("DATAC0", 14), ("DATAC1", 10), ("DATAC3", 12)))
