"""The paper's link, plain and as wanted: on the same radio, with the simulator and with a recorded drive.

Everything runs in real time over DDS and the flowgraph. What has to hold for the whole experiment of the paper runs its
38 s; plain version 0 runs for as long as its PDR needs to show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.rows import Row
from bench.runs import DOMAINS, DRIVE
from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.run.outcome import Outcome
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import Scenario, load_scenario
from gr_ros2_lab.study.ablation import air_bytes
from gr_ros2_lab.study.forecast import Planner

WHOLE_S, PART_S, PLAIN_S = 38.0, 15.0, 8.0
PACED = ["paper={}", "robots=[{direction: send}, {direction: receive}]", "topics=auto"]
"""What turns a scenario into plain version 0."""
PLAIN = [*PACED, "packet_rate=0", "queue_depth=0", "drain_s=0"]
"""The same, unpaced."""
WANTED: list[str] = []
SAME = 1.1
"""Ratio of the p50 of two equal runs that differ by chance."""
RECORDED_SPEED = 3.5
"""At which the recorded odometry, 10 Hz, has the paper's 35 Hz."""


def links() -> list[Row]:
    """The four links, and what a message costs on the air."""
    with TemporaryDirectory() as folder:
        registry = DRIVE.write_registry(Path(folder) / "drive.csv")
        drive = [f"source=bag:{DRIVE.path}", f"bag_speed={RECORDED_SPEED}"]
        inputs: dict[str, list[str]] = {"simulator": [], "recording": drive}
        rows = [*_paper(inputs), *_narrow(inputs), *_six_topics()]
        rows += _recorded_topics([*drive, f"registry={registry}"])
        return [*rows, *_carries_everything(), *_fitting()]


def _paper(inputs: dict[str, list[str]]) -> Iterator[Row]:
    yield from _plain("paper-ofdm", "OFDM 100 kS/s, 64 B")
    for source, settings in inputs.items():
        scenario = _scenario("paper-ofdm-paced", WHOLE_S if source == "simulator" else PART_S, settings)
        outcome = run_scenario(scenario)
        (topic,) = outcome.result.topics
        what = f"OFDM 100 kS/s, 64 B, {source}"
        yield Row(f"{what}: PDR", topic.pdr or 0.0, "", "≥", 0.99, "{:.3f}", _latency(topic))
        yield _beside(f"{what}: latency p99", scenario, topic, lambda one: one.latency_s.p99, 4.0)
        yield Row(f"{what}: goodput", topic.goodput_Bps or 0.0, "B/s", "≥", 25_000)
        yield Row(f"{what}: on the air per message", air_bytes(outcome.result) or inf, "B", "≤", 140)
        yield Row(f"{what}: altered messages", topic.corrupt, "", "=", 0)


def _narrow(inputs: dict[str, list[str]]) -> Iterator[Row]:
    yield from _plain("narrow-ofdm-paced", "OFDM 32 kS/s, 64 B")
    for source, settings in inputs.items():
        scenario = _scenario("narrow-ofdm-paced", PART_S, settings)
        outcome = run_scenario(scenario)
        (topic,) = outcome.result.topics
        what = f"OFDM 32 kS/s, 64 B, {source}"
        rate = topic.delivered / outcome.result.duration_s
        silence = _silence(outcome, topic)
        note = f"{topic.sent / outcome.result.duration_s:.1f} offered, {silence * 1e3:.0f} ms at most between two"
        yield Row(f"{what}: messages/s", rate, "", "≥", 11, "{:.1f}", note)
        yield _beside(f"{what}: mean age", scenario, topic, lambda one: one.age_s.mean, 2.0)


def _six_topics() -> Iterator[Row]:
    yield from _plain("six-topics-paced", "six topics, 100 kS/s, 220 B")
    scenario = _scenario("six-topics-paced", WHOLE_S)
    outcome = run_scenario(scenario)
    topics = _by_name(outcome)
    cmd_vel, whole_map = topics["cmd_vel"], topics.pop("map")
    yield Row(
        "six topics: odom, messages/s", topics["odom"].delivered / WHOLE_S, "", "≥", 15, "{:.1f}", _rates(outcome)
    )
    yield _beside("six topics: cmd_vel latency p99", scenario, cmd_vel, lambda one: one.latency_s.p99, 1.4)
    yield Row("six topics: maps delivered", whole_map.delivered, "", "=", 1, note=_latency(whole_map))
    yield _longest_silence("six topics", outcome, topics)
    forecast = {topic.topic: topic.rate_hz for topic in Planner(scenario).forecast().topics}
    off = {name: abs(one.delivered / WHOLE_S / forecast[one.topic] - 1) for name, one in topics.items()}
    worst = max(off, key=lambda name: off[name])
    yield Row("six topics: forecast off by", 100 * off[worst], "%", "≤", 10, "{:.1f}", f"rate of {worst}, the worst")


def _recorded_topics(settings: Sequence[str]) -> Iterator[Row]:
    queues = "{odom: {queue: latest, weight: 4}, imu: {queue: latest}, fix: {queue: latest}}"
    outcome = _run("six-topics-paced", PART_S, [*settings, f"topics={queues}"])
    yield _longest_silence("recorded topics, 100 kS/s, 220 B", outcome, _by_name(outcome))


