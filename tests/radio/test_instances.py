"""Live links: topics with several publishers."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.codecs.messages import read
from gr_ros2.middleware.memory import MemoryMiddleware
from tests.codecs.test_instances import TF, transforms
from tests.domains import domain
from tests.middleware.support import CUSTOM, LATCHED, message
from tests.radio.robots import QOS, Robot
from tests.waiting import wait_for


def robot(number: int, tmp_path: Path, *others: int, **values: Any) -> Robot:
    addresses = {name: f"ipc://{tmp_path}/{name}" for name in (number, *others)}
    front_end = {"name": "zmq", "bind": addresses[number], "connect": [addresses[other] for other in others]}
    own = {"registry": "", "packet_len": 220, "state": str(tmp_path / f"state-{number}"), **values}
    return Robot(number, front_end, **own)


@pytest.mark.slow
@pytest.mark.real_time
def test_three_broadcasters_of_transforms_cross_at_the_wanted_rate_each(tmp_path: Path) -> None:
    rates = {transforms("odom"): 50.0, transforms("base", "laser"): 50.0, transforms("arm"): 20.0}
    came: list[tuple[float, bytes]] = []
    with (
        MemoryMiddleware(domain_id=domain(1)) as near,
        MemoryMiddleware(domain_id=domain(2)) as far,
        robot(1, tmp_path, 2, topics={"tf": {"max_rate": 5}}) as one,
        robot(2, tmp_path, 1),
    ):
        far.subscribe("/rx_robot_1/tf", TF, QOS, lambda payload: came.append((time.monotonic(), payload)))
        broadcasters = {payload: near.advertise("/robot_1/tf", TF, QOS) for payload in rates}
        wait_for(lambda: "/robot_1/tf" in one.link.source.subscriptions.subscribed, "the topic")
        due = dict.fromkeys(rates, time.monotonic())

        def play() -> float:
            """Broadcast what is due; s for which messages have come."""
            for payload, publisher in broadcasters.items():
                while due[payload] <= time.monotonic():
                    publisher.publish(payload)
                    due[payload] += 1 / rates[payload]
            return came[-1][0] - came[0][0] if came else 0.0

        wait_for(lambda: play() > 6.0, "six seconds of transforms", longest_s=0.01)
    took = came[-1][0] - came[0][0]
    counts = Counter(one.child_frame_id for _, payload in came[1:] for one in read(TF, payload).transforms)
    assert set(counts) == {"odom", "base", "laser", "arm"}
    assert all(4.0 <= count / took <= 6.0 for count in counts.values()), (counts, took)
    assert len(came) < 1.3 * 5 * took


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
