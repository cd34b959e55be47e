"""Sound servers of their own for a test, with loudspeakers that nobody hears and microphones that hear them."""

from __future__ import annotations

import os
import shutil
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

import pytest

from tests.waiting import wait_for

_QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


class SoundServer(ABC):
    """A server with null sinks `a` and `b`, whose monitors are microphones.

    :param folder: for its socket
    :ivar env: what a program needs to find it, whichever it is, through ALSA's device ``pulse``
    """

    needs: ClassVar[Sequence[str]] = ()
    """Programs."""
    packages: ClassVar[str] = ""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.env = {"PULSE_RUNTIME_PATH": str(folder), "PULSE_SERVER": f"unix:{folder}/native", "HOME": str(folder)}
        self._processes: list[subprocess.Popen[bytes]] = []
        self.start()

    def start(self) -> None:
        self._environment = {**os.environ, **self.env}
        self._start()
        asks = ["pactl", "list", "short", "sinks"]
        wait_for(
            lambda: b"\tb\t" in subprocess.run(asks, env=self._environment, capture_output=True).stdout, longest_s=0.2
        )

    @abstractmethod
    def _start(self) -> None: ...

    def run(self, *command: str) -> None:
        """Start a program of the server."""
        self._processes.append(subprocess.Popen(command, env=self._environment, **_QUIET))

    def stop(self) -> None:
        while self._processes:
            process = self._processes.pop()
            process.kill()
            process.wait()


class PulseAudio(SoundServer):
    needs = ("pulseaudio", "pactl")
    packages = "pulseaudio pulseaudio-utils libasound2-plugins"

    def _start(self) -> None:
        sinks = [f"module-null-sink sink_name={name} rate=48000 channels=1" for name in "ab"]
        modules = [f"module-native-protocol-unix auth-anonymous=1 socket={self.env['PULSE_SERVER'][5:]}", *sinks]
        loads = [option for module in modules for option in ("-L", module)]
        self.run("pulseaudio", "-n", "--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no", *loads)


_SINK = """{{ factory = adapter args = {{ factory.name = support.null-audio-sink node.name = {name}
    media.class = Audio/Sink audio.position = [ MONO ] object.linger = true }} }}"""
_PIPEWIRE = """
context.properties = {{ core.daemon = true core.name = pipewire-0 }}
context.spa-libs = {{ audio.convert.* = audioconvert/libspa-audioconvert support.* = support/libspa-support }}
context.modules = [ {modules} ]
context.objects = [ {sinks} ]
"""
_MODULES = ("protocol-native", "metadata", "spa-node-factory", "client-node", "access", "adapter", "link-factory",
            "session-manager")  # fmt: skip


class PipeWire(SoundServer):
    """With WirePlumber, which connects what plays, and the server that speaks PulseAudio's protocol."""

    needs = ("pipewire", "wireplumber", "pipewire-pulse", "dbus-daemon", "pactl")
    packages = "pipewire pipewire-pulse wireplumber dbus-daemon pulseaudio-utils libasound2-plugins"

    def _start(self) -> None:
        bus = self.folder / "bus"
        self.env |= {
            **dict.fromkeys(("XDG_RUNTIME_DIR", "PIPEWIRE_RUNTIME_DIR"), str(self.folder)),
            "DBUS_SESSION_BUS_ADDRESS": f"unix:path={bus}",
        }
        self._environment |= self.env
        sinks = " ".join(_SINK.format(name=name) for name in "ab")
        modules = " ".join(f"{{ name = libpipewire-module-{name} }}" for name in _MODULES)
        config = self.folder / "pipewire.conf"
        config.write_text(_PIPEWIRE.format(modules=modules, sinks=sinks))
        with suppress(FileNotFoundError):
            bus.unlink()
        self.run("dbus-daemon", "--session", "--nofork", f"--address=unix:path={bus}")
        wait_for(bus.exists)
        self.run("pipewire", "-c", str(config))
        wait_for((self.folder / "pipewire-0").exists)
        for program in ("wireplumber", "pipewire-pulse"):
            self.run(program)


def sound_server_or_skip(folder: Path, kind: type[SoundServer] = PulseAudio) -> SoundServer:
    """A server, where there is all that it needs."""
    pytest.importorskip("gr_ros2.radio.audio_card", reason="needs sounddevice and libportaudio2", exc_type=ImportError)
    for program in kind.needs:
        if not shutil.which(program):
            pytest.skip(f"needs {kind.__name__}: apt install {kind.packages}")
    return kind(folder)
