"""`gr-ros2 survey`, beside a link in a process of its own, while a robot drives."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.middleware import Qos, join_graph
from gr_ros2_lab.survey.poses import FIX
from gr_ros2_lab.survey.table import read_table
from tests.cli.test_status import Ends, ends  # noqa: F401 - a fixture
from tests.domains import free_domains
from tests.lab.survey.test_poses import fix
from tests.waiting import wait_for


@contextmanager
def driving(domain_id: int) -> Iterator[None]:
    """A robot that drives to the north, on a ROS graph."""
    over = threading.Event()

    def drive() -> None:
        with join_graph("dds", domain_id=domain_id, node_name="robot", localhost_only=True) as graph:
            publisher = graph.advertise("/gps/fix", FIX, Qos())
            step = 0
            while not over.wait(0.05):
                step += 1
                publisher.publish(fix(48.0 + step * 1e-6, 9.0))

    thread = threading.Thread(target=drive)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def test_a_drive_becomes_a_table_a_figure_and_geojson(
    ends: Ends,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (domain_id,) = free_domains(1)
    process = ends.link(1, "--set", f"graph.domain_id={domain_id}", "--set", "graph.namespace=/gps")
    ends.link(2)
    wait_for(ends.heard, "the other robot")
    out = tmp_path / "survey.csv"
    words = ("--every", "0.2", "--duration", "6", "--pid", str(process.pid))
    with driving(domain_id):
        done = ends.run("survey", str(out), "--pose", "fix", "--base", "47.9999,9", *words)
    rows = read_table(out)
    assert sum(row.packets for row in rows) > 1
    assert sum(row.lost for row in rows) == 0
    assert {row.robot for row in rows} == {2}
    assert rows[0].y_m == pytest.approx(11.1, abs=8), "from the base"
    assert rows[-1].y_m > rows[0].y_m
    assert done.returncode == 0, done.stderr
    assert "written: " in done.stdout
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    (first, *_) = json.loads(out.with_suffix(".geojson").read_text())["features"]
    assert first["geometry"]["coordinates"] == pytest.approx([9.0, 48.0], abs=1e-3)
    again = ends.run("survey", str(out))
    assert again.returncode == 0, again.stderr
    monkeypatch.setattr("gr_ros2_lab.cli.survey._FOUND_S", 0.2)
    told = ends.run("survey", str(tmp_path / "a.csv"), "--pose", "odom", "--pid", str(process.pid))
    assert told.returncode == 2
    assert "--pose odom: nobody publishes /gps/odom or /odom; on the graph are no topics" in told.stderr


def test_what_tells_no_place_is_said(ends: Ends, tmp_path: Path) -> None:  # noqa: F811
    none = ends.run("survey", str(tmp_path / "no.csv"))
    assert none.returncode == 2
    assert "no such survey to show; to drive one, name --pose TOPIC" in none.stderr
    bad = ends.run("survey", str(tmp_path / "a.csv"), "--pose", "odom", "--base", "3", "--pid", "1")
    assert "write two numbers, such as 3.5,-2" in bad.stderr
