"""Lost messages in rosbag2's form: since the last event, and only topics that lost any; in bags too."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from gr_ros2.middleware import Qos
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.lost_messages import LOST_TYPE, LostMessages, _types
from tests.domains import domain, free_ports
from tests.middleware.support import CUSTOM
from tests.radio.robots import Robot
from tests.waiting import wait_for

CHAT, EVENTS = "/rx_robot_1/chat", "/gr_ros2_link_2/events/messages_lost"


def stats(here: int, dropped: int, on_graph: int = 0) -> dict[str, Any]:
    return {
        "sink": {"topics": {"/rx_robot_2/odom": {"lost": {"missing": here}}, "/rx_robot_2/tf": {"lost": {}}}},
        "source": {"topics": {"/robot_1/scan": {"refused": {"queue_full": dropped}, "lost_on_graph": on_graph}}},
    }


def told(event: bytes | None, node: str = "/gr_ros2_link_1") -> dict[str, tuple[int, int]]:
    assert event is not None
    message: Any = _types().deserialize_cdr(event, LOST_TYPE)
    assert message.node_name == node
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


@pytest.mark.slow
@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_of_a_link_says_what_is_missing_in_it(tmp_path: Path, storage: StoragePlugin) -> None:
    """What is recorded and what the events in the same bag tell as lost is all that was said."""
    ports = free_ports(2)
    ends = [
        {"name": "udp", "listen": f"127.0.0.1:{own}", "send_to": [f"127.0.0.1:{other}"]}
        for own, other in (ports, reversed(ports))
    ]
    # A computer that is too slow drops messages of a stream before they leave, which the other end cannot know of.
    sends = {"repair": "off", "topics": {"chat": {"queue": "fifo"}}}
    common = {"phy": {"name": "modem", "options": {"bit_rate": 1e6}}, "diagnostics": {"period_s": 0.1}}
    recorded: dict[str, list[bytes]] = {CHAT: [], EVENTS: []}

    def missing() -> int:
        return sum(told(event, "/gr_ros2_link_2").get(CHAT, (0, 0))[0] for event in recorded[EVENTS])

    with (
        Robot(1, ends[0], state=str(tmp_path / "1"), **sends, **common) as one,
        Robot(2, ends[1], state=str(tmp_path / "2"), channel={"packet_loss": 0.05}, **common) as two,
        MemoryMiddleware(domain_id=domain(2)) as recorder,
    ):
        for topic, type_name in ((CHAT, CUSTOM), (EVENTS, LOST_TYPE)):
            recorder.subscribe(topic, type_name, Qos("reliable", "volatile", 0), recorded[topic].append)
        wait_for(lambda: two.link.stats()["peers"], "a hello")
        said, spoke = 30, time.monotonic()
        one.say(*range(said))

        def complete() -> bool:
            """What was lost behind the last message that came is told once another one comes."""
            nonlocal said, spoke
            if missing() and len(recorded[CHAT]) + missing() == said:
                return True
            if time.monotonic() > spoke + 0.5:
                one.say(said)
                said, spoke = said + 1, time.monotonic()
            return False

        wait_for(complete, "an account of every message")
    chat = Typestore()
    chat.register(get_types_from_msg("uint8[] data\n", CUSTOM))
    with Writer(tmp_path / "bag", version=9, storage_plugin=storage) as bag:
        for topic, type_name, store in ((CHAT, CUSTOM, chat), (EVENTS, LOST_TYPE, _types())):
            to = bag.add_connection(topic, type_name, typestore=store)
            for stamp, payload in enumerate(recorded[topic]):
                bag.write(to, stamp, payload)
    contents = list(read_bag(tmp_path / "bag"))
    there = sum(message.topic == CHAT for message in contents)
    lost = sum(
        told(message.payload, "/gr_ros2_link_2").get(CHAT, (0, 0))[0] for message in contents if message.topic == EVENTS
    )
    assert lost > 0
    assert there + lost == said
