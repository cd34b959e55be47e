"""Many robots on one channel at packet level: each sends a message of one packet whenever it may.

The robots have the engines of ``gr_ros2.mac`` and clocks of their own; nothing else of a robot is simulated. The medium
is :class:`gr_ros2_lab.medium.packets.PacketMedium` with a PHY that loses nothing unless packets overlap, and the event
loop is that of ``run.simulate``. A host takes ``latency_s`` from the end of a packet to what it does about it.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.swarm_traffic import ByGain, OwnOnly, SwarmTraffic
from gr_ros2.link.access import Access
from gr_ros2.mac import read_block
from gr_ros2.phy import PHY, Phy
from gr_ros2.settings.config import ChannelConfig
from gr_ros2.wire.mac_block import Block
from gr_ros2_lab.medium.base import Hearers, Medium, RadioPath, Reception, Surroundings, Transmission
from gr_ros2_lab.medium.packets import PacketMedium
from gr_ros2_lab.record.team_numbers import jain
from gr_ros2_lab.run.simulate import EventLoop


@dataclass
class SwarmConfig:
    """How a swarm is simulated.

    :param airtime_s: of every packet, s
    :param latency_s: s from the end of a packet to what its receiver does about it
    :param lead_s: s before it begins at which a packet is composed, as :class:`gr_ros2.mac.Slots` has to know
    :param period_s: s from one message of a robot to the next
    :param loss: share of packets that are lost for other reasons than collisions
    :param relay: robots send on each other's messages by gain
    :param jitter_s: a burst begins up to so many s late
    :param ppm: clocks differ by up to so many parts per million
    :param present: from when to when in s a robot is there, by its number
    :param jumps: (s, robot, s): at that time the robot's clock jumps by so much
    :param frozen: (s, robot, s): from then on the robot's host does nothing for so long
    """

    airtime_s: float = 1 / 75
    latency_s: float = 0.010
    lead_s: float = 0.0
    period_s: float = 0.1
    loss: float = 0.0
    relay: bool = False
    jitter_s: float = 0.0
    ppm: float = 0.0
    seed: int = 1
    present: dict[int, tuple[float, float]] = field(default_factory=dict)
    jumps: Sequence[tuple[float, int, float]] = ()
    frozen: Sequence[tuple[float, int, float]] = ()


def fully_meshed(robots: int) -> list[set[int]]:
    """All robots hear each other."""
    return [set(range(robots)) - {one} for one in range(robots)]


class HearingGraph(Surroundings):
    """Robots of which each hears others as well as any, or not at all.

    :param hears: for every robot those that hear it, as a function of time: the same object as long as nothing changes
    """

    moves, passes = "who hears whom", False

    def __init__(self, hears: Callable[[float], Sequence[set[int]]] | Sequence[set[int]], config: SwarmConfig) -> None:
        self._hears = hears if callable(hears) else lambda _: hears
        self._config = config
        self._now: Sequence[set[int]] = ()
        self._hearers: list[Hearers] = []
        self._near = np.zeros((0, 0), bool)
        self._paths: dict[tuple[int, int], RadioPath] = {}
        self._look(0.0)
        self.robots = len(self._now)

    def _look(self, now: float) -> None:
        hears = self._hears(now)
        if hears is self._now:
            return
        self._now, robots = hears, len(hears)
        matrix = np.zeros((robots, robots), np.float32)
        self._hearers = []
        for sender, others in enumerate(hears):
            ids = np.array(sorted(others), int)
            matrix[sender, ids] = 1
            self._hearers.append(Hearers(ids, np.full(len(ids), math.inf), np.zeros(len(ids)), robots))
        self._near = (matrix @ matrix.T + matrix + matrix.T) > 0

    def hearers(self, sender: int, now: float) -> Hearers:
        self._look(now)
        return self._hearers[sender]

    def path(self, sender: int, receiver: int) -> RadioPath:
        path = self._paths.get((sender, receiver))
        if path is None:
            seed = self._config.seed * 65536 + sender * 256 + receiver
            channel = ChannelConfig(packet_loss=self._config.loss, seed=seed)
            path = self._paths[sender, receiver] = RadioPath(receiver, channel, self._config.latency_s)
        return path

    def reached(self, sender: int) -> list[int]:
        return sorted(self._now[sender])

    def near(self, sender: int, now: float) -> NDArray[np.bool_]:
        self._look(now)
        return np.asarray(self._near[sender])


Received = Callable[[Reception, int, float], None]
"""Is told of a packet, who made the message in it, and when, s."""


@lru_cache(maxsize=64)
def _read(packet: bytes) -> tuple[Block | None, bytes]:
    """The block and the content of a packet, read once for all robots that hear it."""
    end = 1 + packet[0]
    return (read_block(packet[1:end])[0] if packet[0] else None), packet[end:]


class SwarmRobot:
    """One robot of a swarm, as the event loop sees it."""

    def __init__(self, number: int, access: Access, config: SwarmConfig, until: float, on: Received) -> None:
        rng = random.Random(f"robot {config.seed} {number}")
        self.number = self.src_id = number
        self.access, self.endpoint = access, self
        self.over = False
        self.left: list[tuple[float, bool]] = []
        """When each of its packets left, and whether it carried another robot's message."""
        self.traffic: SwarmTraffic = ByGain(number) if config.relay else OwnOnly()
        self._config, self._until, self._on = config, until, on
        self._rng = rng
        self._ppm = 1 + (config.ppm * 1e-6 if number == 0 else rng.uniform(-1, 1) * config.ppm * 1e-6)
        self._offset = rng.uniform(0, 1000)
        self._phase = rng.uniform(0, config.period_s)
        self._jumps = sorted((at, by) for at, robot, by in config.jumps if robot == number)
        self._frozen = [(at, at + by) for at, robot, by in config.frozen if robot == number]
        self._late: list[Reception] = []
        begin, self._end = config.present.get(number, (rng.uniform(0, 0.3), math.inf))
        self.begin = self.due = begin

    def _local(self, at: float) -> float:
        while self._jumps and self._jumps[0][0] <= at:
            self._offset += self._jumps.pop(0)[1]
        return at * self._ppm + self._offset

    def _asleep(self, now: float) -> float | None:
        return next((end for begin, end in self._frozen if begin <= now < end), None)

    def newest(self, at: float) -> tuple[int, float]:
        """The number of the newest message at a time, and when it was made, s."""
        number = math.floor((at - self._phase) / self._config.period_s)
        return number + 1, self._phase + number * self._config.period_s

    def _plan(self, now: float, local: float) -> None:
        due = max(now, (self.access.departure(local) - self._offset) / self._ppm - self._config.lead_s)
        if self._jumps:
            due = min(due, max(now, self._jumps[0][0]))
        self.due = due
        if due > self._until or due > self._end:
            self.over, self.due = True, math.inf

    def step(self, now: float, medium: Medium) -> Iterable[Any]:
        """Send what may leave."""
        end = self._asleep(now) if self._frozen else None
        if end is not None:
            self.due = end
            return ()
        late, self._late = self._late, []
        for reception in late:
            self._hear(reception)
        begin = (self.access.departure(self._local(now)) - self._offset) / self._ppm
        if begin <= now + self._config.lead_s + 1e-9:
            block = self.access.block(self.traffic.weight)
            if block is not None:
                start = max(now, begin) + self._rng.uniform(0, self._config.jitter_s)
                number, made = self.newest(now)
                content = self.traffic.compose(number, made, self._local(now))
                packet = bytes((len(block),)) + block + content
                medium.send(self.number, packet, start, self._config.airtime_s)
                self.left.append((now, self.traffic.relays))
        self._plan(now, self._local(now))
        return ()

    def receive(self, reception: Reception) -> Iterable[Any]:
        """Take a packet."""
        at = reception.at
        if self.begin <= at < self._end:
            if self._frozen and self._asleep(at) is not None:
                self._late.append(reception)
                return ()
            local, origin, made = self._hear(reception)
            self._on(reception, origin, made)
            if not self.over:
                self._plan(at, local)
        return ()

    def _hear(self, reception: Reception) -> tuple[float, int, float]:
        """The time on this robot's clock, who made the message, and when."""
        sent = reception.sent
        sender = sent.sender
        block, content = _read(reception.packet.data)
        self.access.hear(sender, block, sent.start * self._ppm + self._offset)
        local = self._local(reception.at)
        origin, made = self.traffic.take(sender, block, content, local)
        return local, origin, made

    def expire(self, now: float) -> Iterable[Any]:  # noqa: ARG002
        return ()

    def finish(self, now: float) -> Iterable[Any]:  # noqa: ARG002
        return ()

    def wake(self, now: float) -> None:
        """Nothing waits for what is received."""

    def next_timeout(self) -> None:
        return None


