"""Timers of an endpoint: when it says that it has nothing to do, its next time is later than now.

A loop that asks again at the time it was told would otherwise never come further: a hang in simulated time, a busy
thread in a live link.
"""

from __future__ import annotations

import random
from itertools import pairwise
from math import inf
from struct import pack, unpack
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.events import Delivered
from gr_ros2.settings.config import SendOptions
from gr_ros2.wire.control import Ask
from gr_ros2.wire.v1 import QOS_REPAIR, read_header
from tests.link.v1.air import SLOT_S, Robot, registry
from tests.link.v1.invariants import PacketsEnd
from tests.packets import data_of

TUNING = Tuning()

_STEPS = st.lists(
    st.tuples(st.integers(0, 3), st.sampled_from([0, 5, 40, 45, 46, 47, 300, 1500]), st.floats(0, 0.3)),
    min_size=1,
    max_size=25,
)
_SETTINGS = st.fixed_dictionaries(
    {
        "repair": st.sampled_from(["auto", "idle", "thrifty", "off"]),
        "hold_s": st.sampled_from([0.0, 0.1, 1.0]),
        "repeat_s": st.sampled_from([0.0, 0.7]),
        "half_duplex": st.booleans(),
        "hears": st.booleans(),
    }
)


@settings(max_examples=40)
@given(
    steps=_STEPS,
    options=_SETTINGS,
    queue=st.sampled_from(["fifo", "latest", "deadline"]),
    max_rate=st.sampled_from([0.0, 5.0, 30.1]),
    loss=st.sampled_from([0.0, 0.2, 0.7]),
)
def test_what_is_due_next_is_later(
    steps: list[tuple[int, int, float]], options: dict[str, object], queue: str, max_rate: float, loss: float
) -> None:
    topic = SendOptions(queue=queue, deadline_s=0.2, max_rate=max_rate)  # type: ignore[arg-type]
    topics = registry(a=topic, b=SendOptions(), c=SendOptions(durability="transient_local"), d=topic)
    one, two = Robot(1, topics, **options), Robot(2, **options)
    rng, invariant = random.Random(len(steps)), PacketsEnd((one, two))
    now = slot = 0.0
    for topic_id, size, pause in [*steps, (-1, 0, 1.5)]:
        if topic_id >= 0:
            one.end.messages.submit(topic_id, rng.randbytes(size), now)
        until = now + pause
        while now <= until:
            due = []
            if now >= slot:
                slot = now + SLOT_S
                one.end.pace.credit()
                two.end.pace.credit()
            for robot, other in ((one, two), (two, one)):
                robot.end.handle_timeout(now)
                data = data_of(robot.end.next_packet(now))
                if data is not None and rng.random() >= loss:
                    other.receive(data, now)
            for robot in (one, two):
                robot.events += robot.end.handle_timeout(now)
                out = robot.end.pace.out_of_credit
                if out or robot.end.next_packet(now) is None:
                    departure = robot.end.next_departure()
                    assert departure is None or departure > now, "next_departure"
                    due.append(slot if out or departure is None else departure)
                else:
                    due.append(slot)  # one more packet waits than has left
                timeout = robot.end.next_timeout()
                assert timeout is None or timeout > now, "next_timeout"
                due.append(inf if timeout is None else timeout)
            invariant.step()
            now = min(due, default=slot)


def ages(
    topics: dict[str, SendOptions], offered: list[tuple[float, int, int]], **options: Any
) -> dict[int, list[float]]:
    """s from submission to delivery of (time, topic id, bytes), per topic."""
    one, two = Robot(1, registry(**topics), packet_len=200, **options), Robot(2, packet_len=200)
    coming = sorted(offered)
    found: dict[int, list[float]] = {}
    for step in range(int((coming[-1][0] + 2) / SLOT_S)):
        now = step * SLOT_S
        while coming and coming[0][0] <= now:
            at, topic_id, size = coming.pop(0)
            one.end.messages.submit(topic_id, pack(">d", at).ljust(size, b"."), now)
        for robot, other in ((one, two), (two, one)):
            data = robot.slot(now)
            for event in [] if data is None else other.receive(data, now):
                if isinstance(event, Delivered):
                    found.setdefault(event.topic_id, []).append(now - unpack(">d", event.payload[:8])[0])
    return found


def test_a_topic_above_its_rate_is_thinned_out_and_not_delayed() -> None:
    found = ages({"odom": SendOptions(max_rate=5)}, [(n / 35, 0, 20) for n in range(350)])
    assert 48 <= len(found[0]) <= 52
    assert max(found[0]) < 1 / 35 + 3 * SLOT_S


def test_a_request_without_an_answer_is_repeated_in_time_though_nothing_else_leaves() -> None:
    one = Robot(1, registry(map=SendOptions(durability="transient_local")), repair="off")
    two = Robot(2)
    one.end.messages.submit(0, b"map", 0.0)
    now, asked = 0.0, []
    while now < 5.0:
        if now < 1.0 and (data := one.slot(now)) is not None and read_header(data, 64).qos == QOS_REPAIR:
            two.receive(data, now)  # nothing but hellos, and then nothing any more
        two.end.pace.credit()
        sent = two.end.next_packet(now)
        if sent is not None and any(isinstance(entry, Ask) for entry in sent.packet.body):
            asked.append(now)
        departure = two.end.next_departure(credited=True)
        assert departure is not None
        now = max(now + 0.01, departure if now >= 1.0 else now)
    assert len(asked) > 6
    assert max(later - earlier for earlier, later in pairwise(asked)) < TUNING.ask_s + 0.05
