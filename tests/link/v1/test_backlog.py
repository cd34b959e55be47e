"""Reliable messages: nothing is given up while the sender repairs, and receivers go on when it does not."""

from __future__ import annotations

import pytest

from bench.repair_backlog import CASES, LOSSES, OLDER, run
from gr_ros2.link.events import SentPacket
from gr_ros2.relay.robots import GONE_S
from gr_ros2.settings.config import SendOptions
from tests.link.v1.air import Air, Robot, registry

FIFO = SendOptions(queue="fifo", reliability="reliable")

pytestmark = pytest.mark.usefixtures("relaying")


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("name", CASES)
def test_long_messages_back_to_back_arrive_beside_odometry(name: str, loss: float) -> None:
    alone, beside = run((), loss), run(CASES[name], loss)
    assert beside.delivered == list(CASES[name])
    assert beside.done < 9.1 / (1 - loss) * 1.05
    assert beside.age <= OLDER * alone.age


@pytest.mark.parametrize("odometry", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_long_messages_arrive_one_way_too(name: str, odometry: bool) -> None:
    """At the expected loss, with the repairs that are enough for it and no more."""
    outcome = run(CASES[name], 0.2, odometry=odometry, reports=False)
    assert outcome.delivered == list(CASES[name])
    assert outcome.done < 9.1 * 1.6


def test_a_full_link_repairs_what_later_messages_wait_for() -> None:
    """Best-effort messages take every slot."""
    one, two = Robot(1, registry(few=FIFO, many=SendOptions(reliability="best_effort", queue="latest"))), Robot(2)
    air = Air(one, two, loss=0.2)
    air.run(1.0)
    for number in range(100):
        one.end.messages.submit(0, b"few %d" % number, air.now)
        for _ in range(10):
            one.end.messages.submit(1, bytes(46), air.now)
            air.step()
    air.run(1.0)
    assert [text for text in two.delivered() if text.startswith(b"few")] == [b"few %d" % n for n in range(100)]


def test_a_message_given_up_by_its_sender_keeps_nothing_back() -> None:
    """Its lifespan is over before it could be repaired; no timer of the receiver runs."""
    stale = SendOptions(queue="fifo", deadline_s=0.1)
    one, two = Robot(1, registry(stale=stale, fifo=FIFO)), Robot(2, hold_s=1000.0)
    air = Air(one, two)
    air.run(2.0)
    air.lost = lambda sender, _: sender is one
    one.end.messages.submit(0, b"stale", air.now)
    air.run(0.2)
    air.lost = lambda *_: False
    one.end.messages.submit(1, b"next", air.now)
    assert air.run(3.0, lambda: bool(two.delivered())) < 1.0
    assert two.delivered() == [b"next"]


@pytest.mark.parametrize("later", [1, 80])
def test_a_receiver_waits_as_long_as_its_sender_repairs(later: int) -> None:
    """Every repair is lost for a minute, in which nothing new is sent. After 80 more packets the loss is forgotten."""
    one, two = Robot(1, registry(fifo=FIFO)), Robot(2, hold_s=0.1)
    air = Air(one, two)
    air.run(2.0)
    air.lost = lambda sender, _: sender is one
    one.end.messages.submit(0, b"first", air.now)
    air.step()

    def repairs(sender: Robot, _: Robot) -> bool:
        return sender is one and next(e.kind for e in reversed(one.events) if isinstance(e, SentPacket)) == "repair"

    air.lost = repairs
    said = [str(number).encode() for number in range(later)]
    for text in said:
        one.end.messages.submit(0, text, air.now)
        air.step()
    air.run(60.0)
    assert two.delivered() == []
    air.lost = lambda *_: False
    air.run(2.0)
    assert two.delivered() == [b"first", *said]


def test_a_receiver_waits_for_a_sender_that_is_out_of_range() -> None:
    one, two = Robot(1, registry(fifo=FIFO)), Robot(2)
    air = Air(one, two)
    air.run(2.0)
    air.lost = lambda sender, _: sender is one
    one.end.messages.submit(0, b"first", air.now)
    air.step()
    air.lost = lambda *_: False
    one.end.messages.submit(0, b"second", air.now)
    air.step()
    air.lost = lambda *_: True
    air.run(3 * GONE_S)
    assert two.delivered() == []
    air.lost = lambda *_: False
    air.run(3.0)
    assert two.delivered() == [b"first", b"second"]
