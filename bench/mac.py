"""Medium access at packet level: one cell, hidden robots, robots that come, go and move; beside ALOHA, CSMA and SOTDMA.

75 packets/s, 10 Hz of one-packet messages per robot, 10 ms from hearing to sending, guard 1 ms.
"""

from __future__ import annotations

import math
import random
import resource
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import repeat
from statistics import mean, median
from typing import NamedTuple

from bench.mac_rivals import Csma, Sotdma
from bench.rows import Row
from bench.swarm import HearingGraph, Swarm, SwarmConfig, fully_meshed
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.mac import Aloha, Slots
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.run.simulate import Simulation, offered_by
from gr_ros2_lab.run.task_run import TaskRun
from tests.link.v1.test_medium_access import Sound

AIRTIME_S, GUARD_S = 1 / 75, 0.001
SLOT_S = AIRTIME_S + GUARD_S
LENGTHS_S = (0.004, 0.02, 0.1, 0.2, 0.4, 1.0)
"""Airtimes of packets of many radios: those of a packet radio, of a chirp or in a voice channel take the longest."""
SEEDS = (1, 2, 3)
MANY_SEEDS = range(1, 13)
"""Where chance decides when groups of robots find common slots."""
SOUND_S, SOUND_LEN, APART_S, GIVEN_UP_S = 0.766, 135, 3.0, 150.0
"""s that a packet of preset ``sound`` takes, and its bytes; s within which the robots are switched on; after which they
are given up."""
FIRST_SEEDS = range(48)
Graph = list[set[int]]


def slots(number: int, rng: random.Random) -> Slots:
    return Slots(number, SLOT_S, rng, period_s=0.1)


def aloha(number: int, rng: random.Random) -> Aloha:
    return Aloha(number, AIRTIME_S, rng, period_s=0.1)


def line(robots: int, reach: int) -> Graph:
    """Robots in a row of which each hears the next ``reach`` on both sides."""
    return [{j for j in range(robots) if j != i and abs(i - j) <= reach} for i in range(robots)]


def within(places: Sequence[tuple[float, float]], reach: float) -> Graph:
    """Robots that hear whom they are near."""
    return [
        {j for j, there in enumerate(places) if j != i and math.dist(here, there) <= reach}
        for i, here in enumerate(places)
    ]


def at_random(robots: int, reach: float, seed: int) -> Graph:
    """Robots in a square of 1 × 1 that all reach each other over some hops."""
    rng = random.Random(seed)
    while True:
        graph = within([(rng.random(), rng.random()) for _ in range(robots)], reach)
        seen, queue = {0}, [0]
        for one in queue:
            queue += graph[one] - seen
            seen |= graph[one]
        if len(seen) == robots:
            return graph


def joined(each: int) -> Graph:
    """Two cells with one robot that hears both."""
    graph = [set(range(each)) - {i} | {2 * each} for i in range(each)]
    graph += [set(range(each, 2 * each)) - {i} | {2 * each} for i in range(each, 2 * each)]
    return [*graph, set(range(2 * each))]


HIDDEN: dict[str, tuple[Graph, float]] = {
    "three in a row": (line(3, 1), 3),
    "line of 10": (line(10, 1), 5),
    "grid of 5 × 4": (within([(x, y) for x in range(5) for y in range(4)], 1.5), 5),
    "50 at random": (at_random(50, 0.25, 4), 5),
    "two cells of 8, one robot between": (joined(8), 3),
}
"""Graph, and the target without other losses in %."""
LOSSY = 8
"""Target in % with 10 % of the packets lost."""


