"""A source without a registry: it finds its topics on the graph, whichever middleware reaches it."""

from __future__ import annotations

import logging
from typing import Any

import pytest
from gnuradio import gr

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import MIDDLEWARE, Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.paper import RosSource
from gr_ros2.radio.waiting import Waiting
from tests.domains import free_domains
from tests.gr.ends import link
from tests.gr.probe import Probe
from tests.middleware.support import CUSTOM, STRING, message
from tests.waiting import wait_for

ODOM = "nav_msgs/msg/Odometry"


class Running:
    """A source in a flowgraph, and what it emits."""

    def __init__(self, **settings: Any) -> None:
        self.link = link(**{"robot": "/robot_1", "direction": "send", **settings})
        self.source = self.link.source
        self.top, self.probe = gr.top_block(), Probe()
        self.top.msg_connect((self.source, "pdus"), (self.probe, "pdus"))

    def __enter__(self) -> Running:
        self.top.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.top.stop()
        self.top.wait()
        self.link.close()

    @property
    def submitted(self) -> dict[str, int]:
        return {name: topic["submitted"] for name, topic in self.source.stats()["topics"].items()}


@pytest.mark.parametrize("middleware", ["memory", "dds", "rclpy"])
def test_types_and_qos_are_those_of_the_graph(
    middleware: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if middleware == "rclpy":
        pytest.importorskip("rclpy", reason="needs a sourced ROS 2")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    caplog.set_level(logging.INFO, "gr_ros2.gr.source")
    (domain,) = free_domains(1)
    unknown = CUSTOM if middleware != "rclpy" else STRING  # rclpy needs the package of a type, the others do not
    topics = ["odom", "auto", "-camera", "/elsewhere"]
    with (
        MIDDLEWARE.load(middleware)(domain_id=domain) as robot,
        Running(topics=topics, graph_middleware=middleware, graph_domain_id=domain) as running,
    ):
        waiting = Waiting(running.source)
        assert running.source.found.unmatched() == ["/robot_1/odom", "/elsewhere"]
        assert "no publisher on /robot_1/odom, /elsewhere yet" in str(waiting.look())
        wheels = robot.advertise("/robot_1/wheels", unknown, Qos("best_effort", "volatile", 1))
        robot.advertise("/robot_1/odom", ODOM, Qos("reliable", "volatile", 5))
        robot.advertise("/robot_1/camera", STRING, Qos("reliable", "volatile", 5))
        robot.subscribe("/robot_1/only_wanted", STRING, Qos("reliable", "volatile", 5), lambda _: None)
        robot.advertise("/elsewhere", STRING, Qos("reliable", "transient_local", 1)).publish(message(1, 20))
        wait_for(lambda: not running.source.found.unmatched(), "all topics that are named")
        wait_for(lambda: "/robot_1/wheels" in running.source.subscriptions.subscribed, "a topic that nobody named")

        def crosses() -> bool:
            wheels.publish(message(2, 20))
            return bool(running.submitted["/robot_1/wheels"]) and bool(running.submitted["/elsewhere"])

        wait_for(crosses, "messages to be taken")
        rows = {topic.name: topic.type_name for topic in running.source.subscriptions.registry}
        assert rows == {"odom": ODOM, "wheels": unknown, "/elsewhere": STRING}
        queues = {name: topic["queue"] for name, topic in running.source.stats()["topics"].items()}
        assert queues["/robot_1/wheels"] == ("fifo" if middleware == "rclpy" else "latest")  # rclpy tells no depth
        assert "every topic has a publisher: " in str(waiting.look())
        wait_for(lambda: running.probe.packets, "packets")
    assert f"topic /robot_1/wheels ({unknown}) of the ROS graph is sent" in caplog.text


def test_what_cannot_be_sent_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    (domain,) = free_domains(1)
    caplog.set_level(logging.INFO, "gr_ros2.gr.source")  # a test with debug may have left another one
    options = {"scan*": {"codec": "none"}, "odo?": {"quantize": "no_such_field=1"}}
    values: dict[str, Any] = {"graph_middleware": "memory", "graph_domain_id": domain}
    with (
        MemoryMiddleware(domain_id=domain) as robot,
        Running(topics={"auto": {}, "/scan": {}, **options}, **values) as running,
    ):
        waiting = Waiting(running.source)
        assert waiting.look() == "no publisher on /scan yet; nothing else is published on the graph"
        robot.advertise("/robot_1/odom", ODOM, Qos())
        robot.advertise("/robot_1/scan", STRING, Qos())
        wait_for(lambda: "/robot_1/scan" in running.source.subscriptions.subscribed, "a topic that can be sent")
        robot.advertise("/scan", STRING, Qos())  # would come out under the same name as the other one
        wait_for(lambda: "topic /scan is not sent" in caplog.text, "a topic that cannot")
        for number in range(300):
            robot.advertise(f"/robot_1/topic_{number}", STRING, Qos())
        wait_for(lambda: "241 topics" in caplog.text, "too many")
        robot.advertise("/robot_1/one_more", STRING, Qos())
        wait_for(lambda: "/robot_1/one_more" in running.source.found.left_out, "one more")
    for name, why in (("/robot_1/odom", "no_such_field"), ("/scan", "duplicate topic '/scan'")):
        (line,) = [line for line in caplog.messages if line.startswith(f"topic {name} is not sent: ")]
        assert why in line
    assert caplog.text.count("241 topics; a link carries at most 240") == 1
    assert len(running.source.subscriptions.registry) == 240
    assert running.source.subscriptions.registry.named("scan").options.codec == "none"


def test_a_source_that_sends_nothing_yet_says_what_it_looks_for() -> None:
    (domain,) = free_domains(1)
    with (
        MemoryMiddleware(domain_id=domain) as robot,
        Running(topics="auto", graph_middleware="memory", graph_domain_id=domain) as running,
    ):
        waiting = Waiting(running.source)
        robot.advertise("/robot_2/odom", ODOM, Qos())
        assert waiting.look() == "no publisher on /robot_1/* yet; seen on the graph: /robot_2/odom"
        robot.advertise("/robot_1/odom", ODOM, Qos())
        wait_for(lambda: running.source.subscriptions.subscribed, "the topic")
        wait_for(lambda: waiting.look() == "every topic has a publisher: /robot_1/odom", "the line")


def test_the_papers_source_needs_a_registry() -> None:
    with pytest.raises(ConfigError, match="registry is missing"):
        RosSource(robot=1, graph_middleware="memory", graph_domain_id=free_domains(1)[0])


class OfFastDds(MemoryMiddleware):
    """A graph whose services belong to nodes of rmw_fastrtps."""

    def discover_services(self) -> dict[str, str]:
        return dict.fromkeys(("/robot_1/add", "/robot_1/sum"), "std_srvs/srv/Trigger")

    def uncallable(self) -> frozenset[str]:
        return frozenset(self.discover_services())


def test_of_services_that_cannot_be_called_one_line_says_what_to_set(caplog: pytest.LogCaptureFixture) -> None:
    offered: list[str] = []
    with OfFastDds(domain_id=free_domains(1)[0]) as graph:
        running = Running(topics=["auto"], middleware=graph)
        running.source.found.offer_with(lambda name, _: offered.append(name), offered.remove)
        with running:
            wait_for(lambda: len(running.source.found.not_offered) == 2, "both services to be found")
    assert not offered and not running.source.found.offered
    (line,) = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert line.startswith("/robot_1/add (std_srvs/srv/Trigger) is not offered: its node has another RMW")
    assert "--middleware rclpy" in line
