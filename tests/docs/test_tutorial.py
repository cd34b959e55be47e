"""What the tutorial promises, asserted on what its own commands do; in simulated time, so that digits stay the same."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from gr_ros2_lab.record.result import read_result
from tests.docs.pages import blocks, commands
from tests.docs.test_docs import here
from tests.once import once

pytestmark = pytest.mark.slow


def step(*words: str) -> Iterator[list[str]]:
    """The tutorial's commands that begin with these words."""
    for block in blocks("sh"):
        if block.page == "docs/tutorial.md":
            yield from (line for line in commands(block) if line[: len(words)] == list(words))


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which somebody has done steps 2 and 3."""
    return once(tmp_path_factory, "walked", walk)


def walk(folder: Path) -> None:
    runs = list(step("gr-ros2", "run"))
    assert len(runs) == 2
    for words in runs:
        here(*words[1:], "--duration", "10", "--no-report", "--set", "time=samples", folder=folder)
    first, last = step("gr-ros2", "registry", "from-bag")
    (replay,) = step("gr-ros2", "replay")
    for name, words in (("first", first), ("replay", replay), ("last", last)):
        (folder / f"{name}.txt").write_text(here(*words[1:], folder=folder))


def test_step_1_all_arrives_and_the_papers_format_loses(tmp_path: Path) -> None:
    short = ("--duration", "10", "--no-report", "--set", "time=samples")
    here("demo", "--out", "new", *short, folder=tmp_path)
    here("demo", "--wire", "0", "--out", "old", *short, folder=tmp_path)
    new, old = (read_result(tmp_path / name).topics for name in ("new", "old"))
    assert all(topic.delivered == topic.sent for topic in new)
    first = sum(topic.ledger["delivered"] for topic in new if "delivered" in topic.ledger) / sum(t.sent for t in new)
    assert 0.85 < first < 0.95, "about nine of ten"
    pdr = {topic.topic.rpartition("/")[2]: topic.pdr or 0.0 for topic in old}
    assert 0.85 < pdr["cmd_vel"] < 0.95, "about a tenth of the small messages is lost"
    assert pdr["scan"] < 0.6, "most of the large ones"


def test_step_2_noise_shows_in_repair_and_all_arrives(walked: Path) -> None:
    clean, noisy = (read_result(walked / name) for name in ("clean", "noisy"))
    assert all(topic.delivered == topic.sent for result in (clean, noisy) for topic in result.topics)
    assert 0.08 < 1 - _arrived(walked / "clean") < 0.12, "a tenth of the packets"
    assert 0.2 < 1 - _arrived(walked / "noisy") < 0.3, "about a quarter"
    before, after = (sum(topic.ledger.get("repaired", 0) for topic in result.topics) for result in (clean, noisy))
    assert 1.7 < after / before < 2.6, "about twice as many"
    early, late = (result.topics[0] for result in (clean, noisy))
    assert early.topic == late.topic == "/robot_1/scan"
    assert (early.latency_s.p50 or 0) < (late.latency_s.p50 or 0)
    assert (early.latency_s.p99 or 0) < (late.latency_s.p99 or 0)


def _arrived(folder: Path) -> float:
    """Share of the packets with messages that arrived."""
    import numpy as np

    from gr_ros2_lab.record.trace import read_trace

    received = read_trace(folder).packets().times()[1]
    return float(np.mean(~np.isnan(received)))


def test_step_2_compare_shows_settings_first_and_only_what_differs(walked: Path, tmp_path: Path) -> None:
    for name in ("clean", "noisy"):
        shutil.copytree(walked / name, tmp_path / name)
    results = [read_result(walked / name) for name in ("clean", "noisy")]
    (words,) = step("gr-ros2", "compare")
    lines = [line.split() for line in here(*words[1:], folder=tmp_path).splitlines()]
    table = [line for line in lines if line and (line[0] == "setting" or line[0].startswith("/robot_1"))]
    assert table[0][:2] == ["setting", "channel.snr_db"]
    assert not any(line[1] in ("sent", "delivered", "PDR") for line in table), "they are equal"
    before, after = ([topic.ledger.get("repaired", 0) for topic in result.topics] for result in results)
    assert sum(line[1] == "repaired" for line in table) == sum(map(int.__ne__, before, after)) >= 3


def test_step_3_loses_on_purpose_and_says_where(walked: Path) -> None:
    text = (walked / "replay.txt").read_text()
    odom, *_ = re.findall(r"/rx_robot_1/odom +(\d+) +(\d+)", text)
    imu, *_ = re.findall(r"/rx_robot_1/imu +(\d+) +(\d+)", text)
    assert 0.35 < int(odom[1]) / int(odom[0]) < 0.65, "about half"
    assert 0.05 < int(imu[1]) / int(imu[0]) < 0.2, "a tenth"
    assert "given_up" in text
    assert "queue_bound" in text
    assert "rx_robot_1/odom,nav_msgs/msg/Odometry" in (walked / "last.txt").read_text()
