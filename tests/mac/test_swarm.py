"""Many robots at packet level: rate, age and collisions in one cell, hidden robots, clocks, and who comes and goes."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from itertools import count
from statistics import mean, median

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from bench.mac import in_slots
from bench.swarm import HearingGraph, Swarm, SwarmConfig, fully_meshed
from gr_ros2.link.access import Access
from gr_ros2.mac import Aloha, Slots
from gr_ros2.wire.mac_block import Block

AIRTIME = 1 / 75
SLOT = AIRTIME + 0.001
SLOWEST = {10: (1, 2, 9, 49, 52), 50: (25, 35, 42)}
"""Seeds with which robots took longest to be heard, by their number."""


def slots(number: int, rng: random.Random) -> Slots:
    return Slots(number, SLOT, rng, period_s=0.1)


def aloha(number: int, rng: random.Random) -> Aloha:
    return Aloha(number, AIRTIME, rng, period_s=0.1)


def cell(robots: int, config: SwarmConfig, **times: float) -> Swarm:
    return Swarm(slots, HearingGraph(fully_meshed(robots), config), config, **times).run()


def test_twenty_robots_in_one_cell_share_it_without_a_collision() -> None:
    swarm = cell(20, SwarmConfig(), t1=50)
    assert swarm.rate >= 57
    assert swarm.age <= 0.26
    assert swarm.jain >= 0.99
    assert swarm.lost("collision", "sending") == 0


@pytest.mark.slow
@pytest.mark.parametrize("robots", [2, 10])
def test_packets_of_any_length_fill_the_same_share_of_the_slots_after_as_many_frames(robots: int) -> None:
    usual = [in_slots(robots, AIRTIME, seed) for seed in (1, 2)]
    for airtime_s in (0.004, 1.0):
        found = [in_slots(robots, airtime_s, seed) for seed in (1, 2)]
        assert mean(one.share for one in found) == pytest.approx(mean(one.share for one in usual), rel=0.05), airtime_s
        assert median(one.first for one in found) <= 25 * (robots + 1), airtime_s


@pytest.mark.parametrize("robots", [2, 4])
@pytest.mark.parametrize("airtime_s", [0.068, 0.204])
def test_packets_that_are_composed_far_ahead_as_for_a_sound_card_find_their_slots(
    robots: int, airtime_s: float
) -> None:
    found = in_slots(robots, airtime_s, 1, guard_s=0.05, latency_s=0.1, lead_s=0.4)
    assert found.share >= 0.95 * in_slots(robots, airtime_s, 1, guard_s=0.05).share
    assert found.first <= 25 * (robots + 1)


@pytest.mark.parametrize(("robots", "within_s"), [(10, 4), (50, 15)])
def test_robots_that_are_switched_on_at_once_are_all_heard_soon(robots: int, within_s: float) -> None:
    for seed in SLOWEST[robots]:
        assert len(cell(robots, SwarmConfig(seed=seed), t0=within_s - 1, t1=within_s).first_heard) == robots


@pytest.mark.parametrize("airtime_s", [0.01, 0.08])
def test_two_robots_have_their_full_rate_60_frames_after_an_outage(airtime_s: float) -> None:
    slot_s, lead_s = airtime_s + 0.001, 0.005
    frame, apart, together = 3 * slot_s, [set(), set()], fully_meshed(2)
    for seed in range(1, 41):
        config = SwarmConfig(airtime_s, lead_s=lead_s, period_s=airtime_s, seed=seed)
        graph = HearingGraph(lambda now: apart if 50 * frame < now < 110 * frame else together, config)

        def make(number: int, rng: random.Random) -> Slots:
            return Slots(number, slot_s, rng, period_s=0.0, lead_s=lead_s)

        swarm = Swarm(make, graph, config, t0=170 * frame, t1=230 * frame).run()
        assert swarm.received / (60 * 3) >= 0.55


@pytest.mark.parametrize("others", [1, 2])
def test_a_robot_that_comes_to_few_others_is_heard_soon_whoever_was_there_first(others: int) -> None:
    """Packets of half a second, composed .15 s ahead as for a sound card; one robot alone sends seldom before."""
    airtime_s, heard, comes = 0.526, [], 300.0
    for seed in range(1, 41):
        present = {others: (comes + seed, math.inf)}
        config = SwarmConfig(airtime_s, 0.1, 0.155, period_s=airtime_s, seed=seed, present=present)

        def make(number: int, rng: random.Random) -> Slots:
            return Slots(number, airtime_s + 0.002, rng, period_s=0.0, lead_s=0.155)

        until = comes + 100
        first = (
            Swarm(make, HearingGraph(fully_meshed(others + 1), config), config, t0=comes, t1=until).run().first_heard
        )
        heard.append((max(first.get(others, math.inf), first[0]) - comes - seed) / airtime_s)
    assert median(heard) <= 20
    assert max(heard) <= 60


def test_slots_carry_several_times_what_aloha_does() -> None:
    config = SwarmConfig()
    both = [Swarm(make, HearingGraph(fully_meshed(20), config), config, t1=40).run() for make in (slots, aloha)]
    assert both[0].rate >= 3.5 * both[1].rate > 0


def test_the_same_swarm_gives_the_same_numbers() -> None:
    one, other = (cell(4, SwarmConfig(loss=0.1), t1=25) for _ in range(2))
    assert (one.rate, one.ages) == (other.rate, other.ages)


def test_clocks_that_differ_by_50_ppm_stay_together() -> None:
    swarm = cell(5, SwarmConfig(ppm=50, jitter_s=0.0005), t1=60)
    assert swarm.lost("collision", "sending") == 0


def test_of_three_in_a_row_the_outer_ones_leave_each_other_the_air() -> None:
    config = SwarmConfig()
    swarm = Swarm(slots, HearingGraph([{1}, {0, 2}, {1}], config), config).run()
    assert swarm.collided <= 0.03


def test_by_relaying_every_robot_of_a_line_hears_of_every_other() -> None:
    line = [{j for j in range(6) if abs(i - j) == 1} for i in range(6)]
    config = SwarmConfig(loss=0.1, relay=True)
    swarm = Swarm(slots, HearingGraph(line, config), config, t1=60).run()
    assert len(swarm.ages) == 30
    assert swarm.ages[-1] <= 2.0
    assert swarm.relayed >= 0.3


def test_where_all_hear_all_next_to_nothing_is_relayed_and_nothing_gets_older() -> None:
    relaying, plain = (cell(10, SwarmConfig(loss=0.1, relay=relay), t1=40) for relay in (True, False))
    assert relaying.relayed <= 0.02
    assert relaying.age <= 1.02 * plain.age


@pytest.mark.parametrize("by", [1.0, -1.0])
def test_a_clock_that_jumps_disturbs_the_others_for_a_moment_only(by: float) -> None:
    swarm = cell(5, SwarmConfig(jumps=[(25.0, 2, by)]), t0=30, t1=60)
    assert swarm.lost("collision", "sending") == 0
    assert swarm.jain >= 0.99


def test_a_host_that_freezes_for_a_second_comes_back() -> None:
    swarm = cell(5, SwarmConfig(frozen=[(25.0, 2, 1.0)]), t0=29, t1=60)
    assert swarm.lost("collision", "sending") == 0
    assert swarm.jain >= 0.99


def test_two_groups_that_meet_have_common_slots_within_five_seconds() -> None:
    config = SwarmConfig()
    apart = [set(range(5)) - {n} for n in range(5)] + [set(range(5, 10)) - {n} for n in range(5, 10)]
    together = fully_meshed(10)
    swarm = Swarm(slots, HearingGraph(lambda at: apart if at < 20.0 else together, config), config, t0=25, t1=50).run()
    assert swarm.lost("collision", "sending") == 0


def test_a_newcomer_is_heard_soon_and_who_leaves_is_made_up_for() -> None:
    swarm = cell(20, SwarmConfig(present={19: (30.0, 1e9), 5: (0.1, 50.0)}), t1=70)
    assert swarm.first_heard[19] - 30.0 <= 1.1
    after = sum(54 <= at < 64 for heard in swarm.heard_at.values() for at in heard) / 10 / 18
    assert after >= 57


# ---- theory


class Timetable:
    """Sends in given slots, one after the other."""

    def __init__(self, slots: Iterator[int]) -> None:
        self._slots = slots
        self._next = next(slots)

    def departure(self, now: float) -> float:
        while (at := self._next * SLOT) < now - SLOT / 2:
            self._next = next(self._slots)
        return at

    def block(self, weight: int = 1, *, fills: bool = False) -> bytes | None:  # noqa: ARG002
        self._next = next(self._slots)
        return b""

    def hear(self, src_id: int, block: Block | None, began: float, *, trusted: bool = True) -> None:
        pass


class NonPersistent:
    """Carrier sensing of Kleinrock and Tobagi (1975): tries at random times, and gives up where the channel is busy.

    :param air: of all robots: when the newest packet on the channel is over
    :param tries: per s
    """

    def __init__(self, air: list[float], tries: float, delay_s: float, rng: random.Random) -> None:
        self._air, self._tries, self._delay, self._rng = air, tries, delay_s, rng
        self._at, self._decided = rng.expovariate(tries), False

    def departure(self, now: float) -> float:  # noqa: ARG002
        return self._at

    def block(self, weight: int = 1, *, fills: bool = False) -> bytes | None:  # noqa: ARG002
        if self._decided:
            self._air[0] = max(self._air[0], self._at + AIRTIME)
        elif self._at >= self._air[0]:
            self._decided, self._at = True, self._at + self._delay
            return None
        sends, self._decided = self._decided, False
        self._at += self._rng.expovariate(self._tries)
        return b"" if sends else None

    def hear(self, src_id: int, block: Block | None, began: float, *, trusted: bool = True) -> None:
        pass


def ideal(robots: int, make: Callable[[int, random.Random], Access], seconds: float) -> Swarm:
    """One cell whose robots have one clock, always have a message that is new, and hear without delay."""
    config = SwarmConfig(latency_s=0.0, period_s=1e-4)
    swarm = Swarm(make, HearingGraph(fully_meshed(robots), config), config, t0=5.0, t1=5.0 + seconds)
    for robot in swarm.robots:
        robot._offset = 0.0
    return swarm.run()


def test_slotted_aloha_carries_one_packet_in_e_slots_and_its_age_is_e_slots_per_robot() -> None:
    """Abramson 1975: each sends in a slot with probability 1 / n; (1 - 1 / n)^(n - 1) of the slots carry a packet."""
    robots = 20

    def make(_: int, rng: random.Random) -> Timetable:
        return Timetable(slot for slot in count() if rng.random() < 1 / robots)

    swarm = ideal(robots, make, 150)
    share = (1 - 1 / robots) ** (robots - 1)
    assert share == pytest.approx(1 / math.e, rel=0.03)
    assert swarm.rate * SLOT == pytest.approx(share, rel=0.05)
    assert swarm.age / SLOT == pytest.approx(robots / share, rel=0.08)


def test_round_robin_carries_all_and_its_age_is_half_a_slot_per_robot() -> None:
    robots = 20
    swarm = ideal(robots, lambda number, _: Timetable(count(number, robots)), 30)
    assert swarm.rate * SLOT == pytest.approx(1, rel=0.01)
    assert swarm.age == pytest.approx(robots / 2 * SLOT + AIRTIME, rel=0.01)


def test_carrier_sensing_with_a_host_between_carries_what_kleinrock_and_tobagi_say() -> None:
    """S = G exp(-aG) / (G (1 + 2a) + exp(-aG)); a is the delay from hearing to sending in airtimes."""
    robots, a = 30, 0.75

    def carried(load: float) -> float:
        return load * math.exp(-a * load) / (load * (1 + 2 * a) + math.exp(-a * load))

    load = max((n / 100 for n in range(1, 300)), key=carried)
    assert carried(load) == pytest.approx(0.179, abs=0.001)
    air = [0.0]
    swarm = ideal(robots, lambda _, rng: NonPersistent(air, load / AIRTIME / robots, a * AIRTIME, rng), 200)
    assert swarm.rate * AIRTIME == pytest.approx(carried(load), rel=0.06)
