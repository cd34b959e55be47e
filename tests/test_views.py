"""What RViz and Foxglove show beside a run is there: every topic, of the type drawn, in a frame that leads to the map.

Neither program runs here: the files are held to what their formats say, and to a run of the scenario.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2_lab.sim.transforms import TF_TYPE
from tests.domains import free_domains
from tests.waiting import PATIENCE_S, wait_for

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "gr_ros2" / "examples"
RVIZ: dict[str, Any] = yaml.safe_load((EXAMPLES / "one-graph.rviz").read_text())
FOXGLOVE: dict[str, Any] = json.loads((EXAMPLES / "one-graph-foxglove.json").read_text())
TYPES = {
    "rviz_default_plugins/Map": "nav_msgs/msg/OccupancyGrid",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
    "rviz_default_plugins/LaserScan": "sensor_msgs/msg/LaserScan",
}
"""Displays of rviz_default_plugins, and what they draw."""
PANELS = {"3D", "Plot", "DiagnosticSummary"}
"""Of Foxglove, by the name before the exclamation mark of a panel's id."""
STORE = get_typestore(Stores.ROS2_HUMBLE)


def drawn() -> dict[str, str]:
    """Type of each topic that RViz draws."""
    displays = RVIZ["Visualization Manager"]["Displays"]
    return {display["Topic"]["Value"]: TYPES[display["Class"]] for display in displays if "Topic" in display}


def test_they_are_what_the_tool_writes() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools" / "write-views", "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_rviz_knows_every_class_and_policy() -> None:
    manager = RVIZ["Visualization Manager"]
    known = {*TYPES, "rviz_default_plugins/Grid", "rviz_default_plugins/TF"}
    for display in manager["Displays"]:
        assert display["Class"] in known
        assert display["Enabled"] is True
        assert display["Name"]
        if topic := display.get("Topic"):
            assert topic["Reliability Policy"] in ("Reliable", "Best Effort")
            assert topic["Durability Policy"] in ("Volatile", "Transient Local")
            assert topic["History Policy"] == "Keep Last"
    assert len({display["Name"] for display in manager["Displays"]}) == len(manager["Displays"])
    assert manager["Global Options"]["Fixed Frame"] == "map"
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/TopDownOrtho"


def test_both_robots_are_shown_sent_and_received() -> None:
    for robot in (1, 2):
        for namespace in ("/robot", "/rx_robot"):
            assert {f"{namespace}_{robot}/odom", f"{namespace}_{robot}/scan"} <= set(drawn())


def test_foxglove_shows_the_same_and_every_panel_is_laid_out() -> None:
    panels = FOXGLOVE["configById"]
    assert set(panels["3D!view"]["topics"]) == set(drawn())
    assert panels["3D!view"]["followTf"] == RVIZ["Visualization Manager"]["Global Options"]["Fixed Frame"]

    def placed(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        assert node["direction"] in ("row", "column")
        return [*placed(node["first"]), *placed(node["second"])]

    assert sorted(placed(FOXGLOVE["layout"])) == sorted(panels)
    assert {name.partition("!")[0] for name in panels} == PANELS
    for path in panels["Plot!x"]["paths"]:
        topic, _, members = path["value"].partition(".")
        kind = drawn()[topic]
        for member in members.split("."):
            fields = dict(STORE.fielddefs[kind][1])
            kind = fields[member][1] if isinstance(fields[member][1], str) else ""
    assert {"globalVariables", "userNodes", "playbackConfig"} <= set(FOXGLOVE)


def test_the_layout_of_a_live_link_names_what_it_publishes() -> None:
    layout = json.loads((EXAMPLES / "link-foxglove.json").read_text())
    panels = layout["configById"]
    assert {name.partition("!")[0] for name in panels} == {"DiagnosticSummary", "DiagnosticStatusPanel", "RawMessages"}
    parts = [panels[f"DiagnosticStatusPanel!{part}"]["selectedName"] for part in ("receiver", "transmitter")]
    assert parts == [
        "gr_ros2_link_1: receiver",
        "gr_ros2_link_1: transmitter",
    ]  # as tests/radio/test_diagnostics.py has
    assert panels["RawMessages!counters"]["topicPath"] == "/gr_ros2_link_1/statistics"


@pytest.mark.slow
def test_a_run_publishes_all_of_it_in_frames_that_lead_to_the_map(tmp_path: Path) -> None:
    (number,) = free_domains(1)
    environ = {**os.environ, "ROS_DOMAIN_ID": str(number), "PYTHONPATH": str(ROOT)}
    arguments = ["run", "one-graph", "--duration", "600", "--out", str(tmp_path / "run")]
    command = [sys.executable, "-m", "gr_ros2.cli", *arguments]
    heard: dict[str, bytes] = {}
    parents: dict[str, str] = {}

    def transforms(payload: bytes) -> None:
        said: Any = STORE.deserialize_cdr(payload, TF_TYPE)
        parents.update({one.child_frame_id: one.header.frame_id for one in said.transforms})

    with (tmp_path / "log").open("w") as log:
        running = subprocess.Popen(command, env=environ, stdout=log, stderr=log, cwd=tmp_path)
    try:
        with DdsMiddleware(domain_id=number, localhost_only=True) as tool:
            for topic, kind in drawn().items():
                qos = Qos("best_effort", "transient_local" if kind.endswith("OccupancyGrid") else "volatile", 1)
                tool.subscribe(topic, kind, qos, partial(heard.__setitem__, topic))
            tool.subscribe("/tf", TF_TYPE, Qos("reliable", "volatile", 100), transforms)
            tool.subscribe("/tf_static", TF_TYPE, Qos("reliable", "transient_local", 10), transforms)
            wait_for(lambda: set(heard) == set(drawn()) or running.poll() is not None, "every topic that is drawn")
            wait_for(lambda: len(parents) >= 10 or running.poll() is not None, "the transforms of both robots")
        assert running.poll() is None, (tmp_path / "log").read_text()
    finally:
        running.send_signal(signal.SIGINT)
        running.wait(PATIENCE_S)
    for topic, payload in heard.items():
        said: Any = STORE.deserialize_cdr(payload, drawn()[topic])
        frame = said.header.frame_id
        while frame != "map":
            frame = parents[frame]
