"""The loop guard, and who is on one graph."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.loops import check_loop
from gr_ros2.middleware import join_graph, meet
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import PublishConfig, PublishOptions

REGISTRY = Registry.from_rows({"odom": "nav_msgs/Odometry", "/tf": "tf2_msgs/TFMessage"})


def test_a_sink_that_feeds_a_source_is_refused() -> None:
    with pytest.raises(ConfigError, match="/rx_robot_7/odom"):
        check_loop(["/rx_robot_7/odom"], PublishConfig(), REGISTRY)
    with pytest.raises(ConfigError, match="/robot_1/odom"):
        check_loop(["/robot_1/odom"], PublishConfig(as_="/robot_1"), REGISTRY)


def test_publish_as_counts() -> None:
    registry = REGISTRY.with_options({"tf": PublishOptions(as_="/tf")})
    with pytest.raises(ConfigError, match="/tf"):
        check_loop(["/tf"], PublishConfig(), registry)


def test_other_topics_are_fine() -> None:
    fine = ["/robot_1/odom", "/tf", "/rx_robot_300/odom"]
    check_loop(fine, PublishConfig(), REGISTRY)
    with pytest.raises(ConfigError, match="/rx_robot_30/odom"):
        check_loop([*fine, "/rx_robot_30/odom"], PublishConfig(), REGISTRY)


def test_the_same_graph_is_the_same_domain() -> None:
    graphs = [join_graph("memory", domain_id=domain, node_name="node") for domain in (51, 51, 52)]
    try:
        assert meet(graphs[0], graphs[1])
        assert not meet(graphs[0], graphs[2])
        with MemoryMiddleware(domain_id=52) as opened:
            assert meet(graphs[2], opened)
    finally:
        for graph in graphs:
            graph.close()


class Elsewhere(MemoryMiddleware):
    """Stands for another row."""

    def __init__(self, name: str) -> None:
        super().__init__(domain_id=55)
        self.name = name  # type: ignore[misc]


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ("dds", "dds", True),
        ("dds", "rclpy", True),
        ("zenoh", "rclpy", True),
        ("dds", "zenoh", False),
        ("memory", "dds", False),
        ("memory", "rclpy", False),
        ("own", "own", True),
        ("own", "dds", False),
    ],
)
def test_who_can_hear_whom_is_as_the_rows_say(one: str, other: str, expected: bool) -> None:
    with Elsewhere(one) as first, Elsewhere(other) as second:
        assert meet(first, second) is expected
        assert meet(second, first) is expected


def test_a_bag_is_nobody_elses_graph(tmp_path: Path) -> None:
    with (
        BagMiddleware(path=tmp_path / "one", mode="write") as one,
        BagMiddleware(path=tmp_path / "two", mode="write") as two,
    ):
        assert meet(one, one)
        assert not meet(one, two)


def test_a_bag_must_be_opened_by_hand() -> None:
    with pytest.raises(ConfigError, match="path"):
        join_graph("bag", domain_id="auto", node_name="node")
