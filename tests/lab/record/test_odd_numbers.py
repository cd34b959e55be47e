"""Numbers in messages that no robot means: the messages pass, and nothing that is computed of them is lost."""

from __future__ import annotations

import struct
from collections.abc import Callable
from math import inf, nan
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli.main import run
from gr_ros2.core.errors import BagError
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.middleware.bag_recorder import BagRecorder
from gr_ros2.middleware.base import Qos
from gr_ros2_lab.record.result import Result, read_result
from gr_ros2_lab.report.table import notes
from gr_ros2_lab.run.outcome import DELIVERED_BAG
from gr_ros2_lab.run.replay import replay
from gr_ros2_lab.run.scenario import load_scenario
from tests.e2e.support import check_books
from tests.lab.record.runs import odometry

TOPIC = "/robot_1/odom"
COUNT = 60
ODD = {7: (nan, 0.0), 20: (0.0, inf), 33: (1e200, -1e200), 40: (-inf, nan)}
STAMPS = {3: (-(2**31), 2**32 - 1), 9: (2**31 - 1, 2**32 - 1), 11: (-1, 0)}
TORN = {50: b"\0\1\0\0", 52: b"\0\1\0\0" + b"\xff" * 60}
"""By place in the recording: positions, header stamps, and payloads that are no odometry at all."""


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A drive along a line, with odd numbers in some messages."""
    path = tmp_path / "in"
    recorder = BagRecorder(path, "mcap", {}, lambda *_: None)
    channel = recorder.channel(TOPIC, "nav_msgs/msg/Odometry", Qos())
    for place in range(COUNT):
        payload = bytearray(odometry(*ODD.get(place, (place / 10, 1.0))))
        if place in STAMPS:
            payload[4:12] = struct.pack("<iI", *STAMPS[place])
        recorder.write(channel, 10**18 + place * 20_000_000, TORN.get(place, bytes(payload)))
    recorder.close()
    return path


def replayed(recording: Path, out: Path, *overrides: str) -> tuple[Result, Path]:
    scenario = load_scenario("paper-direct", overrides, duration_s=0.0, source=f"bag:{recording}")
    done = replay(recording, out / "out.mcap", scenario)
    return done.outcome.result, out / "out.mcap"


def as_run(recording: Path, out: Path, *overrides: str) -> tuple[Result, Path]:
    words = [f"source=bag:{recording}", "graph.middleware=memory", *overrides]
    command = ["run", "paper-direct", "--out", str(out), "--duration", "0"]
    assert run([*command, *(word for override in words for word in ("--set", override))]) == 0
    return read_result(out), out / DELIVERED_BAG


@pytest.mark.parametrize(
    ("way", "overrides"),
    [
        (replayed, ("time=packets",)),
        (replayed, ("time=samples",)),
        (replayed, ("time=packets", "compression=true")),
        (as_run, ("time=packets",)),
        (as_run, ("time=real",)),
    ],
)
def test_the_message_passes_and_its_point_is_left_out_and_counted(
    recording: Path, tmp_path: Path, way: Callable[..., tuple[Result, Path]], overrides: tuple[str, ...]
) -> None:
    result, bag = way(recording, tmp_path / "made", *overrides)
    check_books(result)
    (topic,) = result.topics
    assert (topic.sent, topic.delivered) == (COUNT, COUNT)
    assert (topic.left_out_sent, topic.left_out_received) == (len(ODD) + len(TORN),) * 2
    assert topic.path_error_m == pytest.approx(0, abs=1e-6)
    assert topic.rms_error_m is not None
    assert topic.rms_error_m < 1
    assert any("6 messages sent and 6 received have no position" in line for line in notes(result))
    assert [one.payload[:60] for one in read_bag(bag)] == [one.payload[:60] for one in read_bag(recording)]
    report = tmp_path / "made" / "report.html"
    if way is as_run:
        assert "6 messages sent and 6 received have no position" in report.read_text()


def test_a_recording_with_a_stamp_that_was_never_set_is_refused_at_once(tmp_path: Path) -> None:
    recorder = BagRecorder(tmp_path / "in", "mcap", {}, lambda *_: None)
    channel = recorder.channel("/tf_static", "std_msgs/msg/String", Qos("reliable", "transient_local", 1))
    for stamp_ns in (0, 10**18):
        recorder.write(channel, stamp_ns, b"\0\1\0\0\2\0\0\0a\0")
    recorder.close()
    with pytest.raises(BagError, match="/tf_static was recorded 11574 days after"):
        replayed(tmp_path / "in", tmp_path / "made", "time=packets")
    assert not (tmp_path / "made" / "out.mcap").exists()
