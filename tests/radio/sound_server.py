"""A sound server of its own for a test, with loudspeakers that nobody hears and microphones that hear them."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.waiting import wait_for


class SoundServer:
    """PulseAudio with null sinks `a` and `b`, whose monitors are microphones.

    :param folder: for its socket
    """

    def __init__(self, folder: Path) -> None:
        self.env = {"PULSE_RUNTIME_PATH": str(folder), "PULSE_SERVER": f"unix:{folder}/native", "HOME": str(folder)}
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        sinks = [f"module-null-sink sink_name={name} rate=48000 channels=1" for name in "ab"]
        modules = [f"module-native-protocol-unix auth-anonymous=1 socket={self.env['PULSE_SERVER'][5:]}", *sinks]
        loads = [option for module in modules for option in ("-L", module)]
        command = ["pulseaudio", "-n", "--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no", *loads]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        environment = {**os.environ, **self.env}
        self._process = subprocess.Popen(command, env=environment, **quiet)
        asks = ["pactl", "list", "short", "sinks"]
        wait_for(lambda: b"\tb\t" in subprocess.run(asks, env=environment, capture_output=True).stdout, longest_s=0.2)

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def sound_server_or_skip(folder: Path) -> SoundServer:
    """A server, where there is all that it needs."""
    pytest.importorskip("gr_ros2.radio.audio_card", reason="needs sounddevice and libportaudio2", exc_type=ImportError)
    for program in ("pulseaudio", "pactl"):
        if not shutil.which(program):
            pytest.skip("needs PulseAudio: apt install pulseaudio pulseaudio-utils libasound2-plugins")
    return SoundServer(folder)
