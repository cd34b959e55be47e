"""`gr-ros2 spectrum`, of a running link and of a front end that it opens itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.radio.occupancy import busy_words
from tests.cli.test_status import Ends, ends  # noqa: F401 - a fixture
from tests.radio.test_spectrum import RATE, carrier, noise, recording
from tests.waiting import wait_for


def robot(folder: Path) -> Path:
    """The settings of a link that hears a carrier."""
    samples = noise(400, np.random.default_rng(1))
    samples += carrier(400, 24)
    front_end = {**recording(folder / "in", samples, 433.2e6), "write": ""}
    file = folder / "robot.yaml"
    file.write_text(
        f"robot: /robot_1\ntopics: [odom]\ngraph: {{middleware: memory}}\nphy: {{name: psk, sample_rate: {RATE}}}\n"
        f"front_end: {json.dumps(front_end)}\nstate: {folder / 'state'}\n"
    )
    return file


def test_the_front_end_of_a_file_is_heard_and_nothing_is_sent(ends: Ends, tmp_path: Path) -> None:  # noqa: F811
    file = robot(tmp_path)
    shown = ends.run("spectrum", str(file), "--for", "0.5", "--set", f"front_end.write={tmp_path / 'sent'}")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "file around 433.2 MHz, 1,000,000 samples/s; noise -" in shown.stdout
    assert "busy: 433.45 to 433.4812 MHz for 100.0% of the time" in shown.stdout
    assert "█" * 40 in shown.stdout
    assert not list(tmp_path.glob("sent*"))
    told = ends.run("spectrum", str(file), "--for", "0.5", "--json")
    (radio,) = json.loads(told.stdout)
    assert [number for number, part in enumerate(radio["parts"]) if part["busy"] > 0.9] == [24]


def test_a_running_link_listens(ends: Ends, tmp_path: Path) -> None:  # noqa: F811
    ends.files.append(robot(tmp_path))
    link = ends.link(3)
    wait_for(lambda: ends.run("status", "--json").returncode == 0, "the link")
    (radio,) = json.loads(ends.run("spectrum", "--for", "0.5", "--json", "--pid", str(link.pid)).stdout)
    assert radio["parts"][24]["busy"] > 0.9
    assert json.loads(ends.run("status", "--json").stdout)["airtime"]["transmits"]
    changed = ends.run("spectrum", "--set", "packet_len=64")
    assert (changed.returncode, "--set needs CONFIG" in changed.stderr) == (2, True)


@pytest.mark.parametrize(
    ("front_end", "phy"),
    [
        ("{name: kiss, device: /dev/none}", "{name: modem}"),
        ("{name: serial, device: /dev/none}", "{name: modem}"),
        ("{name: udp, listen: '127.0.0.1:1', send_to: ['127.0.0.1:1']}", "{name: modem}"),
        ("{name: zmq, bind: 'tcp://127.0.0.1:1'}", "{name: psk, sample_rate: 1e6}"),
        ("{name: sim}", "{name: ofdm, sample_rate: 1e6}"),
    ],
)
def test_what_gives_no_samples_of_the_air_says_so_before_it_is_opened(
    ends: Ends,  # noqa: F811
    tmp_path: Path,
    front_end: str,
    phy: str,
) -> None:
    (tmp_path / "robot.yaml").write_text(f"robot: 1\ntopics: [odom]\nphy: {phy}\nfront_end: {front_end}\n")
    told = ends.run("spectrum", str(tmp_path / "robot.yaml"))
    assert (told.returncode, len(told.stderr.splitlines())) == (2, 1)
    assert "gr-ros2 spectrum needs soapy, uhd, pluto, audio or file" in told.stderr


def test_a_recording_that_cannot_be_read_and_one_without_a_signal(ends: Ends, tmp_path: Path) -> None:  # noqa: F811
    file = robot(tmp_path)
    told = ends.run("spectrum", str(file), "--set", "front_end.read=none")
    assert (told.returncode, len(told.stderr.splitlines())) == (2, 1)
    recording(tmp_path / "in", np.full(512 * 100, np.nan, np.complex64))
    silent = ends.run("spectrum", str(file), "--for", "0.2")
    assert (silent.returncode, len(silent.stderr.splitlines())) == (1, 1)
    assert "no samples, or zeros in 0.2 s" in silent.stderr


def test_the_busiest_is_said_first_with_neighbours_that_are_like_it() -> None:
    busy = [0.02, 0.25, 0.3, 0.02, 0.004, 0.5, 0.01]
    parts = [{"from_hz": n * 1e3, "to_hz": (n + 1) * 1e3, "busy": share} for n, share in enumerate(busy)]
    assert busy_words(parts, 1e3, "kHz") == (
        "busy: 5 to 6 kHz for 50.0% of the time; 1 to 3 kHz for 25.0% to 30.0%, most around 2.5 kHz, of the time; "
        "0 to 1 kHz for 2.0% of the time; 3 to 4 kHz for 2.0% of the time"
    )
    assert busy_words(parts[4:5], 1e3, "kHz") == "nothing stands out of the noise"
