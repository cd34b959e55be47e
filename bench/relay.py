"""Relaying by gain at packet level: the mean age over all pairs of robots, which partly hear each other over hops only.

As ``bench.mac``: 75 packets/s, 10 Hz of one-packet messages per robot, 10 ms from hearing to sending, guard 1 ms, in
slots; 10 % of the packets are lost beside those that collide.
"""

from __future__ import annotations

from statistics import mean

from bench.mac import SEEDS, Graph, at_random, joined, line, swarm, within
from bench.rows import Row
from gr_ros2.run.swarm import Swarm, SwarmConfig, fully_meshed

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


def relaying(graph: Graph, *, relay: bool = True) -> list[Swarm]:
    return [swarm(graph, SwarmConfig(seed=seed, loss=0.1, relay=relay)) for seed in SEEDS]


def share(swarms: list[Swarm]) -> float:
    """Share of the packets that carry another robot's message, in %."""
    return 100 * mean(one.relayed for one in swarms)


def relay() -> list[Row]:
    """Mean age over all pairs, the worst pair, and how much is relayed."""
    rows = []
    for name, (graph, most) in TOPOLOGIES.items():
        ran = relaying(graph)
        collided, worst = 100 * mean(one.collided for one in ran), mean(one.ages[-1] for one in ran)
        note = f"worst pair {worst:.2f} s, {share(ran):.0f} % relayed, {collided:.1f} % collide"
        rows.append(Row(f"{name}: mean age", mean(one.age for one in ran), "s", "≤", most, "{:.2f}", note))
    rows.append(Row(f"{name}: worst pair", worst, "s", "≤", WORST_S, "{:.1f}"))
    without, cell = (relaying(fully_meshed(20), relay=relay) for relay in (False, True))
    before = mean(one.age for one in without)
    note = f"{before:.3f} s without relaying; 1 % more is noise"
    rows.append(Row("one cell of 20: mean age", mean(one.age for one in cell), "s", "≤", 1.01 * before, "{:.3f}", note))
    rows.append(Row("one cell of 20: relayed", share(cell), "%", "≤", 2, "{:.1f}"))
    return rows
