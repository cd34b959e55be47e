"""What the page "Four robots on one channel" promises, asserted on what its own commands do."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pytest

from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.result import Result, read_result
from gr_ros2_lab.record.team import Team, read_team
from tests.docs.pages import blocks, commands
from tests.docs.test_docs import here
from tests.once import once

pytestmark = pytest.mark.slow

PAGE = "docs/four-robots.md"
SHORTER = {"demo": "12", "team": "10", "samples": "20", "packets": "20"}
"""s instead of a minute, or of 20 s: what the page says holds for them as well."""
NAMES = ("demo", "team", "at-once", "aloha", "samples", "packets", None)
"""The last is in real time, as tests/lab/run/test_live.py has four robots."""


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which somebody has done all of it."""
    return once(tmp_path_factory, "four-robots", walk)


def walk(folder: Path) -> None:
    lines = [line for block in blocks("sh") if block.page == PAGE for line in commands(block)]
    runs = [line for line in lines if line[1] in ("demo", "run")]
    for words, name in zip(runs, NAMES, strict=True):
        if name is None:
            continue
        drawn = () if words[1] == "demo" else ("--no-report",)
        shorter = ("--duration", SHORTER[name]) if name in SHORTER else ()
        here(*words[1:], *shorter, *drawn, folder=folder)


def topics(result: Result) -> Iterator[TopicResult]:
    yield from chain(result.topics, *(one.topics for one in result.receivers))


def of(folder: Path, name: str) -> tuple[list[TopicResult], Team]:
    team = read_team(folder / name)
    assert team is not None
    return list(topics(read_result(folder / name))), team


def share(found: list[TopicResult]) -> float:
    return sum(topic.delivered for topic in found) / sum(topic.sent for topic in found)


def test_the_demo_fades_behind_obstacles_and_shows_it(walked: Path) -> None:
    found, team = of(walked, "demo")
    assert len(found) == 12
    levels = [snr for pair in team.snr_db.values() for _, snr in pair]
    assert max(levels) - min(levels) > 20
    assert all(team.beliefs.values())
    page = (walked / "demo" / "report.html").read_text("utf-8")
    assert "The channel while the robots enter" in page


def test_in_slots_all_arrives_and_otherwise_little(walked: Path) -> None:
    slots, team = of(walked, "team")
    assert share(slots) == 1.0
    assert not any(send.overlapped for send in team.sends if send.t > 1), "once all are in"
    at_once, team = of(walked, "at-once")
    assert share(at_once) < 0.5 * share(slots)
    assert sum(send.overlapped for send in team.sends) > 0.9 * len(team.sends)
    aloha, _ = of(walked, "aloha")
    assert 0.05 < share(aloha) < 0.9


def test_samples_and_packets_agree_at_20_db(walked: Path) -> None:
    ages = {}
    for name in ("samples", "packets"):
        found, team = of(walked, name)
        assert min(topic.pdr or 0.0 for topic in found) >= 0.99
        assert not any(send.overlapped for send in team.sends if send.t > 10), "once all are in"
        known = [topic.age_s.mean for topic in found if topic.age_s.mean is not None]
        ages[name] = sum(known) / len(known)
    assert ages["samples"] == pytest.approx(ages["packets"], rel=0.15)


def test_the_page_says_the_figures_of_its_commands(walked: Path) -> None:
    text = (Path(__file__).parents[2] / PAGE).read_text("utf-8")
    said = [int(number) for number in re.findall(r"about (\d+) % of the messages arrive", text)]
    measured = [100 * share(of(walked, name)[0]) for name in ("at-once", "aloha")]
    assert said == pytest.approx(measured, abs=1)
