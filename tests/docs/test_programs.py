"""The Python programs of the pages run whole, as they stand but for ports, domains and durations."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.middleware import Publisher, Qos, join_graph
from gr_ros2.settings.files import REGISTRY_DIR
from tests.codecs import scenes
from tests.docs.pages import blocks
from tests.domains import free_domains
from tests.waiting import wait_for

TWIST = "geometry_msgs/msg/Twist"
ELSEWHERE = {
    "docs/how-to/extend.md": "tests/test_contributing.py",
    "docs/how-to/stop-on-loss.md": "tests/radio/test_stop_on_loss.py",
    "docs/how-to/teams.md": "tests/lab/run/test_task_run.py",
}
HERE = {block.page: block.text for block in blocks("python") if block.page not in ELSEWHERE}


def ran(page: str, *changes: tuple[str, str], **names: Any) -> dict[str, Any]:
    """What is defined when the program of a page has ended.

    :param changes: text and what stands there instead
    :param names: what is defined before
    """
    text = HERE[page]
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    names = {"__name__": "__main__", **names}
    exec(compile(text, page, "exec"), names)
    return names


def test_every_program_is_run() -> None:
    assert HERE.keys() == {"docs/explanation/codecs.md", "docs/how-to/dashboard.md", "docs/how-to/gnuradio.md"}
    pages = {block.page for block in blocks("python")}
    for page, test in ELSEWHERE.items():
        assert page in pages
        assert Path(page).name in (Path(__file__).parents[2] / test).read_text()


def test_a_cloud_is_coded_and_decoded() -> None:
    message = scenes.cloud(scenes.street(1, 16, 300))
    names = ran("docs/explanation/codecs.md", message=message)
    assert len(names["coded"].data) <= 7000 < len(names["message"])


def test_a_run_is_watched_by_a_dashboard(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("bokeh", reason="needs Bokeh")
    shorter = ('load_scenario("demo")', 'load_scenario("demo", ["time=packets"], duration_s=1.0)')
    ran("docs/how-to/dashboard.md", ("5006", "0"), shorter)
    assert capsys.readouterr().out.startswith("http://127.0.0.1:")


def test_a_flowgraph_carries_messages_until_enter_is_pressed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds", reason="needs Cyclone DDS")
    monkeypatch.chdir(tmp_path)
    shutil.copy(REGISTRY_DIR / "table4.csv", "topics.csv")
    here, there = free_domains()
    heard: list[bytes] = []

    def arrived(publisher: Publisher) -> bool:
        publisher.publish(b"\0\1\0\0" + bytes(48))
        return bool(heard)

    def watch(_prompt: str) -> str:
        with (
            join_graph("dds", domain_id=here, node_name="robot_1") as sends,
            join_graph("dds", domain_id=there, node_name="robot_2") as receives,
        ):
            receives.subscribe("/rx_robot_1/cmd_vel", TWIST, Qos(), heard.append)
            publisher = sends.advertise("/robot_1/cmd_vel", TWIST, Qos())
            wait_for(lambda: arrived(publisher), "a message over the flowgraph")
        return ""

    ran("docs/how-to/gnuradio.md", ("=41", f"={here}"), ("=42", f"={there}"), input=watch)
    assert len(heard[0]) == 52
