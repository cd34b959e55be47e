"""Sending is switched off by a ROS service, a signal and a button; and the state of a link is a topic."""

from __future__ import annotations

from typing import Any

import pytest

from gr_ros2.gr.health import Level
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.middleware.services import ServiceClient
from gr_ros2.middleware.type_definitions import typestore
from gr_ros2.radio.diagnostics import STATUS_TYPE
from gr_ros2.radio.switch import SWITCH_TYPE
from tests.domains import domain
from tests.gr.test_health import make, parts, stats
from tests.radio.robots import Robot
from tests.waiting import wait_for

SIM = {"name": "sim"}
KEPT = Qos("reliable", "transient_local", 1)


def test_a_ros_service_switches_sending_off_and_on() -> None:
    with Robot(1, SIM, hears=(1,)) as robot, MemoryMiddleware(domain_id=domain(1)) as graph:
        replies: list[tuple[int, bytes]] = []
        there: list[bool] = []
        client: ServiceClient = graph.client(
            "/gr_ros2_link_1/transmit", SWITCH_TYPE, lambda number, reply: replies.append((number, reply)), there.append
        )
        wait_for(lambda: there == [True], "the service")
        for number, on in enumerate((False, True)):
            client.call(number, b"\0\1\0\0" + bytes((on,)))
            wait_for(lambda count=number: len(replies) > count, "an answer")
            assert robot.link.radio.transmits == on
            said = b"sending is on\0" if on else b"sending is off\0"
            assert replies[number] == (number, b"\0\1\0\0\1\0\0\0" + bytes((len(said), 0, 0, 0)) + said)
        client.close()


def test_who_only_receives_says_that_it_cannot_send() -> None:
    with Robot(1, SIM, hears=(1,), transmit=False) as robot, MemoryMiddleware(domain_id=domain(1)) as graph:
        replies: list[bytes] = []
        there: list[bool] = []
        client: ServiceClient = graph.client(
            "/gr_ros2_link_1/transmit", SWITCH_TYPE, lambda _, reply: replies.append(reply), there.append
        )
        wait_for(lambda: there == [True], "the service")
        client.call(0, b"\0\1\0\0\1")
        wait_for(lambda: replies, "an answer")
        assert replies[0][4] == 0
        assert b"it only receives, and has no open transmitter" in replies[0]
        assert not robot.link.radio.transmits
        client.close()


def test_the_state_of_a_link_is_a_latched_topic() -> None:
    quick: dict[str, Any] = {"period_s": 0.05, "silence_s": [0.3, 3.0]}
    with Robot(1, SIM, hears=(1,), diagnostics=quick) as robot:
        robot.say(1)
        wait_for(lambda: robot.heard, "a message")
        robot.link.transmit(on=False)
        states: list[Any] = []
        with MemoryMiddleware(domain_id=domain(1)) as graph:
            wait_for(lambda: "/gr_ros2/link_1" in {info.topic for info in graph.discover()}, "a state that was told")
            graph.subscribe(
                "/gr_ros2/link_1",
                STATUS_TYPE,
                KEPT,
                lambda p: states.append(typestore().deserialize_cdr(p, STATUS_TYPE)),
            )
            wait_for(lambda: states and states[-1].message == "lost", "the link to be lost")
            order = list(dict.fromkeys(state.message for state in states))
            assert order[-2:] == ["degraded", "lost"]
            assert (states[-1].level, states[-1].name) == (2, "gr_ros2/link_1")
            assert float(states[-1].values[0].value) >= 3.0  # it says hundredths
            robot.link.transmit(on=True)
            robot.say(2)
            wait_for(lambda: states[-1].message == "up", "the link to be up again")


@pytest.mark.parametrize(
    ("silence", "missing", "said"),
    [(0.5, 0, "up"), (0.5, 400, "degraded"), (4.0, 0, "degraded"), (11.0, 0, "lost"), (11.0, 400, "lost")],
)
def test_a_link_is_up_degraded_or_lost(silence: float, missing: int, said: str) -> None:
    health = make(period_s=silence)  # a watcher that looks more rarely has not seen the silence
    parts(health, 0.0)
    heard = stats()
    heard["sink"]["silence_s"] = {2: 0.0}
    health.links(heard, health.judge(heard, 1.0)[0])
    now = stats(packets=1000, missing=missing)
    now["sink"]["silence_s"] = {2: silence}
    receiver = health.judge(now, 1.0 + silence)[0]
    state = health.links(now, receiver)[2]
    assert state.message == said
    assert state.level == {"up": Level.OK, "degraded": Level.WARN, "lost": Level.ERROR}[said]
    assert state.values == {"age (s)": f"{silence:.2f}"}
