"""Live links: topics with several publishers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.middleware.memory import MemoryMiddleware
from tests.domains import domain
from tests.middleware.support import CUSTOM, LATCHED, message
from tests.radio.robots import Robot
from tests.waiting import wait_for


def robot(number: int, tmp_path: Path, *others: int, **values: Any) -> Robot:
    addresses = {name: f"ipc://{tmp_path}/{name}" for name in (number, *others)}
    front_end = {"name": "zmq", "bind": addresses[number], "connect": [addresses[other] for other in others]}
    own = {"registry": "", "packet_len": 220, "state": str(tmp_path / f"state-{number}"), **values}
    return Robot(number, front_end, **own)


def test_a_late_robot_gets_the_message_of_each_of_six_publishers_of_a_latched_topic(tmp_path: Path) -> None:
    heard: list[bytes] = []
    with (
        MemoryMiddleware(domain_id=domain(1)) as near,
        MemoryMiddleware(domain_id=domain(2)) as far,
        robot(1, tmp_path, 2) as one,
    ):
        sent = {message(number, 40) for number in range(6)}
        for payload in sent:
            near.advertise("/robot_1/costmap", CUSTOM, LATCHED).publish(payload)
        wait_for(lambda: "/robot_1/costmap" in one.link.source.subscriptions.subscribed, "the topic")
        wait_for(lambda: one.link.source.stats()["topics"]["/robot_1/costmap"]["sent"] == 6, "all six to leave")
        with robot(2, tmp_path, 1):
            far.subscribe("/rx_robot_1/costmap", CUSTOM, LATCHED, heard.append)
            wait_for(lambda: len(heard) == 6, "the late robot")
    assert set(heard) == sent
