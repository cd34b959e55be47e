"""`gr-ros2 sound check` on a real sound server, and what it says of what it found."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
pytest.importorskip("gr_ros2.radio.audio_card", reason="needs sounddevice and libportaudio2", exc_type=ImportError)

from gr_ros2.cli.sound import said
from gr_ros2.radio.sound_check import SoundMeasured
from tests.programs import run_program
from tests.radio.sound_server import sound_server_or_skip


def check(env: dict[str, str], *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gr_ros2.cli", "sound", "check", *options]
    return run_program(command, env={**os.environ, **env}, capture_output=True, text=True)


@pytest.mark.slow
def test_a_loudspeaker_that_the_microphone_hears(tmp_path: Path) -> None:
    server = sound_server_or_skip(tmp_path)
    try:
        env = {**server.env, "PULSE_SINK": "a", "PULSE_SOURCE": "a.monitor"}
        done = check(env, "--device", "pulse")
        assert done.returncode == 0, done.stderr
        assert "pulse" in done.stdout and "round trip" in done.stdout and "--radio sound fits" in done.stdout
        done = check({**env, "PULSE_SOURCE": "b.monitor"}, "--device", "pulse")
        assert done.returncode == 1 and "digital silence" in done.stdout
        assert check(env, "--device", "pulse", "--listen-only").returncode == 0
        done = check(env, "--device", "nowhere")
        assert (done.returncode, len(done.stderr.splitlines())) == (1, 1) and "nowhere" in done.stderr
    finally:
        server.stop()


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"clipped": 0.2}, "clipped"),
        ({"level_db": -60.0}, "weak"),
        ({"echo_s": 1.2}, "--radio hall fits"),
        ({"heard": False}, "not heard"),
    ],
)
def test_each_trouble_has_its_remedy(changed: dict[str, float], word: str) -> None:
    whole = {"heard": True, "level_db": -20.0, "noise_db": -60.0, "clipped": 0.0, "silent": False}
    lines = said(SoundMeasured(**{**whole, "round_trip_s": 0.1, "echo_s": 0.3, "direct_db": 3.0, **changed}))
    assert any(word in line for line in lines)
