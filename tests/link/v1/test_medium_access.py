"""Slots at an endpoint: packets that come twice, and a robot without the key."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise
from math import inf
from statistics import median
from typing import Any

import pytest

from gr_ros2.link.airtime import LEAD_S, AirtimeClock
from gr_ros2.link.v1.sealing import Keys, SealMode
from gr_ros2.mac import Slots
from gr_ros2.settings.config import SendOptions
from gr_ros2.wire.mac_block import Block, read_block, write_block
from gr_ros2.wire.v1 import (
    QOS_REPAIR,
    TABLE_TOPIC,
    Header,
    Part,
    read_body,
    read_header,
    read_repair_header,
    write_header,
)
from tests.link.v1.air import Robot, registry

AIRTIME = 0.010
SLOT = 0.011
SHORT = 0.0006
"""s that the shortest packet lasts."""


def robot(src_id: int, mode: SealMode, slot_s: float = SLOT, seed: int = 0) -> tuple[Robot, Slots]:
    access = Slots(src_id, slot_s, random.Random(src_id + 1000 * seed), period_s=0.1)
    return Robot(src_id, registry(), mode=mode, access=access), access


class Greedy:
    """Announces the next two sends of another robot as its own, and sends in any slot."""

    lead_s, turn_s, named = 0.0, SLOT, True

    def __init__(self, victim: Slots) -> None:
        self.victim = victim
        self.now = 0.0

    def departure(self, now: float) -> float:
        self.now = now
        return now

    def block(self, weight: int = 1, *, fills: bool = False) -> bytes:  # noqa: ARG002
        slot = self.victim.clock.slot(self.now)
        first, second = [*self.victim._mine, slot + 20, slot + 40][:2]
        ahead = max(first - slot, 1), max(second - first, 1)
        return write_block(Block(slot % 256, ahead, 40, (1, 2), 0xFFFFFFF, (ahead[0], self.victim.src_id)))

    def hear(
        self, src_id: int, block: Block | None, began: float, *, trusted: bool = True, checked: bool = False
    ) -> None:
        pass


Junk = Callable[[float], list[bytes]]


def talk(
    robots: list[Robot],
    begin: float,
    seconds: float,
    *,
    every: float = inf,
    junk: Junk = lambda _: [],
    airtime_s: float = AIRTIME,
) -> list[tuple[float, Robot, bytes]]:
    """Let robots send, each once it may; what overlaps is lost.

    :param junk: what an outsider sends every so many s, if it overlaps nothing: short packets, several in a slot
    """
    sent: list[tuple[float, Robot, bytes]] = []
    busy, now, due = begin, begin, begin + every
    for one in robots:
        one.end.handle_timeout(begin)
    while now < begin + seconds:
        now, at = min((max(now, r.end.next_departure(credited=True) or now), n) for n, r in enumerate(robots))
        if due + airtime_s < now:
            for number, other_data in enumerate(junk(due) if due >= busy else ()):
                for other in robots:
                    other.receive(other_data, due + airtime_s, due + number * SHORT)
            due += every
            now = due - every + airtime_s
            continue
        data = robots[at].slot(now)
        if data is None:
            continue
        if now >= busy - 1e-9:
            for other in robots:
                if other is not robots[at]:
                    other.receive(data, now + airtime_s, now)
        busy = now + airtime_s
        sent.append((now, robots[at], data))
    return sent


def state(access: Slots) -> tuple[object, ...]:
    calendar = access.calendar
    known = sorted(access.around.robots), dict(calendar._taken), calendar._expected, dict(calendar._conflicts)
    return access.clock.begin(0), access.clock.jumps, list(access._mine), *known


def test_who_is_asked_before_the_sending_thread_has_looked_sends_all_the_same() -> None:
    """A medium in lock step asks each robot whether it is at rest as soon as it is connected."""
    one, two = robot(1, "open")[0], robot(2, "open")[0]
    assert one.end.next_departure(credited=True) == -inf
    sent = talk([one, two], 1000.0, 5.0)
    assert {sender.src_id for _, sender, _ in sent} == {1, 2}


@pytest.mark.parametrize("mode", ["none", "authenticate", "encrypt"])
def test_a_packet_that_comes_twice_moves_nobody(mode: SealMode) -> None:
    (one, _), (two, access) = robot(1, mode), robot(2, mode)
    sent = talk([one, two], 0.0, 5.0)
    assert access._confirmed_at > 0
    before = state(access)
    replayed = [data for _, sender, data in sent if sender is one]
    assert len(replayed) > 20
    for number, data in enumerate(replayed):
        began = 5.0 + SLOT * (number + 0.5)
        two.receive(data, began + AIRTIME, began)
    assert state(access) == before


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_a_robot_without_the_key_takes_slots_from_nobody_for_longer_than_it_sends(mode: SealMode) -> None:
    (one, _), (two, access) = robot(1, "encrypt"), robot(2, "encrypt")
    talk([one, two], 0.0, 5.0)
    intruder = Robot(0, registry(), mode=mode, access=Greedy(access))  # the lower id would win
    intruder.keys = Keys((bytes(32),), "encrypt") if mode == "encrypt" else Keys()
    intruder.start()
    before = state(access)
    slots = access.clock.slot(5.1)
    for number in range(40):
        now = access.clock.begin(slots + number)
        data = intruder.slot(now)
        assert data is not None
        two.receive(data, now + AIRTIME, now)
    zero, jumps, mine, known, taken, *rest = state(access)
    assert (zero, jumps, mine, known, *rest) == (*before[:4], *before[5:])
    assert isinstance(taken, dict)
    assert {slot for slot, owner in taken.items() if owner == 0} <= {*range(slots, slots + 40 + 2 * 40)}
    sent = [(at, data) for at, sender, data in talk([one, two], now, 5.0) if sender is two]
    for (at, data), (after, _) in pairwise(sent[2:]):
        ahead = read_block(read_header(data, 64).block)[0].ahead[0]
        assert after == pytest.approx(at + ahead * SLOT, abs=SLOT / 2), "each announced send takes place"


AHEAD_S, HEARD_AFTER_S = 0.4, 0.1


class Sound:
    """A channel on which packets are handed over long ahead of their bursts, as to a sound card.

    :param on: when each robot is switched on, s
    """

    def __init__(self, airtime_s: float, *on: float, mode: SealMode, seed: int = 0, packet_len: int = 64) -> None:
        self.robots, self.now, self.late, self.sent = list[Robot](), 0.0, 0, 0
        self._airtime_s, self._on = airtime_s, on
        self._gates = [AirtimeClock[bytes](airtime_s, ahead=AHEAD_S) for _ in on]
        self._air: list[tuple[float, int, bytes]] = []
        self._over: list[tuple[float, int, bytes]] = []
        self._steps = 0
        for src_id in range(1, len(on) + 1):
            rng = random.Random(100 * seed + src_id)
            access = Slots(src_id, airtime_s + 0.05, rng, period_s=0.0, lead_s=LEAD_S + AHEAD_S)
            self.robots.append(Robot(src_id, registry(), mode=mode, access=access, packet_len=packet_len))

    def run(self, seconds: float, *, speak: bool = True, until: Callable[[], bool] = lambda: False) -> None:
        """So long, or until something is so; every robot has a new message each second."""
        end = self.now + seconds
        while self.now < end and not until():
            for robot, gate, on in zip(self.robots, self._gates, self._on, strict=True):
                if self.now >= on:
                    self._leave(robot, gate, speak=speak and not self._steps % round(1 / LEAD_S))
            lasts = self._airtime_s + HEARD_AFTER_S
            over = [one for one in self._air if one[0] + lasts <= self.now and one not in self._over]
            self._over += over
            for began, src_id, data in over:
                alone = not any(o != src_id and abs(at - began) < self._airtime_s for at, o, _ in self._air)
                for robot, on in zip(self.robots, self._on, strict=True):
                    if alone and robot.src_id != src_id and self.now >= on:
                        robot.receive(data, self.now, began)
            self._air = [one for one in self._air if one[0] > self.now - 2 - self._airtime_s]
            self._over = [one for one in self._over if one in self._air]
            self._steps += 1
            self.now = self._steps * LEAD_S

    def _leave(self, robot: Robot, gate: AirtimeClock[bytes], *, speak: bool) -> None:
        if speak:
            robot.end.messages.submit(0, b"%d %d" % (robot.src_id, self._steps), self.now)
            self.sent += 1
        gate.due(self.now)
        robot.end.pace.credit(gate.grants(self.now))
        if (packet := robot.end.next_packet(self.now)) is not None:
            begin = gate.offer(packet.data, self.now, leave_at=packet.leave_at)
            assert begin is not None
            self.late += begin < self.now + AHEAD_S - 1e-6
            self._air.append((max(begin, self.now + AHEAD_S), robot.src_id, packet.data))


@pytest.mark.parametrize("mode", ["none", "encrypt"])
@pytest.mark.parametrize("airtime_s", [0.068, 0.204])
def test_messages_cross_where_packets_are_handed_over_long_ahead_as_to_a_sound_card(
    airtime_s: float, mode: SealMode
) -> None:
    sound = Sound(airtime_s, 0.0, 0.0, mode=mode)
    sound.run(60)
    sound.run(15, speak=False)
    assert sum(len(robot.delivered()) for robot in sound.robots) == sound.sent == 2 * 60
    assert sound.late == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 16, 17, 20, 24, 41, 44, 78])
def test_three_robots_with_a_key_hear_each_other_soon_where_packets_take_half_a_second(seed: int) -> None:
    """They are switched on one after the other; without a hello nobody knows who sends. 180 packets of one fit in."""
    rng = random.Random(seed)
    sound = Sound(0.53, *(rng.uniform(0, 3) for _ in range(3)), mode="encrypt", seed=seed)

    def whole() -> bool:
        return all(one.delivered(other) for one in sound.robots for other in {1, 2, 3} - {one.src_id})

    sound.run(100, until=whole)
    assert whole()


@pytest.mark.parametrize(("mode", "most"), [("none", 18), ("encrypt", 20)])
def test_the_first_message_comes_after_some_turns_however_long_a_packet_lasts(mode: SealMode, most: int) -> None:
    """From cold: a robot that starts, or is met, does not only say that it is there."""
    airtime_s, took = 0.526, []
    for seed in range(15):
        robots = [robot(src_id, mode, airtime_s + SLOT - AIRTIME, seed)[0] for src_id in (1, 2)]
        for one in robots:
            one.end.messages.submit(0, b"%d" % one.src_id, 0.0)
        now = 0.0
        while now < 100 * airtime_s and not all(one.delivered() for one in robots):
            now = airtime_s + max([now, *(at for at, _, _ in talk(robots, now, airtime_s, airtime_s=airtime_s))])
        took.append(round(now / airtime_s))
    assert median(took) <= most


@pytest.mark.slow
@pytest.mark.parametrize(("size", "mode"), [(2, "none"), (3, "none")])
def test_a_message_comes_out_a_quarter_of_a_minute_after_the_start_where_packets_take_half_a_second(
    size: int, mode: SealMode
) -> None:
    """Of robots that are switched on within three seconds; simulated time."""
    took = []
    for seed in range(16):
        rng = random.Random(seed)
        sound = Sound(0.53, 0.0, *(rng.uniform(0, 3) for _ in range(size - 1)), mode=mode, seed=seed)
        sound.run(100, until=lambda: any(one.delivered() for one in sound.robots))  # noqa: B023 - called at once
        took.append(sound.now)
    assert median(took) <= 15


def test_a_row_goes_before_its_messages_and_rows_of_silent_topics_take_what_is_left() -> None:
    one, two = (robot(src_id, "none", 0.53)[0] for src_id in (1, 2))
    for number in range(8):
        one.end.messages.submit(0, b"message %d" % number, 0.0)
    sent = [data for _, sender, data in talk([one, two], 0.0, 40.0, airtime_s=0.5) if sender is one]
    packets = [read_body(data[read_header(data, 64).size : -4], 64) for data in sent if not is_repair(data)]
    entries = [entry for packet in packets for entry in packet if isinstance(entry, Part)]
    assert entries[0].topic_id == TABLE_TOPIC
    assert entries[0].payload[1] == 0
    messages = [place for place, entry in enumerate(entries) if entry.topic_id == 0]
    silent = [place for place, entry in enumerate(entries) if entry.topic_id == TABLE_TOPIC and entry.payload[1] == 2]
    assert len(two.delivered()) == 8
    assert messages[-1] < silent[0]


def rare(src_id: int, **settings: Any) -> Robot:
    """A robot of a channel whose packets take half a second, with a reliable topic."""
    access = Slots(src_id, 0.6, random.Random(src_id), period_s=0.0)
    topics = registry(odom=SendOptions(reliability="reliable"))
    return Robot(src_id, topics, access=access, **{"packet_len": 135, **settings})


def sent_by(one: Robot, count: int) -> list[bytes]:
    """Its next packets, with a new message for each."""
    now, packets = 0.0, list[bytes]()
    one.end.handle_timeout(now)
    while len(packets) < count:
        one.end.messages.submit(0, b"message %d" % len(packets), now)
        while (data := one.slot(now)) is None:
            now = max(now, one.end.next_departure(credited=True) or now)
        packets.append(data)
    return packets


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_where_turns_are_rare_the_first_packet_that_is_heard_brings_its_message(lost: int) -> None:
    """It tells who its sender is, its topic, and a message; what was sent to nobody is not waited for."""
    one, two = rare(1), rare(2)
    packets = sent_by(one, lost + 1)
    two.receive(packets[-1], 10.0, 9.5)
    assert two.delivered(1) == [b"message %d" % lost]
    two.receive(packets[-1], 11.0, 10.5)
    assert two.delivered(1) == [b"message %d" % lost], "a recording delivers nothing again"


def test_a_robot_that_starts_again_is_met_by_a_message_too() -> None:
    one, two = rare(1), rare(2)
    two.receive(sent_by(one, 1)[0], 10.0, 9.5)
    one.access = Slots(1, 0.6, random.Random(7), period_s=0.0)
    one.start()
    again = sent_by(one, 1)[0]
    two.receive(again, 60.0, 59.5)
    assert two.delivered(1) == [b"message 0"] * 2
    damaged = bytearray(again)
    damaged[30] ^= 1
    two.receive(bytes(damaged), 61.0, 60.5)
    assert len(two.delivered(1)) == 2


@pytest.mark.parametrize("mode", ["authenticate", "encrypt"])
def test_with_a_key_hellos_stay_alone(mode: SealMode) -> None:
    one = rare(1, mode=mode, packet_len=64)
    assert [is_repair(data) for data in sent_by(one, 2)] == [True, True]


def team(size: int) -> tuple[list[Robot], list[Slots]]:
    """Robots with a key that have met."""
    made = [robot(src_id, "encrypt") for src_id in range(1, size + 1)]
    robots, accesses = [one for one, _ in made], [access for _, access in made]
    talk(robots, 0.0, 8.0)
    return robots, accesses


def strangers(of: Slots, rng: random.Random) -> Junk:
    """Short packets of robots that nobody knows, each of which wants two slots, four in a slot."""

    def junk(now: float) -> list[bytes]:
        slot = of.clock.slot(now + SLOT / 2)
        blocks = [Block(slot % 256, (rng.randrange(2, 60), rng.randrange(2, 60))) for _ in range(4)]
        heads = [Header(0, True, rng.randrange(100, 200), rng.randrange(1 << 16), block=write_block(b)) for b in blocks]
        return [write_header(head) + rng.randbytes(12) for head in heads]

    return junk


@pytest.mark.parametrize("size", [2, 4])
def test_what_nobody_can_check_takes_no_more_than_its_own_slots(size: int) -> None:
    """An outsider takes 4 % of the air."""
    rates = {}
    for attacked in (False, True):
        robots, accesses = team(size)
        rng = random.Random(2)

        sent = talk(robots, 8.0, 6.0, every=5 * SLOT if attacked else inf, junk=strangers(accesses[0], rng))
        rates[attacked] = len(sent)
        assert all(access.clock.jumps == 0 for access in accesses)
    assert rates[True] > 0.9 * rates[False]


@pytest.mark.parametrize("size", [2, 3, 4])
def test_a_newcomer_gets_in_beside_what_nobody_can_check(size: int) -> None:
    """An outsider takes a sixth of the slots."""
    rates = {}
    for attacked in (False, True):
        robots, accesses = team(size)
        newcomer, _ = robot(size + 1, "encrypt")
        junk = strangers(accesses[0], random.Random(3))
        sent = talk([*robots, newcomer], 8.0, 10.0, every=6 * SLOT if attacked else inf, junk=junk)
        rates[attacked] = sum(sender is newcomer for _, sender, _ in sent)
    assert rates[True] > 0.9 * rates[False]


def is_repair(data: bytes) -> bool:
    return read_header(data, 64).qos == QOS_REPAIR


def is_hello(data: bytes) -> bool:
    header = read_header(data, 64)
    return header.qos == QOS_REPAIR and read_repair_header(data, header.size, 56).clear


def test_recordings_of_a_robot_that_is_dead_neither_slow_others_nor_move_their_clocks() -> None:
    robots, _ = team(4)
    recorded = [data for _, sender, data in talk(robots, 8.0, 90.0) if sender is robots[3] and is_hello(data)]
    assert len(recorded) > 30
    rates = {}
    for attacked in (False, True):
        alive = robots[:3]
        for one in alive:
            one.access = Slots(one.src_id, SLOT, random.Random(one.src_id), period_s=0.1)
            one.start()
        talk(alive, 100.0, 8.0)
        queue = iter(recorded)
        every = 1.5 if attacked else inf
        sent = talk(alive, 108.0, 40.0, every=every, junk=lambda _, queue=queue: [next(queue)])  # type: ignore[misc]
        rates[attacked] = sum(sender is alive[0] for at, sender, _ in sent if at > 118.0)
        for one in alive:
            assert isinstance(one.access, Slots)
            assert one.access.clock.jumps == 0
            assert {peer.robot for peer in one.end.peers(148.0)} == {1, 2, 3} - {one.src_id}
    assert rates[True] > 0.9 * rates[False]


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_a_topic_comes_out_of_the_first_packet_that_is_heard_however_many_were_lost(lost: int) -> None:
    """Its row of the table goes along until everybody that is heard has heard this robot, before those of others."""
    one, other = rare(1), rare(2)
    one.topics = registry()
    one.start()
    packets = sent_by(one, lost + 1)
    other.end.handle_timeout(0.0)
    other.receive(packets[-1], 100.0)
    assert other.delivered(1)