def _carries_everything() -> Iterator[Row]:
    """In turn, twice each; the better p50 counts, since a busy computer only adds to it."""
    runs: dict[str, list[dict[str, TopicResult]]] = {"plain": [], "wanted": []}
    lossless = ["channel.packet_loss=0"]
    for what, settings in [("plain", PACED), ("wanted", WANTED)] * 2:
        runs[what].append(_by_name(_run("demo", PLAIN_S, [*lossless, *settings])))
    for what, both in runs.items():
        topics = [topic for run in both for topic in run.values()]
        sent, delivered = (sum(getattr(topic, key) for topic in topics) for key in ("sent", "delivered"))
        note = f"{delivered} of {sent} messages of six topics"
        yield Row(f"OFDM that carries all, {what}: PDR", delivered / sent, "", "=", 1.0, "{:.4f}", note)
    plain, wanted = (
        {name: min(_ms(run[name].latency_s.p50) for run in both) for name in both[0]} for both in runs.values()
    )
    worst = max(plain, key=lambda name: wanted[name] / plain[name])
    note = ", ".join(f"{name} {wanted[name]:.1f} instead of {plain[name]:.1f}" for name in (worst, "odom", "scan"))
    ratio = wanted[worst] / plain[worst]
    yield Row("OFDM that carries all: p50 over plain", ratio, "", "≤", SAME, "{:.2f}", f"{note} ms")


def _fitting() -> Iterator[Row]:
    alone = ["repair='off'"]
    advice = Planner(_scenario("paper-ofdm-paced", PLAIN_S, alone)).advice()
    fitting = min(advice, key=lambda one: one.forecast.air_bytes_per_message or inf)
    outcome = _run("paper-ofdm-paced", PLAIN_S, [*alone, *fitting.setting.split()])
    pdr = outcome.result.topics[0].pdr or 0.0
    note = f"{fitting.setting}, as planned; PDR {pdr:.3f}"
    yield Row(
        "OFDM 100 kS/s, fitted: on the air per message", air_bytes(outcome.result) or inf, "B", "≤", 115, note=note
    )


def _plain(name: str, what: str) -> Iterator[Row]:
    """For comparison: what the same radio makes of plain version 0."""
    outcome = _run(name, PLAIN_S, PLAIN)
    sent, delivered = (sum(getattr(topic, key) for topic in outcome.result.topics) for key in ("sent", "delivered"))
    slowest = max(topic.latency_s.max or 0.0 for topic in outcome.result.topics)
    note = f"for comparison; latency up to {slowest:.1f} s after {PLAIN_S:g} s"
    yield Row(f"{what}, plain: PDR", delivered / sent, form="{:.2f}", note=note)


def _beside(
    what: str, scenario: Scenario, topic: TopicResult, of: Callable[[TopicResult], float | None], most: float
) -> Row:
    """A time of a run over that of the same run in simulated time, where no computer is late."""
    ideal = run_scenario(replace(scenario, time="packets")).result
    (beside,) = (of(one) for one in ideal.topics if one.topic == topic.topic)
    real = _ms(of(topic))
    ratio, note = real / _ms(beside), f"{real:.1f} ms; {_latency(topic)}"
    return Row(f"{what}, over that in simulated time", ratio, "", "≤", most, "{:.2f}", note)


def _longest_silence(what: str, outcome: Outcome, topics: dict[str, TopicResult]) -> Row:
    silence = {name: _silence(outcome, topic) for name, topic in topics.items()}
    name = max(silence, key=lambda one: silence[one])
    return Row(f"{what}: longest silence", silence[name], "s", "≤", 5, "{:.2f}", f"{name}; {_rates(outcome)}")


def _scenario(name: str, duration_s: float, settings: Sequence[str] = ()) -> Scenario:
    return load_scenario(name, [*DOMAINS, *settings], duration_s=duration_s)


def _run(name: str, duration_s: float, settings: Sequence[str] = ()) -> Outcome:
    return run_scenario(_scenario(name, duration_s, settings))


def _by_name(outcome: Outcome) -> dict[str, TopicResult]:
    return {topic.topic.rsplit("/", 1)[-1]: topic for topic in outcome.result.topics}


def _silence(outcome: Outcome, topic: TopicResult) -> float:
    """s between two deliveries of a topic at most, begin and end of submission included."""
    times = [np.sort(m.t_delivered[m.delivered]) for m in outcome.trace.messages() if m.topic == topic.topic]
    return float(np.diff(np.concatenate([[0.0], *times, [outcome.result.duration_s]])).max())


def _rates(outcome: Outcome) -> str:
    seconds = outcome.result.duration_s
    return ", ".join(f"{name} {topic.delivered / seconds:.1f}/s" for name, topic in _by_name(outcome).items())


def _latency(topic: TopicResult) -> str:
    return f"{topic.delivered} of {topic.sent}, p50 {_ms(topic.latency_s.p50):.1f} ms"


def _ms(seconds: float | None) -> float:
    return inf if seconds is None else seconds * 1e3
