"""What connects two modems in a test: a cable between two pseudo terminals, and audio between two TNCs."""

from __future__ import annotations

import os
import pty
import random
import select
import shutil
import socket
import subprocess
import threading
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from tests.domains import free_ports
from tests.waiting import wait_for

_CHUNK = 4096
_AUDIO = 1024
"""Bytes of audio that cross at once: 10.7 ms."""


class SerialCable:
    """Two serial lines whose bytes cross; ``ends`` are their devices. It can be pulled out and plugged in again.

    :ivar loses: share of what crosses at once that does not come
    """

    def __init__(self, folder: Path) -> None:
        self.ends = [folder / "tty-a", folder / "tty-b"]
        self.carried = 0
        self.loses, self._rng = 0.0, random.Random(1)
        self.plug()

    def plug(self) -> None:
        pairs = [pty.openpty() for _ in self.ends]
        self._masters = [master for master, _ in pairs]
        self._slaves = [slave for _, slave in pairs]  # kept open: a master without them reads errors
        for end, slave in zip(self.ends, self._slaves, strict=True):
            end.unlink(missing_ok=True)
            end.symlink_to(os.ttyname(slave))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def pull(self) -> None:
        self._stop.set()
        self._thread.join()
        for end in self.ends:
            end.unlink()
        for descriptor in (*self._slaves, *self._masters):
            os.close(descriptor)

    def _carry(self) -> None:
        first, second = self._masters
        while not self._stop.is_set():
            for ready in select.select(self._masters, [], [], 0.02)[0]:
                data = os.read(ready, _CHUNK)
                self.carried += len(data)
                if self._rng.random() < self.loses:
                    continue
                os.write(second if ready == first else first, data)

    def __enter__(self) -> SerialCable:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._stop.is_set():
            self.pull()


class Direwolves:
    """Two direwolf TNCs at 9600 baud. The audio that one sends is what the other hears.

    Each writes its audio to a named pipe (ALSA's plugin `file`), from which it goes to the other one as UDP. There is
    one line for each direction, so they are full duplex. In half duplex, direwolf from 1.7 on hears nothing while it
    sends.
    """

    _CONFIG = (
        "ADEVICE udp:{audio} tx\nARATE 48000\nACHANNELS 1\nCHANNEL 0\nMYCALL N0CALL\nMODEM 9600\nTXDELAY 5\n"
        "TXTAIL 2\nFULLDUP ON\nAGWPORT 0\nKISSPORT {kiss}\n"
    )

    def __init__(self, folder: Path) -> None:
        audio = free_ports(2)
        self.kiss = free_ports(2, socket.SOCK_STREAM)
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._programs: list[subprocess.Popen[bytes]] = []
        self._logs: list[Path] = []
        for number in range(2):
            home = folder / f"tnc-{number}"
            home.mkdir()
            pipe = home / "audio"
            os.mkfifo(pipe)
            device = f'type file slave.pcm null file "{pipe}" truncate true format "raw"'
            (home / ".asoundrc").write_text(f"pcm.tx {{ {device} }}\n")
            (home / "tnc.conf").write_text(self._CONFIG.format(audio=audio[number], kiss=self.kiss[number]))
            thread = threading.Thread(target=self._carry, args=(pipe, audio[1 - number]), daemon=True)
            thread.start()
            self._threads.append(thread)
            self._logs.append(home / "log")
            with self._logs[-1].open("wb") as log:
                program = shutil.which("direwolf") or "direwolf"
                self._programs.append(
                    subprocess.Popen(
                        ["stdbuf", "-oL", program, "-t", "0", "-c", str(home / "tnc.conf")],
                        env={**os.environ, "HOME": str(home)},
                        stdin=subprocess.DEVNULL,
                        stdout=log,
                        stderr=subprocess.STDOUT,
                        cwd=home,
                    )
                )

    def log(self) -> str:
        return "\n".join(path.read_text(errors="replace") for path in self._logs)

    def _listens(self, port: int) -> bool:
        with suppress(OSError), socket.create_connection(("localhost", port), 1.0):
            return True
        return False

    def _carry(self, pipe: Path, port: int) -> None:
        # Opened for reading and writing, so that neither opening nor an end of the writer blocks.
        descriptor = os.open(pipe, os.O_RDWR | os.O_NONBLOCK)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not self._stop.is_set():
                ready, _, _ = select.select([descriptor], [], [], 0.02)
                # Silence crosses too: a TNC counts time in samples, and would find the channel busy for ever.
                audio = os.read(descriptor, _AUDIO) if ready else bytes(_AUDIO)
                out.sendto(audio, ("127.0.0.1", port))
                self._stop.wait(0.005)  # a TNC that is flooded loses some
        os.close(descriptor)

    def __enter__(self) -> Direwolves:
        try:
            for port in self.kiss:
                wait_for(lambda: self._listens(port), f"direwolf at port {port}")  # noqa: B023 - called at once
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End both, and the audio between them."""
        for program in self._programs:
            program.terminate()
        for program in self._programs:
            program.wait()
        self._stop.set()
        for thread in self._threads:
            thread.join()
