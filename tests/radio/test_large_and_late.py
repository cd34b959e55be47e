"""Live links of version 1: robots that join late, maps that cross once, and the largest message."""

from __future__ import annotations

import os
import random
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.link.events import Delivered, Met, Received, ReceiverEvent, SenderEvent
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.wire.v1 import MAX_MESSAGE
from tests.domains import domain
from tests.middleware.support import CUSTOM, LATCHED, message
from tests.radio.robots import QOS, Robot
from tests.waiting import wait_for

MAP_LEN, PACKET_LEN = 8_000, 64
NEEDED = MAP_LEN // 46
"""Packets of the map, at least."""


class Events:
    """An observer that keeps what happens at the receiver."""

    def __init__(self) -> None:
        self.received: list[ReceiverEvent] = []

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        pass

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        self.received.append(event)


def air(robot: Robot) -> dict[str, int]:
    found: dict[str, int] = robot.link.stats()["source"]["air"]
    return found


def test_a_map_crosses_once_and_a_robot_that_joins_late_gets_it_by_asking(tmp_path: Path) -> None:
    addresses = {number: f"ipc://{tmp_path}/{number}" for number in (1, 2, 3)}

    def robot(number: int, *others: int, **values: Any) -> Robot:
        own: dict[str, Any] = {
            "phy": {"name": "psk", "sample_rate": 2e5},
            "state": str(tmp_path / f"state-{number}"),
            "registry": "",
            "repeat_s": 0.2 if number == 1 else 0.0,
        }
        front_end = {"name": "zmq", "bind": addresses[number], "connect": [addresses[other] for other in others]}
        return Robot(number, front_end, **{**own, **values})

    seen = Events()
    with (
        MemoryMiddleware(domain_id=domain(1)) as near,
        MemoryMiddleware(domain_id=domain(2)) as second,
        MemoryMiddleware(domain_id=domain(3)) as third,
        robot(1, 2, 3) as one,
    ):
        sent = {"map": message(1, 4) + random.Random(1).randbytes(MAP_LEN - 4), "tf_static": message(2, 40)}
        heard: dict[tuple[int, str], list[bytes]] = {(n, name): [] for n in (2, 3) for name in sent}
        for (number, name), payloads in heard.items():
            graph = second if number == 2 else third
            graph.subscribe(f"/rx_robot_1/{name}", CUSTOM, QOS, payloads.append)
        for name, payload in sent.items():
            near.advertise(f"/robot_1/{name}", CUSTOM, LATCHED).publish(payload)
        with robot(2, 1) as two:
            wait_for(lambda: all(heard[2, name] == [payload] for name, payload in sent.items()), "map and transforms")
            wait_for(lambda: air(two)["report"] > 0, "the other robot to report")
            wait_for(lambda: one.link.source.idle, "the last report")
            before = air(one)
            wait_for(lambda: air(one)["hello"] > before["hello"] + 2, "time for many repeats")
            assert air(one)["new"] - before["new"] < NEEDED // 4
            with robot(3, 1, observer=seen) as three:
                wait_for(lambda: all(heard[3, name] == [payload] for name, payload in sent.items()), "the late robot")
                wait_for(lambda: air(three)["report"] > 0, "a report of the late robot")
            assert [heard[2, name] for name in sent] == [[payload] for payload in sent.values()]
    met = next(place for place, event in enumerate(seen.received) if isinstance(event, Met))
    last = max(place for place, event in enumerate(seen.received) if isinstance(event, Delivered))
    packets = [event for event in seen.received[met:last] if isinstance(event, Received)]
    # Nothing but what it has asked for fills the time between. Two round trips are eight packets, a hello or two.
    assert NEEDED <= len(packets) < 1.35 * NEEDED + 20


@pytest.mark.slow
def test_a_message_of_almost_16_MB_crosses_and_memory_stays_bounded(tmp_path: Path) -> None:
    """Over a modem of 20 Mbit/s, by UDP between addresses that only this process uses."""
    host = f"127.{20 + (os.getpid() >> 16) % 200}.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
    ends = [{"name": "udp", "listen": f"{host}:{4001 + n}", "send_to": [f"{host}:{4002 - n}"]} for n in (0, 1)]
    values: dict[str, Any] = {
        **{"packet_len": 4095, "registry": ""},
        "phy": {"name": "modem", "options": {"bit_rate": 2e7}},
    }
    sent = message(1, 4) + random.Random(1).randbytes(MAX_MESSAGE - 1004)
    heard: list[bytes] = []
    with (
        MemoryMiddleware(domain_id=domain(1)) as near,
        MemoryMiddleware(domain_id=domain(2)) as far,
        Robot(1, ends[0], state=str(tmp_path / "1"), **values) as one,
        Robot(2, ends[1], state=str(tmp_path / "2"), **values) as two,
    ):
        far.subscribe("/rx_robot_1/cloud", CUSTOM, QOS, heard.append)
        cloud = near.advertise("/robot_1/cloud", CUSTOM, QOS)
        wait_for(lambda: "/robot_1/cloud" in one.link.source.subscriptions.subscribed, "the topic")
        wait_for(lambda: two.link.stats()["packets"]["in"], "a packet of the other robot")
        cloud.publish(sent)
        held = [0]

        def come() -> int:
            """Bytes of the message that the other robot has; it has none any more when all of it came."""
            held.append(max(held[-1], two.link.stats()["sink"]["held_bytes"]))
            return held[-1]

        wait_for(lambda: heard, "the message, by the bytes that came", progress=come)
    assert heard == [sent]
    assert len(sent) > 15.9e6
    assert 0 < held[-1] < 1.1 * len(sent)
