"""`ros2 run gr_ros2 link` on a real ROS 2: parameters, messages both ways, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: source a ROS 2 setup (Humble or later) to run these tests")
pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from rcl_interfaces.msg import Log
from rcl_interfaces.srv import DescribeParameters, GetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header, String

from tests.domains import free_domains
from tests.ros.graph import Graph
from tests.waiting import PATIENCE_S, wait_for

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, str(ROOT / "resource" / "link"), "--ros-args"]
INFO, WARN = (level if isinstance(level, int) else level[0] for level in (Log.INFO, Log.WARN))  # bytes before Jazzy


@pytest.fixture
def config(tmp_path: Path) -> Path:
    (tmp_path / "topics.csv").write_text("header,std_msgs/Header\n")
    path = tmp_path / "link.yaml"
    path.write_text(
        "registry: topics.csv\nphy: {name: direct}\nfront_end: {name: sim}\n"
        "robot: /robot_1\npublish: {frame_prefix: 'robot_{robot}/'}\n"
    )
    return path


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    (domain,) = free_domains(1)
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    graph = Graph(domain)
    yield graph
    graph.close()


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_a_link_as_a_node(config: Path, graph: Graph, ending: signal.Signals) -> None:
    given = ["-p", f"config:={config}", "-p", "queue_depth:=3", "-p", "diagnostics.period_s:=0.2"]
    process = subprocess.Popen([*COMMAND, *given], env=os.environ.copy(), stderr=subprocess.PIPE, text=True)
    try:
        names = ["queue_depth", "packet_len", "repeat_s"]
        values = graph.ask(GetParameters, "get_parameters", GetParameters.Request(names=names)).values
        assert [value.integer_value for value in values[:2]] == [3, 220]
        described = graph.ask(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names))
        queue_depth, packet_len, _ = described.descriptors
        assert (packet_len.integer_range[0].from_value, packet_len.integer_range[0].to_value) == (14, 4095)
        assert not queue_depth.read_only
        assert packet_len.read_only
        assert packet_len.description.startswith("bytes of the longest packet")
        assert graph.set("queue_depth", 5) == (True, "")
        assert graph.set("repeat_s", 0) == (True, "")
        assert graph.set("topics.header.to", 7) == (True, "")
        assert graph.set("topics.header.to", "auto") == (True, "")
        refused, why = graph.set("queue_depth", -1)  # by rclpy, from the described range
        assert not refused and "queue_depth" in why and "-1" in why
        assert not graph.set("hold_s", 5.0)[0]
        assert "cannot change while the link runs" in graph.set("graph.nothing", 7)[1]
        assert not graph.set("packet_len", 64)[0]

        heard: list[Header] = []
        counters: list[dict[str, Any]] = []
        graph.node.create_subscription(Header, "/rx_robot_1/header", heard.append, 10)
        graph.node.create_subscription(
            String, "/gr_ros2_link_1/statistics", lambda message: counters.append(json.loads(message.data)), 10
        )
        publisher = graph.node.create_publisher(Header, "/robot_1/header", 10)
        wait_for(lambda: publisher.publish(Header(frame_id="odom")) or heard, "a message")
        assert heard[0].frame_id == "robot_1/odom"
        wait_for(lambda: counters and counters[-1]["sink"]["topics"], "statistics")
        process.send_signal(ending)
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("loaded", ["librcl.so", "libgnuradio-runtime", "libddsc"])
def test_ctrl_c_while_it_starts(config: Path, loaded: str) -> None:
    process = subprocess.Popen([*COMMAND, "-p", f"config:={config}"], stderr=subprocess.PIPE, text=True)
    try:
        maps = Path("/proc", str(process.pid), "maps")
        wait_for(lambda: loaded in maps.read_text(), f"{loaded} to be loaded")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert "Traceback" not in said
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-p", "config:=link.yaml", "-p", "expected_loss:=30.0"], "expected_loss = 30.0"),
        (["-p", "config:=link.yaml", "-p", "hopp:=3"], "unknown key hopp"),
        (["-p", "config:=link.yaml", "-p", "ros_source.namespace:=/x"], "ros_source is no setting any more"),
        ([], "parameter config is missing"),
        (["-p", "config:=12"], "link '12': no such file"),
        (["-p", "config"], "write --ros-args -p config:=my_link.yaml"),
        (["--", "link.yaml"], "argument 'link.yaml'"),
    ],
)
def test_wrong_settings_are_one_line(config: Path, arguments: list[str], said: str) -> None:
    done = subprocess.run([*COMMAND, *arguments], cwd=config.parent, capture_output=True, text=True)
    assert done.returncode == 2
    *_, last = done.stderr.splitlines()  # an RMW may have said something before
    assert last.startswith("gr_ros2 link: ") and said in last


def test_what_the_library_logs_is_in_the_log_of_ros(config: Path, graph: Graph) -> None:
    """A warning of the middleware, and a packet where `debug` is on."""
    (config.parent / "topics.csv").write_text("header,std_msgs/Header\nother,std_msgs/Header\n")
    said: dict[int, str] = {}
    past = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # said before the link is discovered
    graph.node.create_subscription(
        Log, "/rosout", lambda line: said.update({line.level: said.get(line.level, "") + line.msg}), past
    )
    graph.node.create_publisher(String, "/robot_1/other", 10)
    publisher = graph.node.create_publisher(Header, "/robot_1/header", 10)
    given = ["-p", f"config:={config}", "-p", "debug:=true"]
    process = subprocess.Popen([*COMMAND, *given], env=os.environ.copy())
    try:
        wait_for(lambda: publisher.publish(Header()) or "0:header" in said.get(INFO, ""), "a packet")
        wait_for(lambda: "/robot_1/other: a publisher sends" in said.get(WARN, ""), "the warning")
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.communicate()
