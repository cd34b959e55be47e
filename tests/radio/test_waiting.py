"""What a link waits for is told at once, with what there is instead, and once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gr_ros2.middleware import Qos, TopicInfo
from gr_ros2.radio.waiting import NewFindings, foreign, shortcut, waiting_line
from tests.domains import domain
from tests.waiting import wait_for

QOS = Qos("reliable", "volatile", 10)
ODOM, SCAN = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan"
TYPES = {"/robot_1/odom": ODOM, "/robot_1/scan": SCAN}


def published(topic: str, type_name: str) -> TopicInfo:
    return TopicInfo(topic, type_name, publishers=(QOS,))


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ([], "nothing else is published on the graph"),
        ([published("/rosout", "rcl_interfaces/msg/Log")], "nothing else is published on the graph"),
        ([TopicInfo("/odom", ODOM, subscribers=(QOS,))], "nothing else is published on the graph"),
        (
            [published("/a", "std_msgs/msg/String"), published("/b", ODOM), published("/odom", ODOM)],
            "seen on the graph: /odom, /b, /a",
        ),
        (
            [published(f"/topic_{number}", ODOM) for number in range(8)],
            "seen on the graph: " + ", ".join(f"/topic_{number}" for number in range(6)) + " and 2 more",
        ),
        ([published("/robot_1/odom", SCAN)], f"/robot_1/odom has another type, {SCAN}"),
    ],
)
def test_what_may_have_been_meant_comes_first(found: list[TopicInfo], said: str) -> None:
    assert waiting_line(["/robot_1/odom"], TYPES, found) == f"no publisher on /robot_1/odom yet; {said}"


def test_a_line_is_told_when_it_changes() -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    from gr_ros2.middleware.memory import MemoryMiddleware
    from gr_ros2.radio.waiting import ALL_THERE, Waiting
    from gr_ros2.settings.registry import Registry
    from tests.domains import domain
    from tests.gr.ends import link

    with MemoryMiddleware(domain_id=domain(1)) as robot, MemoryMiddleware(domain_id=domain(1)) as ours:
        rows = Registry.from_rows({"odom": ODOM})
        both = link(registry=rows, middleware=ours, robot="/robot_1", direction="send")
        source = both.source
        try:
            waiting = Waiting(source)
            assert waiting.look() == "no publisher on /robot_1/odom yet; nothing else is published on the graph"
            assert waiting.look() is None
            robot.advertise("/odom", ODOM, QOS)
            assert waiting.look() == "no publisher on /robot_1/odom yet; seen on the graph: /odom"
            with_publisher = robot.advertise("/robot_1/odom", ODOM, QOS)
            assert waiting.look() == ALL_THERE
            with_publisher.close()
            assert waiting.look() == "no publisher on /robot_1/odom any more; seen on the graph: /odom"
            assert source.stats()["unmatched"] == ["/robot_1/odom"]
            robot.advertise("/robot_1/odom", ODOM, QOS)
            assert waiting.look() == ALL_THERE
            assert waiting.look() is None
            assert source.stats()["unmatched"] == []
        finally:
            both.close()


@pytest.mark.parametrize(
    ("topics", "heard", "said"),
    [
        (["/gr_ros2_link_1/statistics", "/odom"], [2], None),
        (
            ["/gr_ros2_link_2/statistics"],
            [2],
            "gr_ros2_link_2 is on this robot's ROS graph, which is heard by radio too",
        ),
        (["/gr_ros2_link_2/statistics", "/gr_ros2_link_10/statistics"], [], "gr_ros2_link_2, gr_ros2_link_10 is on"),
        (["/gr_ros2_link_2/transmit"], [], "gr_ros2_link_2 is on this robot's ROS graph: something"),
        (["/my/gr_ros2_link_2/statistics", "/gr_ros2_link_x/statistics"], [], None),
    ],
)
def test_another_robots_link_on_this_graph_is_named(topics: list[str], heard: list[int], said: str | None) -> None:
    line = shortcut(topics, 1, heard)
    assert (line is None) if said is None else (line is not None and line.startswith(said))


def test_who_else_publishes_what_was_received_is_named() -> None:
    outputs = ["/rx_robot_2/odom", "/rx_robot_2/scan", "/tf"]
    assert foreign(["/odom", "/tf", "/rx_robot_3/odom"], outputs) is None
    line = foreign(["/odom", "/tf", "/rx_robot_2/odom"], outputs)
    assert line is not None
    assert line.startswith("/rx_robot_2/odom: another program on this robot's ROS graph publishes there too")


def test_a_finding_is_told_once() -> None:
    true = ["one"]
    findings = NewFindings(lambda: true)
    assert findings.new(0.0) == []
    assert findings.new(3.0) == ["one"]
    true.append("two")
    assert findings.new(4.0) == []
    assert findings.new(13.0) == ["two"]
    assert findings.new(23.0) == []


def test_a_link_on_the_same_graph_is_seen_without_diagnostics_too(tmp_path: Path) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    from tests.radio.robots import Robot

    ends = [f"ipc://{tmp_path}/{number}" for number in "12"]
    values: dict[str, Any] = {"diagnostics": {"period_s": 0}}

    def robot(number: int) -> Robot:
        front_end = {"name": "zmq", "bind": ends[number - 1], "connect": [ends[2 - number]]}
        graph, state = {"domain_id": domain(9)}, str(tmp_path / f"state-{number}")
        return Robot(number, front_end, graph=graph, state=state, **values)

    with robot(1) as one:
        assert one.link.findings.lines() == []
        with robot(2):
            wait_for(lambda: one.link.stats()["peers"], "the other robot by radio")
            (line,) = one.link.findings.lines()
            assert line.startswith("gr_ros2_link_2 is on this robot's ROS graph, which is heard by radio too")