class _CountedMedium(PacketMedium):
    """Losses are counted from ``t0`` on."""

    def __init__(self, around: Surroundings, phys: Sequence[Phy], t0: float) -> None:
        super().__init__(around, phys, shared=True, ideal=True)
        self._t0 = t0

    def outcome(self, sent: Transmission) -> list[Reception]:
        if sent.start >= self._t0 > 0:
            self._t0 = 0.0
            self.lost.clear()
        return super().outcome(sent)


class _Age:
    """How old the newest message of one robot is at another one.

    :ivar made: s, when it was made; nothing counts as older than the run
    :ivar since: s, until when ``area``, the sum of the ages over time in s², counts
    """

    __slots__ = ("area", "made", "since")

    def __init__(self, t0: float) -> None:
        self.made, self.since, self.area = -1.0, t0, 0.0

    def settle(self, at: float) -> None:
        """Count until ``at`` s."""
        if at > self.since:
            self.area += (at - self.since) * ((self.since + at) / 2 - max(self.made, 0.0))
            self.since = at


class Swarm:
    """Robots, the medium between them, and what is measured from ``t0`` on.

    :param make: the engine of a robot, from its number and its generator
    """

    def __init__(
        self,
        make: Callable[[int, random.Random], Access],
        around: Surroundings,
        config: SwarmConfig | None = None,
        *,
        t0: float = 20.0,
        t1: float = 80.0,
    ) -> None:
        self.config = config = config or SwarmConfig()
        count = around.robots
        self.t0, self.t1, self.count = t0, t1, count
        phy = PHY.load("direct")(64)
        self.medium = _CountedMedium(around, [phy] * count, t0)
        self.robots = [
            SwarmRobot(n, make(n, random.Random(f"access {config.seed} {n}")), config, t1, self._received)
            for n in range(count)
        ]
        reached = fully_meshed(count) if config.relay else [around.reached(one) for one in range(count)]
        self.pairs = {(one, other) for one in range(count) for other in reached[one]}
        self.heard_at: dict[int, list[float]] = {n: [] for n in range(count)}
        self.first_heard: dict[int, float] = {}
        self.received = 0
        self.got = [[0] * count for _ in range(count)]
        self._ages: dict[tuple[int, int], _Age] = {}

    def run(self) -> Swarm:
        for robot in self.robots:
            robot.due = robot.begin
        loop = EventLoop(self.robots, self.medium)  # type: ignore[arg-type]
        for _ in loop.run():
            pass
        for pair in self.pairs:
            self._age_of(pair).settle(self.t1)
        return self

    def _received(self, reception: Reception, origin: int, made: float) -> None:
        sender, receiver, at = reception.sent.sender, reception.receiver, reception.at
        self.first_heard.setdefault(sender, at)
        self.heard_at[sender].append(at)
        if at >= self.t0:
            self.received += 1
        if origin == receiver:
            return
        age = self._age_of((origin, receiver))
        if made <= age.made:
            return
        age.settle(min(at, self.t1))
        age.made = made
        if self.t0 <= at <= self.t1:
            self.got[origin][receiver] += 1

    def _age_of(self, pair: tuple[int, int]) -> _Age:
        return self._ages.get(pair) or self._ages.setdefault(pair, _Age(self.t0))

    def lost(self, *reasons: str) -> int:
        """Packets that one robot did not receive from another, after ``t0``, for these reasons."""
        return sum(map(self.medium.lost.total, reasons))

    @property
    def sent(self) -> int:
        """Packets that left, from the start on."""
        return sum(len(robot.left) for robot in self.robots)

    @property
    def relayed(self) -> float:
        """Share of the packets after ``t0`` that carried a message of another robot."""
        relays = [relays for robot in self.robots for at, relays in robot.left if at >= self.t0]
        return sum(relays) / max(1, len(relays))

    @property
    def collided(self) -> float:
        """Share of packets for a robot in range that another one destroyed, or that came while it sent."""
        collided = self.lost("collision", "sending")
        return collided / max(1, collided + self.received + self.lost("packet_loss"))

    @property
    def rate(self) -> float:
        """New messages per second that a robot receives, from all others together."""
        return sum(map(sum, self.got)) / (self.t1 - self.t0) / max(1, self.count - 1)

    @property
    def ages(self) -> list[float]:
        """Mean age of every pair in range, s, in order."""
        return sorted(age.area / (self.t1 - self.t0) for age in self._ages.values() if age.since > self.t0)

    @property
    def age(self) -> float:
        return sum(self.ages) / max(1, len(self.ages))

    @property
    def jain(self) -> float:
        """Jain's index of the messages that the others have received of each robot."""
        return jain([sum(got) for got in self.got]) or 0.0
