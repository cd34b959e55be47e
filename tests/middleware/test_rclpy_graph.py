"""A graph of several ROS 2 nodes with the sourced RMW, each in its own process, and our participants on `dds` in it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: source a ROS 2 setup (Humble or later) to run these tests")

from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from tests.middleware.support import Peer
from tests.waiting import wait_for

TYPES = {
    "text": "std_msgs/msg/String",
    "number": "std_msgs/msg/Int32",
    "odom": "nav_msgs/msg/Odometry",
    "speed": "geometry_msgs/msg/Twist",
}
OURS = {f"/rx_robot_2/{name}_{number}": kind for number in range(2) for name, kind in TYPES.items()}
NATIVE = ("nav_msgs/msg/Path", "nav_msgs/msg/OccupancyGrid", "geometry_msgs/msg/PoseWithCovarianceStamped")
THEIRS = {f"/native_{number}": kind for number, kind in enumerate([*TYPES.values(), *NATIVE])}
PROGRAM = Path(__file__).with_name("rclpy_peer.py")
EMPTY = {"std_msgs/msg/String": b"\0\1\0\0\1\0\0\0\0\0\0\0", "std_msgs/msg/Int32": b"\0\1\0\0\1\0\0\0"}
SIZES = {"nav_msgs/msg/Odometry": 720, "geometry_msgs/msg/Twist": 48}


class Node(Peer):
    def __init__(self, domain: int, name: str, role: str, topics: dict[str, str]) -> None:
        words = [word for row in topics.items() for word in row]
        super().__init__([sys.executable, str(PROGRAM), str(domain), name, role, *words])


@pytest.fixture
def node(domain: int) -> Iterator[Callable[..., Node]]:
    made: list[Node] = []

    def make(name: str, role: str, topics: dict[str, str]) -> Node:
        made.append(Node(domain, name, role, topics))
        wait_for(lambda: made[-1].ready, name)
        return made[-1]

    yield make
    for other in made:
        other.close()


@pytest.mark.slow
def test_a_link_leaves_the_discovery_of_other_nodes_alone(
    node: Callable[..., Node], domain: int, capfd: pytest.CaptureFixture[str]
) -> None:
    """Later listeners hear every topic, ours and native ones, while an earlier listener runs."""
    taken: set[str] = set()
    with DdsMiddleware(domain_id=domain, node_name="sink") as sink, DdsMiddleware(domain_id=domain) as source:
        publishers = [(sink.advertise(topic, kind, Qos("reliable")), kind) for topic, kind in OURS.items()]
        for topic, kind in THEIRS.items():
            source.subscribe(topic, kind, Qos(), lambda _, topic=topic: taken.add(topic))  # type: ignore[misc]

        def heard_by(listener: Node, topics: dict[str, str]) -> Callable[[], bool]:
            def heard() -> bool:
                for publisher, kind in publishers:
                    publisher.publish(EMPTY.get(kind) or b"\0\1\0\0" + bytes(SIZES[kind]))
                return listener.heard >= topics.keys()

            return heard

        first = node("first", "listen", {**OURS, **THEIRS})
        wait_for(heard_by(first, OURS), "what the first listener hears of us")
        node("talker", "talk", THEIRS)
        wait_for(heard_by(first, THEIRS), "what it hears of a node")
        for name in ("second", "third", "fourth"):
            later = node(name, "listen", {**OURS, **THEIRS})
            wait_for(heard_by(later, {**OURS, **THEIRS}), f"what the {name} listener hears")
            later.close()
        wait_for(lambda: taken == set(THEIRS), "the native topics here")
    assert "invalid type object" not in capfd.readouterr().err
