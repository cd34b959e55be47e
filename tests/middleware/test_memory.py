"""The in-process graph behaves as a DDS does: depth, late joiners, QoS that fits or does not."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from tests.middleware.support import ADAPT, BEST_EFFORT, CUSTOM, LATCHED, RELIABLE, STRING, message
from tests.waiting import PATIENCE_S, wait_for


@pytest.fixture
def ends() -> Iterator[tuple[MemoryMiddleware, MemoryMiddleware]]:
    with MemoryMiddleware(domain_id=3) as one, MemoryMiddleware(domain_id=3) as two:
        yield one, two


Ends = tuple[MemoryMiddleware, MemoryMiddleware]


def test_domains_do_not_mix(ends: Ends) -> None:
    received: list[bytes] = []
    ends[0].subscribe("/a", STRING, RELIABLE, received.append)
    with MemoryMiddleware(domain_id=4) as stranger:
        publisher = stranger.advertise("/a", STRING, RELIABLE)
        publisher.publish(message(1))
        assert publisher.matched() == 0
    ends[1].advertise("/a", STRING, RELIABLE).publish(message(2))
    wait_for(lambda: received == [message(2)], "the message of this domain")


def test_a_graph_ends_with_its_last_participant() -> None:
    with MemoryMiddleware(domain_id=5) as one:
        one.advertise("/a", STRING, LATCHED).publish(message(1))
    received: list[bytes] = []
    with MemoryMiddleware(domain_id=5) as two:
        assert two.subscribe("/a", STRING, ADAPT, received.append).matched() == 0


def test_depth_bounds_what_waits_and_drops_are_counted(ends: Ends) -> None:
    reached, release = threading.Event(), threading.Event()
    received: list[bytes] = []

    def callback(payload: bytes) -> None:
        received.append(payload)
        reached.set()
        release.wait(PATIENCE_S)

    subscription = ends[0].subscribe("/a", STRING, Qos(depth=3), callback)
    publisher = ends[1].advertise("/a", STRING, RELIABLE)
    publisher.publish(message(0))
    wait_for(reached.is_set, "the first callback")
    assert subscription.lost == 0
    for i in range(1, 11):
        publisher.publish(message(i))
    release.set()
    wait_for(lambda: len(received) == 4, "what was kept")
    assert received == [message(i) for i in (0, 8, 9, 10)]
    assert ends[0].counters == {"samples_lost:/a": 7}
    assert subscription.lost == 7


def test_late_joiner_gets_as_much_as_the_publisher_keeps(ends: Ends) -> None:
    publisher = ends[0].advertise("/a", STRING, Qos("reliable", "transient_local", 2))
    for i in range(5):
        publisher.publish(message(i))
    received: list[bytes] = []
    ends[1].subscribe("/a", STRING, LATCHED, received.append)
    publisher.publish(message(5))
    wait_for(lambda: received == [message(3), message(4), message(5)], "the last two and the new one")


def test_volatile_subscription_gets_nothing_from_before(ends: Ends) -> None:
    publisher = ends[0].advertise("/a", STRING, LATCHED)
    publisher.publish(message(1))
    received: list[bytes] = []
    ends[1].subscribe("/a", STRING, RELIABLE, received.append)
    publisher.publish(message(2))
    wait_for(lambda: received == [message(2)], "the new one only")


def test_an_open_subscription_waits_with_latched_messages_until_all_publishers_offer_them(ends: Ends) -> None:
    latched = ends[0].advertise("/a", STRING, LATCHED)
    volatile = ends[0].advertise("/a", STRING, RELIABLE)
    latched.publish(message(1))
    received: list[bytes] = []
    ends[1].subscribe("/a", STRING, ADAPT, received.append)
    latched.publish(message(2))
    wait_for(lambda: received == [message(2)], "the new one only")
    volatile.close()
    wait_for(lambda: received == [message(2), message(1)], "the latched one, once")


@pytest.mark.parametrize(
    ("offered", "requested", "policy"),
    [
        (BEST_EFFORT, Qos("reliable"), "reliability"),
        (RELIABLE, Qos(durability="transient_local"), "durability"),
    ],
)
def test_incompatible_qos_is_counted_on_both_ends(ends: Ends, offered: Qos, requested: Qos, policy: str) -> None:
    ends[0].subscribe("/a", STRING, requested, lambda _: None)
    publisher = ends[1].advertise("/a", STRING, offered)
    assert publisher.matched() == 0
    assert ends[0].counters == ends[1].counters == {f"incompatible_qos:/a:{policy}": 1}


def test_another_type_does_not_match(ends: Ends) -> None:
    ends[0].subscribe("/a", STRING, ADAPT, lambda _: None)
    assert ends[1].advertise("/a", CUSTOM, LATCHED).matched() == 0
    assert ends[0].counters == {"incompatible_type:/a": 1}


def test_a_callback_may_subscribe_publish_and_close(ends: Ends) -> None:
    here, there = ends
    answers: list[bytes] = []
    here.subscribe("/answer", STRING, RELIABLE, answers.append)

    def answer(payload: bytes) -> None:
        there.advertise("/answer", STRING, RELIABLE).publish(payload)
        subscription.close()

    subscription = there.subscribe("/question", STRING, RELIABLE, answer)
    question = here.advertise("/question", STRING, RELIABLE)
    question.publish(message(1))
    wait_for(lambda: answers == [message(1)], "the answer")
    wait_for(lambda: question.matched() == 0, "the subscription's end")


def test_closed_participants_refuse(ends: Ends) -> None:
    ends[0].close()
    with pytest.raises(MiddlewareError):
        ends[0].advertise("/a", STRING, RELIABLE)
    with pytest.raises(ConfigError):
        MemoryMiddleware(domain_id=999)