class Moving:
    """Who hears whom of twenty robots that drive from one random place to the next in 160 × 160 m, over 50 m."""

    def __init__(self, speed: float, seed: int) -> None:
        self._speed, self._rng = speed, random.Random(seed)
        self._places, self._goals = ([self._place() for _ in range(20)] for _ in range(2))
        self._since, self._graph = 0.0, within(self._places, 50)

    def _place(self) -> tuple[float, float]:
        return self._rng.uniform(0, 160), self._rng.uniform(0, 160)

    def __call__(self, now: float) -> Graph:
        while now >= self._since + 0.5:
            for robot, (place, goal) in enumerate(zip(self._places, self._goals, strict=True)):
                way, step = math.dist(place, goal), self._speed * 0.5
                if way <= step:
                    self._places[robot], self._goals[robot] = goal, self._place()
                elif way:
                    share = step / way
                    x, y = (here + (there - here) * share for here, there in zip(place, goal, strict=True))
                    self._places[robot] = x, y
            self._since, self._graph = self._since + 0.5, within(self._places, 50)
        return self._graph


def swarm(
    graph: Graph | Callable[[float], Graph],
    config: SwarmConfig,
    make: Callable[..., Slots | Aloha] = slots,
    **times: float,
) -> Swarm:
    return Swarm(make, HearingGraph(graph, config), config, **times).run()


class Measured(NamedTuple):
    """Figures of a swarm, see :class:`Swarm`; ``worst`` is the age of the oldest pair."""

    collided: float
    age: float
    worst: float
    relayed: float


def _measure(graph: Graph | Callable[[float], Graph], config: SwarmConfig, until: float) -> Measured:
    one = swarm(graph, config, t1=until)
    return Measured(one.collided, one.age, one.ages[-1], one.relayed)


def measured(
    graphs: Iterable[Graph | Callable[[float], Graph]], configs: Sequence[SwarmConfig], until: float = 80.0
) -> list[Measured]:
    """Several swarms, on all processors."""
    with ProcessPoolExecutor() as pool:
        return list(pool.map(_measure, graphs, configs, repeat(until)))


class InSlots(NamedTuple):
    """Figures of one cell whose robots always have something to send, counted in slots.

    :ivar share: of the slots that bring each receiver a packet
    :ivar first: slots until all are heard, from cold
    """

    share: float
    first: float


def in_slots(
    robots: int, airtime_s: float, seed: int, *, guard_s: float = GUARD_S, latency_s: float = 0.01, lead_s: float = 0.0
) -> InSlots:
    """One cell of packets of some length, over as many slots as in the other rows."""
    slot_s, rng = airtime_s + guard_s, random.Random(f"begin {seed}")
    begins = {number: (rng.uniform(0, 20) * slot_s, math.inf) for number in range(robots)}
    config = SwarmConfig(airtime_s, latency_s, lead_s, period_s=airtime_s, seed=seed, present=begins)

    def make(number: int, rng: random.Random) -> Slots:
        return Slots(number, slot_s, rng, period_s=0.0, lead_s=lead_s)

    begin, end = 1400, 5600
    one = Swarm(make, HearingGraph(fully_meshed(robots), config), config, t0=begin * slot_s, t1=end * slot_s).run()
    share = one.received / (robots - 1) / (end - begin)
    return InSlots(share, max(one.first_heard.values()) / slot_s if len(one.first_heard) == robots else math.inf)


def lengths() -> list[Row]:
    """The same in slots at all lengths of packets."""
    rows = []
    for robots in (2, 20):
        frame, shares = robots + 1, []
        for airtime_s in LENGTHS_S:
            ran = [in_slots(robots, airtime_s, seed) for seed in SEEDS]
            shares.append(mean(one.share for one in ran))
            first = median(one.first for one in ran) / frame
            what = f"{robots} robots, packets of {1000 * airtime_s:g} ms"
            rows.append(Row(f"{what}: share of the slots", shares[-1], form="{:.3f}"))
            rows.append(Row(f"{what}: all heard from cold", first, "frames", "≤", 25, "{:.0f}"))
        apart = 100 * (max(shares) / min(shares) - 1)
        rows.append(Row(f"{robots} robots, all lengths: shares differ by", apart, "%", "≤", 5, "{:.1f}"))
    return rows


