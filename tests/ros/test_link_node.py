"""`ros2 run gr_ros2 link` on a real ROS 2: parameters, messages both ways, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: source a ROS 2 setup (Humble or later) to run these tests")
pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

import rclpy
import rclpy.context
import rclpy.executors
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from std_msgs.msg import Header, String

from tests.e2e.support import free_domains
from tests.middleware.support import wait_for

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, str(ROOT / "resource" / "link"), "--ros-args"]


class Graph:
    """A node beside the link's."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.context.Context()
        self._context.init(args=[], domain_id=domain)
        self.node = rclpy.create_node("beside", context=self._context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def ask(self, kind: Any, name: str, request: Any) -> Any:
        client = self.node.create_client(kind, f"/gr_ros2_link/{name}")
        wait_for(client.service_is_ready, name)
        future = client.call_async(request)
        wait_for(future.done, name)
        return future.result()

    def set(self, name: str, value: Any) -> tuple[bool, str]:
        kinds = {int: ("integer_value", ParameterType.PARAMETER_INTEGER), float: ("double_value", 3)}
        field, number = kinds[type(value)]
        parameter = Parameter(name=name, value=ParameterValue(type=number, **{field: value}))
        (result,) = self.ask(SetParameters, "set_parameters", SetParameters.Request(parameters=[parameter])).results
        return result.successful, result.reason

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
        self._thread.join(5)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    (tmp_path / "topics.csv").write_text("header,std_msgs/Header\n")
    path = tmp_path / "link.yaml"
    path.write_text(
        "registry: topics.csv\nphy: {name: direct}\nfront_end: {name: sim}\n"
        "ros_source: {namespace: /robot_1}\nros_sink: {frame_prefix: 'robot_{src_id}/'}\n"
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
    given = ["-p", f"config:={config}", "-p", "ros_source.hop:=3", "-p", "diagnostics.period_s:=0.2"]
    process = subprocess.Popen([*COMMAND, *given], env=os.environ.copy(), stderr=subprocess.PIPE, text=True)
    try:
        names = ["ros_source.hop", "packet_len", "ros_source.flush_timeout"]
        values = graph.ask(GetParameters, "get_parameters", GetParameters.Request(names=names)).values
        assert [value.integer_value for value in values[:2]] == [3, 220]
        described = graph.ask(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names))
        hop, packet_len, _ = described.descriptors
        assert (hop.integer_range[0].from_value, hop.integer_range[0].to_value, hop.read_only) == (0, 15, False)
        assert packet_len.read_only
        assert packet_len.description.startswith("bytes on the wire")
        assert graph.set("ros_source.hop", 5) == (True, "")
        assert graph.set("ros_source.flush_timeout", 0) == (True, "")
        assert not graph.set("ros_source.hop", 50)[0]
        assert not graph.set("packet_len", 64)[0]
        assert "greater than 0" in graph.set("ros_sink.reassembly_timeout", 0.0)[1]

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
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (["ros_source.hop:=30"], "ros_source.hop = 30"),
        (["ros_source.hopp:=3"], "unknown key ros_source.hopp"),
        (None, "parameter config is missing"),
    ],
)
def test_wrong_settings_are_one_line(config: Path, parameters: list[str] | None, said: str) -> None:
    chosen = [] if parameters is None else [f"config:={config}", *parameters]
    command = [*COMMAND, *(word for text in chosen for word in ("-p", text))]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    *_, last = done.stderr.splitlines()  # an RMW may have said something before
    assert last.startswith("gr_ros2 link: ") and said in last
