"""Lost messages in rosbag2's form: since the last event, and only topics that lost any."""

from __future__ import annotations

from typing import Any

from gr_ros2.radio.lost_messages import LOST_TYPE, LostMessages, _types


def stats(here: int, dropped: int, on_graph: int = 0) -> dict[str, Any]:
    return {
        "sink": {"topics": {"/rx_robot_2/odom": {"lost": {"missing": here}}, "/rx_robot_2/tf": {"lost": {}}}},
        "source": {"topics": {"/robot_1/scan": {"refused": {"queue_full": dropped}, "lost_on_graph": on_graph}}},
    }


def told(event: bytes | None) -> dict[str, tuple[int, int]]:
    assert event is not None
    message: Any = _types().deserialize_cdr(event, LOST_TYPE)
    assert message.node_name == "/gr_ros2_link_1"
    return {
        stat.topic_name: (stat.messages_lost_in_transport, stat.messages_lost_in_recorder)
        for stat in message.messages_lost_statistics
    }


def test_each_event_tells_what_was_lost_since_the_last_one() -> None:
    lost = LostMessages("gr_ros2_link_1")
    assert lost.event(stats(0, 0)) is None
    assert told(lost.event(stats(3, 0))) == {"/rx_robot_2/odom": (3, 0)}
    assert lost.event(stats(3, 0)) is None
    assert told(lost.event(stats(4, 2, on_graph=5))) == {"/rx_robot_2/odom": (1, 0), "/robot_1/scan": (7, 0)}