def cells() -> list[Row]:
    """One cell: messages/s per receiver, mean age, Jain, collisions, and what others carry."""
    rows = []
    targets = {20: (57, 0.26), 50: (60, 0.5)}
    for robots in (2, 5, 10, 20, 50):
        ran = [swarm(fully_meshed(robots), SwarmConfig(seed=seed)) for seed in SEEDS]
        rate, age = mean(one.rate for one in ran), mean(one.age for one in ran)
        least, most = targets.get(robots, (0, 0))
        what = f"{robots} robots"
        rows.append(Row(f"{what}: messages/s", rate, "", "≥" if least else None, least, "{:.1f}"))
        rows.append(Row(f"{what}: mean age", age, "s", "≤" if most else None, most, "{:.3f}"))
        rows.append(Row(f"{what}: Jain", min(one.jain for one in ran), "", "≥", 0.99, "{:.3f}"))
        collided = max(one.lost("collision", "sending") for one in ran)
        rows.append(Row(f"{what}: receptions that collide", collided, "", "=" if robots == 20 else None, 0))
        last = max(max(one.first_heard.values()) if len(one.first_heard) == robots else math.inf for one in ran)
        rows.append(Row(f"{what}: all heard from cold", last, "s", "≤" if robots == 50 else None, 15, "{:.1f}"))
        others = {
            "ALOHA": mean(swarm(fully_meshed(robots), SwarmConfig(seed=seed), aloha).rate for seed in SEEDS),
            "CSMA": max(mean(Csma(robots, seed, window).rate() for seed in SEEDS) for window in (0.5, 1, 2, 4, 8)),
            "SOTDMA": mean(Sotdma(robots, seed).rate() for seed in SEEDS),
        }
        rows += [Row(f"{what}: {name}, messages/s", value, form="{:.1f}") for name, value in others.items()]
        if robots == 20:
            best = max(others["ALOHA"], others["CSMA"])
            rows.append(Row(f"{what}: times the best of ALOHA and CSMA", rate / best, "", "≥", 3.5, "{:.1f}"))
            rows.append(Row(f"{what}: times SOTDMA", rate / others["SOTDMA"], "", "≥", 1, "{:.2f}"))
    ran = [swarm(fully_meshed(10), SwarmConfig(seed=seed, loss=0.05)) for seed in SEEDS]
    rows.append(Row("10 robots, 5 % lost: messages/s", mean(one.rate for one in ran), "", "≥", 50, "{:.1f}"))
    return rows + lengths()


class First(NamedTuple):
    """s from the start of the first robot until a message has come out at any other one, and at each of each."""

    any: float
    all: float


def first_messages(robots: int, mode: SealMode, seed: int) -> First:
    """Whole endpoints that are switched on within ``APART_S``, on a channel of packets as of preset ``sound``."""
    rng = random.Random(seed)
    on = sorted(rng.uniform(0, APART_S) for _ in range(robots))
    sound = Sound(SOUND_S, *(at - on[0] for at in rng.sample(on, robots)), mode=mode, seed=seed, packet_len=SOUND_LEN)
    heard: dict[tuple[int, int], float] = {}

    def all_heard() -> bool:
        for one in sound.robots:
            for other in {robot.src_id for robot in sound.robots} - {one.src_id}:
                if (one.src_id, other) not in heard and one.delivered(other):
                    heard[one.src_id, other] = sound.now
        return len(heard) == robots * (robots - 1)

    sound.run(GIVEN_UP_S, until=all_heard)
    times = [*heard.values(), *[math.inf] * (robots * (robots - 1) - len(heard))]
    return First(min(times), max(times))


