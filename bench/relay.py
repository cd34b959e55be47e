"""Relaying by gain at packet level: the mean age over all pairs of robots, which partly hear each other over hops only.

As ``bench.mac``: 75 packets/s, 10 Hz of one-packet messages per robot, 10 ms from hearing to sending, guard 1 ms, in
slots; 10 % of the packets are lost beside those that collide. And a map for one robot over hops: whole endpoints in a
line of which each hears the next.
"""

from __future__ import annotations

import random
from itertools import repeat
from statistics import mean

from bench.mac import MANY_SEEDS, Graph, Measured, at_random, joined, line, measured, within
from bench.rows import Row
from bench.swarm import SwarmConfig, fully_meshed
from gr_ros2.settings.config import SendOptions
from tests.link.v1.air import registry
from tests.link.v1.test_relaying import Line, robot

TOPOLOGIES: dict[str, tuple[Graph, float]] = {
    "line of 10, 3 hops": (line(10, 3), 0.45),
    "line of 10, 9 hops": (line(10, 1), 1.5),
    "grid of 5 × 4, 5.5 neighbours": (within([(x, y) for x in range(5) for y in range(4)], 1.5), 1.1),
    "two cells of 8, one robot between": (joined(8), 1.2),
    "20 at random, held together by one link": (at_random(20, 0.35, 3), 2.5),
}
"""Graph, and the target for the mean age in s."""
WORST_S = 8
"""Target for the worst pair of the last one, s."""
MAP_BYTES, MAP_HOPS = 100_000, 3
MAP_LOSS, MOST_S = 0.1, 900.0
"""Loss at every hop, and s after which the map counts as lost."""


def relaying(graph: Graph, *, relay: bool = True) -> list[Measured]:
    return measured(repeat(graph), [SwarmConfig(seed=seed, loss=0.1, relay=relay) for seed in MANY_SEEDS])


def share(swarms: list[Measured]) -> float:
    """Share of the packets that carry another robot's message, in %."""
    return 100 * mean(one.relayed for one in swarms)


def relay() -> list[Row]:
    """Mean age over all pairs, the worst pair, and how much is relayed."""
    rows = []
    for name, (graph, most) in TOPOLOGIES.items():
        ran = relaying(graph)
        collided, worst = 100 * mean(one.collided for one in ran), mean(one.worst for one in ran)
        note = f"worst pair {worst:.2f} s, {share(ran):.0f} % relayed, {collided:.1f} % collide"
        rows.append(Row(f"{name}: mean age", mean(one.age for one in ran), "s", "≤", most, "{:.2f}", note))
    rows.append(Row(f"{name}: worst pair", worst, "s", "≤", WORST_S, "{:.1f}"))
    without, cell = (relaying(fully_meshed(20), relay=relay) for relay in (False, True))
    before = mean(one.age for one in without)
    note = f"{before:.3f} s without relaying; 1 % more is noise"
    rows.append(Row("one cell of 20: mean age", mean(one.age for one in cell), "s", "≤", 1.01 * before, "{:.3f}", note))
    rows.append(Row("one cell of 20: relayed", share(cell), "%", "≤", 2, "{:.1f}"))
    return rows


def carried() -> list[Row]:
    """How long a map for one robot takes over hops, with a goal every 5 s beside it, and whether both are whole."""
    last = 1 + MAP_HOPS
    topics = registry(odom=SendOptions(queue="latest"), goal=SendOptions(to=last), map=SendOptions(to=last))
    line = Line(
        robot(1, topics=topics, packet_len=220),
        *(robot(src_id, packet_len=220) for src_id in range(2, last + 1)),
        loss=MAP_LOSS,
    )
    line.run(12)
    begin, first = line.now, line.robots[0]
    goals: list[bytes] = []
    whole = random.Random(1).randbytes(MAP_BYTES)
    first.end.messages.submit(2, whole, line.now)
    while whole not in line.robots[-1].delivered(1) and line.now < begin + MOST_S:
        goals.append(b"goal %d" % len(goals))
        first.end.messages.submit(1, goals[-1], line.now)
        line.run(5)
    took = line.now - begin
    line.run(30)
    came = line.robots[-1].delivered(1)
    got = [payload for payload in came if payload in goals]
    in_order = sum(one == other for one, other in zip(goals, got, strict=False))
    what = f"map of {MAP_BYTES // 1000} kB over {MAP_HOPS} hops, {MAP_LOSS:.0%} lost at each"
    return [
        Row(f"{what}: whole", came.count(whole), "", "=", 1),
        Row(f"{what}: after", took, "s", form="{:.0f}"),
        Row(f"{what}: goals beside it, in order", in_order, "", "=", len(goals)),
    ]
