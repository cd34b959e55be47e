"""A robot that always has a message of class latency to send: whatever else it owes others leaves all the same."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.events import SentPacket
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.mac import Slots
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry
from tests.link.v1.air import SLOT_S, Air, Robot, registry
from tests.link.v1.test_relayed_reliable import Cell
from tests.pairs import pairs

TUNING = Tuning()

JOY, TEXT = 0, 1
LATENCY = SendOptions(qos="latency", queue="fifo")
TOPICS = registry(joy=LATENCY, text=SendOptions())
ODOM = registry(odom=SendOptions(queue="latest"))
MODES: list[SealMode] = ["none", "encrypt"]
MEDIA = ["paced", "slots"]


class Busy(Robot):
    """A robot that has messages of class latency whenever it may send.

    :ivar size: bytes of each of them
    :ivar joys: what it has submitted of them
    """

    size = 40
    full = True

    def slot(self, now: float) -> bytes | None:
        while self.full and self.end.messages.queued()[JOY] < 3:
            self.end.messages.submit(JOY, (b"%d " % self.end.messages.stats.submitted[JOY]).ljust(self.size, b"."), now)
        return super().slot(now)


def busy(src_id: int, medium: str, mode: SealMode, topics: Registry = TOPICS, **settings: Any) -> Busy:
    return Busy(src_id, topics, mode=mode, access=access(src_id, medium), **{"packet_len": 96, **settings})


def plain(src_id: int, medium: str, mode: SealMode, topics: Registry = ODOM, **settings: Any) -> Robot:
    return Robot(src_id, topics, mode=mode, access=access(src_id, medium), **{"packet_len": 96, **settings})


def access(src_id: int, medium: str) -> Slots | None:
    return Slots(src_id, SLOT_S, random.Random(src_id), period_s=0.0) if medium == "slots" else None


def air(medium: str, *robots: Robot, loss: float = 0.0) -> Air | Cell:
    if medium == "paced":
        return Air(*robots, loss=loss)
    cell = Cell(*robots, loss=loss)
    cell._messages = 1 << 30  # it says nothing of its own
    return cell


@pairs(size=[8, 40, 200], loss=[0.1, 0.3], medium=MEDIA, mode=MODES)
def test_what_was_lost_is_repaired(loss: float, size: int, medium: str, mode: SealMode) -> None:
    one, others = busy(1, medium, mode), [plain(src_id, medium, mode) for src_id in (2, 3)]
    one.size = size
    between = air(medium, one, *others, loss=loss)
    between.run(5)
    texts = [b"text %d" % n for n in range(40)]
    for text in texts:
        one.end.messages.submit(TEXT, text, between.now)
        between.run(0.5)
    end = between.now + 15
    while between.now < end and not all(texts[-1] in other.delivered(1) for other in others):
        between.run(1)
    for other in others:
        came = other.delivered(1)
        assert [payload for payload in came if payload in texts] == texts
        assert len(came) > 100


@pytest.mark.parametrize("mode", MODES)
def test_what_is_best_effort_keeps_nothing_back(mode: SealMode) -> None:
    """Its packets are alive for long, and where turns are rare, nothing repairs them."""
    topics = registry(joy=replace(LATENCY, reliability="best_effort"), text=SendOptions())
    one, other = busy(1, "slots", mode, topics), plain(2, "slots", mode)
    between = air("slots", one, other, loss=0.3)
    between.run(5)
    for n in range(20):
        one.end.messages.submit(TEXT, b"text %d" % n, between.now)
        between.run(2)
        assert b"text %d" % (n - 2) in other.delivered(1) or n < 2


@pytest.mark.parametrize("medium", MEDIA)
def test_hellos_leave_in_time(medium: str) -> None:
    one, other = busy(1, medium, "none"), plain(2, medium, "none")
    between = air(medium, one, other)
    between.run(20)
    hellos = [event.now for event in one.events if isinstance(event, SentPacket) and event.kind == "hello"]
    assert max(after - at for at, after in pairwise(hellos)) < 2 * TUNING.hello_seldom_s + TUNING.hello_latency_s + 0.5


@pytest.mark.parametrize(("medium", "mode"), list(zip(MEDIA, MODES, strict=True)))
def test_a_long_table_reaches_a_robot_that_comes_later(medium: str, mode: SealMode) -> None:
    topics = registry(joy=LATENCY, **{f"topic_{n}_with_a_long_name": SendOptions() for n in range(40)})
    one, other, late = busy(1, medium, mode, topics), plain(2, medium, mode), plain(3, medium, mode)
    between = air(medium, one, other, loss=0.1)
    between.run(10)
    between.robots.append(late)
    between.run(20)
    for each in (other, late):
        assert len(each.end.neighbours.all[1].inbox.announced.topics) == 41


@pytest.mark.parametrize(("medium", "mode"), list(zip(MEDIA, reversed(MODES), strict=True)))
def test_it_asks_for_what_others_keep(medium: str, mode: SealMode) -> None:
    """They say nothing else; and it lacks more than fits a packet."""
    kept = {f"map{n}": SendOptions(durability="transient_local", qos="bulk") for n in range(60)}
    one, other = busy(1, medium, mode, packet_len=64), plain(2, medium, mode, registry(**kept), packet_len=64)
    between = air(medium, one, other)
    one.full = False
    for n in range(60):
        other.end.messages.submit(n, b"map %d" % n, between.now)
    between.robots.remove(one)
    between.run(30)
    one.full = True
    between.robots.insert(0, one)
    between.run(60)
    assert {*one.delivered(2)} == {b"map %d" % n for n in range(60)}


@pytest.mark.parametrize("medium", MEDIA)
def test_it_tells_what_arrives(medium: str) -> None:
    one, other = busy(1, medium, "none"), plain(2, medium, "none", TOPICS)
    between = air(medium, one, other, loss=0.2)
    between.run(5)
    texts = [b"text %d" % n for n in range(40)]
    for text in texts:
        other.end.messages.submit(TEXT, text, between.now)
        between.run(0.2)
    between.run(5)
    assert [payload for payload in one.delivered(2) if payload in texts] == texts


@pytest.mark.parametrize("medium", MEDIA)
def test_topics_of_that_class_have_their_turns_too(medium: str) -> None:
    """Of less value per byte than the one that is always full."""
    topics = registry(joy=LATENCY, pose=LATENCY)
    one, other = busy(1, medium, "none", topics), plain(2, medium, "none")
    between = air(medium, one, other)
    between.run(5)
    poses = [b"pose %d " % n * 15 for n in range(20)]
    for pose in poses:
        one.end.messages.submit(1, pose, between.now)
    between.run(10)
    assert [payload for payload in other.delivered(1) if payload in poses] == poses
