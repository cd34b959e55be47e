"""Links by sound in real time: messages that arrive, how old they are, and the processor time.

Each robot is `gr-ros2 link` in a process and on a ROS domain of its own, over DDS. Its card is a null sink of a sound
server that is started here, whose monitor is the microphone: one in each direction, as a cable, or one for all robots.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import permutations
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory

from bench.rows import Row
from gr_ros2.middleware import Publisher, Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings
from tests.radio.sound_server import PipeWire, PulseAudio, SoundServer

DOMAINS = (94, 95, 96)
CABLE_S, SHARED_S = 600.0, 240.0
"""s for which messages are published."""
CABLE_HZ, SHARED_HZ = 3.0, 0.1
"""Odometry of each robot, messages/s: with one sink for all, less than the slots carry."""
_SETTLE_S, _DRAIN_S, _FIRST_S = 120.0, 60.0, 90.0
_ODOMETRY = "nav_msgs/msg/Odometry"
_QOS = Qos("reliable", "volatile", 10)


def sound_live() -> list[Row]:
    """A sink in each direction, and one for two and for three robots, on each server."""
    return [row for kind in (PulseAudio, PipeWire) for row in (*_cable(kind), *_shared(kind, 2), *_shared(kind, 3))]


def _cable(kind: type[SoundServer]) -> Iterator[Row]:
    run = _run(kind, [("a", "b"), ("b", "a")], "cable", CABLE_HZ, CABLE_S)
    what = f"{kind.__name__}, a sink each way, odometry {CABLE_HZ:g}/s"
    yield Row(f"{what}: PDR", run.pdr, "", "≥", 0.99, "{:.3f}", run.said)
    yield Row(f"{what}: mean age", run.age_s, "s", "≤", 0.6, "{:.2f}")
    yield Row(f"{what}: of a core", run.cores, "", "≤", 0.2, "{:.2f}")


def _shared(kind: type[SoundServer], robots: int) -> Iterator[Row]:
    run = _run(kind, [("a", "a")] * robots, "sound", SHARED_HZ, SHARED_S)
    what = f"{kind.__name__}, one sink for {robots} robots"
    yield Row(f"{what}: PDR", run.pdr, "", "≥", 0.98, "{:.3f}", run.said)
    yield Row(f"{what}: first message", run.first_s, "s", "≤", 15, "{:.0f}")
    yield Row(f"{what}: of a core", run.cores, "", "≤", 0.2, "{:.2f}")


Sinks = Sequence[tuple[str, str]]
"""For each robot the sink it plays to and the one it hears."""


@dataclass
class _Run:
    """What came of a run: when each message was published, and when it arrived at which robot."""

    robots: int
    sent: dict[tuple[int, bytes], float] = field(default_factory=dict)
    came: dict[tuple[int, int, bytes], float] = field(default_factory=dict)
    first_s: float = float("inf")
    cores: float = 0.0

    @property
    def pdr(self) -> float:
        return len(self.came) / (len(self.sent) * (self.robots - 1))

    @property
    def age_s(self) -> float:
        ages = [at - self.sent[source, data] for (source, _, data), at in self.came.items()]
        return mean(ages) if ages else float("inf")

    @property
    def said(self) -> str:
        return f"{len(self.came)} of {len(self.sent) * (self.robots - 1)}; {self.age_s:.2f} s old"


def _run(
    kind: type[SoundServer], sinks: Sequence[tuple[str, str]], preset: str, rate_hz: float, seconds: float
) -> _Run:
    count = len(sinks)
    run = _Run(count)
    numbers = range(1, count + 1)
    fleet = Fleet(SimSettings(robots=count, odom_rate=10.0))
    messages: dict[int, list[bytes]] = {number: [] for number in numbers}
    for sent in fleet.messages(seconds, topics={f"/robot_{number}/odom" for number in numbers}):
        messages[int(sent.topic.split("/")[1].rsplit("_", 1)[1])].append(sent.payload)
    with TemporaryDirectory() as folder, ExitStack() as stack:
        server = kind(Path(folder))
        stack.callback(server.stop)
        graphs = {number: DdsMiddleware(domain_id=DOMAINS[number - 1]) for number in numbers}
        for graph in graphs.values():
            stack.callback(graph.close)
        for source, taker in permutations(numbers, 2):

            def keep(data: bytes, source: int = source, taker: int = taker) -> None:
                if (source, bytes(data)) in run.sent:
                    run.came.setdefault((source, taker, bytes(data)), time.monotonic())

            graphs[taker].subscribe(f"/rx_robot_{source}/odom", _ODOMETRY, _QOS, keep)
        publishers = {n: graph.advertise(f"/robot_{n}/odom", _ODOMETRY, _QOS) for n, graph in graphs.items()}
        with _links(server, Path(folder), sinks, preset, run):
            begin = time.monotonic()
            # A link that still starts takes nothing: what is published before does not count.
            place = 0
            while time.monotonic() < begin + _FIRST_S and len(run.came) < count * (count - 1):
                _say(run, publishers, messages, place)
                time.sleep(1.0)
                place += 1
            run.first_s = min(run.came.values(), default=float("inf")) - begin
            # Meanwhile more was said than slots carry, and what comes next would wait behind it.
            last, until = list(run.sent)[-count:], time.monotonic() + _SETTLE_S
            while time.monotonic() < until and not all(
                (source, taker, data) in run.came for source, data in last for taker in numbers if taker != source
            ):
                time.sleep(0.1)
            run.sent.clear()
            run.came.clear()
            begin = time.monotonic()
            for number in range(int(seconds * rate_hz)):
                time.sleep(max(0.0, begin + number / rate_hz - time.monotonic()))
                _say(run, publishers, messages, place + number)
            until = time.monotonic() + _DRAIN_S
            while run.pdr < 1 and time.monotonic() < until:
                time.sleep(0.1)
    return run


def _say(run: _Run, publishers: Mapping[int, Publisher], messages: dict[int, list[bytes]], place: int) -> None:
    for number, publisher in publishers.items():
        data = messages[number][place % len(messages[number])]
        run.sent[number, data] = time.monotonic()
        publisher.publish(data)


@contextmanager
def _links(server: SoundServer, folder: Path, sinks: Sinks, preset: str, run: _Run) -> Iterator[None]:
    """The robots' links, and their processor time into ``run``."""
    processes, begin = [], time.monotonic()
    for number, (plays, hears) in enumerate(sinks, 1):
        card = {"PULSE_SINK": plays, "PULSE_SOURCE": f"{hears}.monitor", "ROS_DOMAIN_ID": str(DOMAINS[number - 1])}
        command = [sys.executable, "-m", "gr_ros2.cli", "link", "--robot", str(number), "--radio", preset]
        command += ["--device", "pulse", "--set", f"state={folder}/state-{number}", "--topics", "odom"]
        out = (folder / f"link-{number}.txt").open("wb")
        processes.append(subprocess.Popen(command, env={**os.environ, **server.env, **card}, stdout=out, stderr=out))
    try:
        yield
    finally:
        took = time.monotonic() - begin
        used = []
        runs = [process for process in processes if process.poll() is None]
        for process in runs:
            process.terminate()
            _, _, usage = os.wait4(process.pid, 0)
            process.returncode = 0
            used.append(usage.ru_utime + usage.ru_stime)
        run.cores = max(used, default=0.0) / took
        said = [(folder / f"link-{number}.txt").read_text()[-2000:] for number in range(1, len(sinks) + 1)]
        if len(runs) < len(processes):
            raise RuntimeError("\n".join(["a link ended by itself:", *said]))
        if not run.came:
            print(*said, sep="\n")
