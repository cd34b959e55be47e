"""Reliable messages beside fresh ones: 20 robots in one cell at 10 % packet loss, in slots.

Each has odometry at 10 Hz, of which only the newest message counts, and 2 kB every 10 s that have to arrive everywhere.
75 packets/s of 512 bytes: a robot's turn comes every 0.33 s, so that 2 kB need 1.5 s without any loss.
"""

from __future__ import annotations

import random
import struct
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import floor, inf
from pathlib import Path
from statistics import mean
from typing import cast

from bench.rows import Row
from gr_ros2.link import Accepted, Delivered, SentPacket
from gr_ros2.wire.control import Report, write_control
from gr_ros2.wire.v1 import PacketV1
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.run.simulate import Offered, Simulation
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings

ROBOTS, LOSS, PACKETS_S, PACKET_LEN = 20, 0.1, 75, 512
PERIOD_S, SIZE = 10.0, 2000
ODOM, RELIABLE = 0, 1
T0, T1, END = 20.0, 60.0, 80.0
"""s: ages count from the first to the second; messages are offered until the second, and may come until the third."""


def big(rng: random.Random) -> bytes:
    """A std_msgs/UInt8MultiArray that no codec makes smaller."""
    return struct.pack("<4sIII", b"\0\1\0\0", 0, 0, SIZE) + rng.randbytes(SIZE)


@dataclass
class Exchange:
    """What came of it.

    :ivar delays: s that each reliable message took to each other robot; infinite for one that did not arrive
    :ivar age: mean age of odometry over all pairs, s
    :ivar reports: share of the air that reports took: their bytes in packets of messages, and packets of reports
    """

    delays: list[float] = field(default_factory=list)
    age: float = 0.0
    reports: float = 0.0
    kinds: Counter[str] = field(default_factory=Counter)


def talk(
    *, reliable: bool, seed: int = 1, robots: int = ROBOTS, loss: float = LOSS, packet_len: int = PACKET_LEN
) -> Exchange:
    """One run."""
    with tempfile.TemporaryDirectory() as folder:
        registry = Path(folder, "two.csv")
        registry.write_text("odom,nav_msgs/Odometry\nmap_part,std_msgs/UInt8MultiArray\n", encoding="utf-8")
        options = {"odom": {"depth": 1, "reliability": "best_effort"}, "map_part": {"reliability": "reliable"}}
        common = {
            "registry": str(registry),
            "robots": robots,
            "packet_len": packet_len,
            "duration_s": END,
            "seed": seed,
            "channel": {"packet_loss": loss},
            "repair": "auto",
            "topics": {"auto": None, **options},
            "max_sources": max(robots, 1),
        }
        scenario = load_scenario("twenty-robots", [], **common)
        rows = scenario.load_registry()
        phy = make_phy(scenario, rows)
        rate = float(scenario.phy.sample_rate) * phy.airtime() * PACKETS_S
        scenario = load_scenario("twenty-robots", [f"phy.sample_rate={rate}"], **common)
        phy = make_phy(scenario, rows)
        messages = [_offered(number, robots, seed, reliable=reliable) for number in range(robots)]
        run = Simulation(scenario, rows, phy, messages=messages, ideal=True)
        return _watched(run, packet_len)


def _offered(number: int, robots: int, seed: int, *, reliable: bool) -> Iterator[Offered]:
    rng = random.Random(f"{seed} {number}")
    drive = Fleet.of(SimSettings(robots=2, odom_rate=10, seed=seed))
    name = f"/robot_{1 + number % 2}/odom"
    next_s = PERIOD_S * (number + rng.random()) / robots + PERIOD_S / 2
    shift = rng.uniform(0, 0.1)
    for message in drive.messages(T1, topics=[name]):
        t = message.t + shift
        while reliable and next_s <= t < T1:
            yield Offered(next_s, RELIABLE, big(rng))
            next_s += PERIOD_S
        yield Offered(t, ODOM, message.payload)


def _watched(run: Simulation, packet_len: int) -> Exchange:
    made: dict[tuple[int, int], float] = {}
    named: dict[tuple[int, int, object], int] = {}
    waiting: dict[tuple[int, int], set[int]] = {}
    heard: dict[tuple[int, int], tuple[float, float, float]] = {}
    """Sender and receiver -> since when, what the newest message was made at, and the area under the age so far."""
    found = Exchange()
    spent = 0.0
    for now, robot, event in run.events():
        own = robot.src_id
        if isinstance(event, Accepted):
            made[own, event.serial] = event.now
            if event.topic_id == RELIABLE:
                waiting[own, event.serial] = {other.src_id for other in run.robots} - {own}
        elif isinstance(event, SentPacket):
            for entry in event.entries:
                named[own, entry.topic_id, entry.key] = entry.serial
            if T0 <= now < T1:
                found.kinds[event.kind] += 1
                reports = [one for one in cast("PacketV1", event.packet).body if isinstance(one, Report)]
                said = sum(len(write_control(one)) for one in reports)
                found.kinds["reports"] += len(reports)
                spent += 1.0 if said and event.kind == "report" else said / packet_len
        elif isinstance(event, Delivered):
            serial = named[event.src_id, event.topic_id, event.key]
            at = made[event.src_id, serial]
            if event.topic_id == RELIABLE:
                waiting[event.src_id, serial].discard(own)
                found.delays.append(now - at)
            elif now < T1:
                since, newest, area = heard.get((event.src_id, own), (T0, 0.0, 0.0))
                if now > since:
                    area += (now - since) * ((since + now) / 2 - newest)
                    since = now
                heard[event.src_id, own] = since, max(newest, at), area
    found.delays += [inf for missing in waiting.values() for _ in missing]
    found.delays.sort()
    ages = [area + (T1 - since) * ((since + T1) / 2 - newest) for since, newest, area in heard.values()]
    found.age = sum(ages) / (T1 - T0) / max(len(ages), 1)
    total = sum(found.kinds[kind] for kind in ("new", "repair", "report", "hello"))
    found.reports = spent / max(total, 1)
    return found


def at(share: float, values: list[float]) -> float:
    """A quantile of sorted values."""
    return values[min(floor(share * len(values)), len(values) - 1)]


def reliable() -> list[Row]:
    """Both kinds of messages, and the fresh ones alone."""
    both, alone = ([talk(reliable=with_them, seed=seed) for seed in (1, 2)] for with_them in (True, False))
    delays = sorted(delay for one in both for delay in one.delays)
    arrived = sum(delay < inf for delay in delays) / len(delays)
    ages = mean(one.age for one in both), mean(one.age for one in alone)
    what = f"{ROBOTS} robots, {LOSS:.0%} lost"
    note = f"{ages[0]:.3f} s and {ages[1]:.3f} s"
    return [
        Row(f"{what}: reliable messages that arrive", arrived, "", "≥", 0.999, "{:.4f}", f"{len(delays):,} in all"),
        Row(f"{what}: they take, p99", at(0.99, delays), "s", "≤", 5, "{:.2f}", f"median {at(0.5, delays):.2f} s"),
        Row(
            f"{what}: age of odometry over that without them",
            ages[0] / ages[1],
            "",
            "≤",
            1.25,
            "{:.2f}",
            note,
        ),
        Row(f"{what}: reports of the air", 100 * max(one.reports for one in both), "%", "≤", 5, "{:.1f}"),
    ]