def first() -> list[Row]:
    """The first messages where a packet takes .77 s and is composed .4 s ahead: medians over many seeds."""
    rows, modes = [], {"none": "", "encrypt": " with a key"}
    with ProcessPoolExecutor() as pool:
        for robots in (2, 3):
            for mode, words in modes.items():
                ran = list(pool.map(first_messages, repeat(robots), repeat(mode), FIRST_SEEDS))
                what, count = f"{robots} robots{words}, packets of {SOUND_S:g} s", len(ran)
                late = sorted(one.all for one in ran)[math.floor(0.9 * count)]
                most = 15 if robots == 2 or mode == "none" else 0
                any_s = median(one.any for one in ran)
                rows.append(Row(f"{what}: first message", any_s, "s", "≤" if most else None, most, "{:.1f}"))
                note = f"nine in ten after {late:.0f} s"
                rows.append(
                    Row(f"{what}: from each to all", median(one.all for one in ran), "s", form="{:.1f}", note=note)
                )
    return rows


def hidden() -> list[Row]:
    """Share of receptions that collide."""
    rows = []
    for loss in (0.0, 0.1):
        configs = [SwarmConfig(seed=seed, loss=loss) for seed in MANY_SEEDS]
        for name, (graph, target) in HIDDEN.items():
            ran = measured(repeat(graph), configs)
            most = LOSSY if loss else target
            worst, age = 100 * max(one.collided for one in ran), mean(one.age for one in ran)
            note = f"worst seed {worst:.1f} %, mean age {age:.2f} s"
            what = f"{name}, {100 * loss:.0f} % lost: collide"
            rows.append(Row(what, 100 * mean(one.collided for one in ran), "%", "≤", most, "{:.1f}", note))
    configs = [SwarmConfig(seed=seed, loss=0.02) for seed in MANY_SEEDS]
    for speed in (0, 2, 10):
        ran = measured([Moving(speed, config.seed) for config in configs], configs, 100)
        collided = 100 * mean(one.collided for one in ran)
        note = f"worst seed {100 * max(one.collided for one in ran):.1f} %"
        rows.append(Row(f"20 robots at {speed} m/s, 2 % lost: collide", collided, "%", "≤", 5, "{:.1f}", note))
    return rows


def changes() -> list[Row]:
    """A newcomer, one that leaves, clocks, a host that freezes, and two groups that meet."""
    rows = []
    heard, back = [], []
    for seed in SEEDS:
        one = swarm(fully_meshed(20), SwarmConfig(seed=seed, present={19: (30.0, math.inf), 5: (0.1, 50.0)}))
        heard.append(one.first_heard.get(19, math.inf) - 30)
        back.append(sum(54 <= at < 64 for times in one.heard_at.values() for at in times) / 10 / 18)
    rows.append(Row("newcomer among 19: heard after", max(heard), "s", "≤", 1.1, "{:.2f}"))
    rows.append(Row("messages/s from 4 s after one leaves", min(back), "", "≥", 57, "{:.1f}"))
    for what, config in (
        ("±50 ppm", {"ppm": 50.0, "jitter_s": 0.0005}),
        ("a clock jumps by 1 s, after 5 s", {"jumps": [(15.0, 2, 1.0)]}),
        ("a host freezes for 1 s, after 5 s", {"frozen": [(14.0, 2, 1.0)]}),
    ):
        ran = [swarm(fully_meshed(20), SwarmConfig(seed=seed, **config)) for seed in SEEDS]
        rows.append(
            Row(
                f"20 robots, {what}: receptions that collide",
                max(one.lost("collision", "sending") for one in ran),
                "",
                "=",
                0,
            )
        )
    apart = [set(range(5)) - {n} for n in range(5)] + [set(range(5, 10)) - {n} for n in range(5, 10)]
    together = fully_meshed(10)
    ran = [swarm(lambda now: apart if now < 15 else together, SwarmConfig(seed=seed)) for seed in range(1, 9)]
    rows.append(
        Row(
            "two groups of 5, 5 s after they meet: collide",
            max(one.lost("collision", "sending") for one in ran),
            "",
            "=",
            0,
        )
    )
    return rows


def scale() -> list[Row]:
    """255 robots that each hear about ten."""
    config = SwarmConfig()
    made = Swarm(slots, HearingGraph(at_random(255, 0.125, 1), config), config, t1=100)
    began = time.process_time()
    made.run()
    seconds = time.process_time() - began
    sent = made.sent
    return [
        Row("255 robots: s for 150,000 packets", seconds * 150_000 / sent, "s", "≤", 60, note=f"{sent:,} packets"),
        Row("255 robots: memory", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, "GB", "≤", 2, "{:.2f}"),
    ]


def _crowded(robots: int, every_s: float) -> list[Row]:
    """One cell into which a robot comes every so many s; the last 20 of its 60 s after that count."""
    begins = {number: (number * every_s, math.inf) for number in range(robots)} if every_s else {}
    until = robots * every_s + 60
    one = swarm(fully_meshed(robots), SwarmConfig(present=begins), t0=until - 20, t1=until)
    what = f"{robots} robots, {f'one every {every_s:g} s' if every_s else 'all at once'}"
    waited = max(at - number * every_s for number, at in one.first_heard.items())
    note = f"age {one.age:.2f} s, oldest pair {one.ages[-1]:.1f} s, {100 * one.collided:.1f} % collide"
    return [
        Row(f"{what}: messages/s", one.rate, form="{:.1f}", note=note),
        Row(f"{what}: heard", len(one.first_heard), note=f"the last {waited:.1f} s after its begin"),
    ]


def crowd() -> list[Row]:
    """One cell of many robots that are switched on at once, or one after another."""
    cases = ((255, 0.5), (100, 0.4), (60, 0.0), (80, 0.0), (100, 0.0))
    with ProcessPoolExecutor() as pool:
        return [row for rows in pool.map(_crowded, *zip(*cases, strict=True)) for row in rows]


def energy() -> list[Row]:
    """Processor time of all that a robot does in simulated time, the medium included, per packet that it hears."""
    rows = []
    for robots, most in ((5, 0), (20, 0.15), (60, 0)):
        sizes = [f"robots={robots}", f"sim.robots={robots}", f"max_sources={robots}"]
        scenario = load_scenario("twenty-robots", [*sizes, "sim.size_m=100"])
        registry = scenario.load_registry()
        messages = [iter(list(one)) for one in offered_by(scenario, registry)]  # the simulator is no part of it
        run = Simulation(scenario, registry, make_phy(scenario, registry), messages=messages)
        began = time.process_time()
        for _ in run.events():
            pass
        spent = 1000 * (time.process_time() - began)
        heard = sum(robot.endpoint.received.packets for robot in run.robots)
        what, note = f"{robots} robots: ms of a core per packet heard", f"{heard:,} packets heard"
        rows.append(Row(what, spent / heard, "ms", "≤" if most else None, most, "{:.3f}", note))
    return rows


def whole() -> list[Row]:
    """20 s of 255 robots with whole endpoints, each of which hears about eleven."""
    near = at_random(255, 0.125, 1)
    gains = tuple(tuple(-100.0 if other in heard else None for other in range(255)) for heard in near)
    sizes = ["robots=255", "max_sources=255", "duration_s=20", "sim.odom_rate=2"]
    scenario = load_scenario("formation", sizes)
    scenario, registry = replace(scenario, gains_db=gains), scenario.load_registry()
    phy = make_phy(scenario, registry)
    run = Simulation(scenario, registry, phy, task=TaskRun(scenario, registry))
    began = time.process_time()
    for _ in run.events():
        pass
    spent = 1000 * (time.process_time() - began)
    heard = sum(robot.endpoint.received.packets for robot in run.robots)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return [
        Row("255 whole robots: ms of a core per packet", spent / heard, "ms", form="{:.3f}", note=f"{heard:,} of them"),
        Row("255 whole robots: memory", memory, "GB", form="{:.2f}"),
    ]


def mac() -> list[Row]:
    """All of it."""
    return [*cells(), *first(), *hidden(), *changes(), *scale(), *crowd(), *energy(), *whole()]
