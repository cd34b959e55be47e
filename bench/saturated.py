"""Links that are full: how old topics are, beside the ages that version 0 reached with the best scheduler it had, of
the same messages over the same losses.

Messages, packet length and packets per second are those of scenarios that a radio runs. They are compared in two ways:

- in slots of the airtime of a packet: what is sent in a slot arrives at its end or is lost;
- as scenarios in simulated time: a packet leaves as soon as the air is free. A repair that is on the air then delays
  the message that comes.

The messages are taken as they are on the air, coded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count
from typing import Any

from bench.repair import losses
from bench.rows import Row
from gr_ros2.core.tuning import Tuning
from gr_ros2.gr.factory import message_codec
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import Scenario, load_scenario
from gr_ros2_lab.run.simulate import Offered, offered, simulate

SCENARIOS = ("paper-ofdm-paced", "narrow-ofdm-paced", "six-topics-paced")
LOSSES = (0.0, 0.2)
SEEDS = (1, 2, 3, 4)
PACED_SEEDS = {0.0: SEEDS, 0.2: range(1, 13)}
TOLERANCE = {0.0: 1.03, 0.2: 1.05}
"""Ages this much apart are equal: hellos and the table of topics take 1 to 3 % of this air, and the first packets of a
run, in which the only map would leave with version 0; and at 20 % loss a topic of long messages is delivered a few
dozen times."""


VERSION_0 = {
    ("paper-ofdm-paced", 0.0, "slots"): {"odom": 0.03394},
    ("paper-ofdm-paced", 0.0, "paced"): {"odom": 0.0274},
    ("paper-ofdm-paced", 0.2, "slots"): {"odom": 0.04112},
    ("paper-ofdm-paced", 0.2, "paced"): {"odom": 0.0348},
    ("narrow-ofdm-paced", 0.0, "slots"): {"odom": 0.07581},
    ("narrow-ofdm-paced", 0.0, "paced"): {"odom": 0.08065},
    ("narrow-ofdm-paced", 0.2, "slots"): {"odom": 0.08536},
    ("narrow-ofdm-paced", 0.2, "paced"): {"odom": 0.09136},
    ("six-topics-paced", 0.0, "slots"): {
        "scan": 0.44269,
        "odom": 0.07794,
        "imu": 0.10715,
        "cmd_vel": 0.10116,
        "map": 18.99723,
        "clock": 0.10171,
    },
    ("six-topics-paced", 0.0, "paced"): {
        "scan": 0.4671,
        "odom": 0.08364,
        "imu": 0.1116,
        "cmd_vel": 0.10583,
        "map": 19.36888,
        "clock": 0.10725,
    },
    ("six-topics-paced", 0.2, "slots"): {
        "scan": 1.34593,
        "odom": 0.09134,
        "imu": 0.13398,
        "cmd_vel": 0.12488,
        "map": 18.99723,
        "clock": 0.12536,
    },
    ("six-topics-paced", 0.2, "paced"): {
        "scan": 1.51181,
        "odom": 0.09789,
        "imu": 0.14189,
        "cmd_vel": 0.13239,
        "map": 25.25864,
        "clock": 0.13315,
    },
}
"""Mean age in s of each topic with the scheduler that version 0 had for freshness until it went: by scenario, loss, and
in slots (``slots``, the mean of ``SEEDS``) or as packets leave when the air is free (``paced``, ``PACED_SEEDS``)."""


@dataclass
class Topic:
    """What became of one topic.

    :param age: s, mean over time of the newest delivered message's age, from the first submission on
    """

    name: str
    submitted: int
    delivered: int
    age: float


@dataclass(frozen=True)
class Load:
    """Messages as they are on the air, and the radio that carries them."""

    scenario: Scenario
    registry: Registry
    messages: tuple[Offered, ...]
    slot_s: float


@lru_cache
def load(name: str, seconds: float) -> Load:
    """A scenario's traffic and its radio."""
    scenario = load_scenario(name, duration_s=seconds)
    registry = scenario.load_registry().with_options(scenario.first.options)
    codec = message_codec(registry)
    messages = [replace(one, payload=codec.encode(one.topic_id, one.payload)) for one in offered(scenario, registry)]
    return Load(scenario, registry, tuple(messages), make_phy(scenario, registry).airtime())


def mean_age(submitted: Sequence[float], arrived: Sequence[tuple[float, int]], until: float) -> float:
    """Mean over time of the age of the newest message delivered; of the first submitted, before any is."""
    area, newest, since = 0.0, 0, submitted[0]
    for at, serial in [*arrived, (until, len(submitted) - 1)]:
        if serial >= newest or at == until:
            area += (at - since) * ((at + since) / 2 - submitted[newest])
            newest, since = serial, at
    return area / (until - submitted[0])


def run(
    name: str,
    loss: float,
    *,
    back: bool = False,
    seconds: float = 38.0,
    seed: int = 1,
    burst: float = 1.0,
    tuning: Tuning = Tuning(),
) -> tuple[list[Topic], Counter[str]]:
    """One scenario over a slotted channel: its topics, and the packets by what they were spent on.

    :param back: whether receivers report, over a reverse direction of the same loss
    """
    case = load(name, seconds)
    source, packet_len = case.scenario.first, case.scenario.packet_len
    times: dict[int, list[float]] = {topic.topic_id: [] for topic in case.registry}
    arrived: dict[int, list[tuple[float, int]]] = {topic.topic_id: [] for topic in case.registry}
    serials: dict[tuple[int, bytes], list[int]] = {}
    forward, backward = losses(seed * 1000, loss, burst), losses(seed * 1000 + 500, loss, burst)
    air: Counter[str] = Counter()
    common = {"packet_len": packet_len, "hears": back, "queue_depth": source.queue_depth, "tuning": tuning}
    sender = EndpointV1(case.registry, Settings(1, repair=AUTO, **common), boot=1000)  # type: ignore[arg-type]
    receiver = EndpointV1(None, Settings(2, **common), boot=2000)  # type: ignore[arg-type]
    receiver.pace.use_credit()
    sender.pace.use_credit()
    sender.pace.credit()
    messages = iter(case.messages)
    coming = next(messages, None)
    until = case.messages[-1].t
    for index in count():
        now = index * case.slot_s
        after = now + case.slot_s
        if now > until:
            break
        while coming is not None and coming.t <= now:
            line = times[coming.topic_id]
            serials.setdefault((coming.topic_id, coming.payload), []).append(len(line))
            line.append(coming.t)
            sender.messages.submit(coming.topic_id, coming.payload, coming.t)
            coming = next(messages, None)
        sent = sender.next_packet(now)
        if sent is not None:
            sender.pace.credit()
            air["sent"] += 1
        lost = next(forward)
        if sent is not None and not lost:
            for event in [*receiver.receive(AirPacket(sent.data), after), *receiver.handle_timeout(after)]:
                if isinstance(event, Delivered):
                    known = serials[event.topic_id, event.payload]
                    arrived[event.topic_id].append((after, known.pop(0) if len(known) > 1 else known[0]))
        if back:
            if receiver.pace.out_of_credit:
                receiver.pace.credit()
            answer = receiver.next_packet(now)
            if answer is not None and not next(backward):
                sender.receive(AirPacket(answer.data), after)
        sender.handle_timeout(now)
    air.update(sender.sent.air)
    topics = [
        Topic(topic.name, len(times[n]), len(arrived[n]), mean_age(times[n], arrived[n], until))
        for n, topic in enumerate(case.registry)
        if times[n]
    ]
    return topics, air


def ratios(name: str, loss: float, *, back: bool = False) -> dict[str, tuple[float, str]]:
    """Per topic, its mean age over the age with version 0, both means over seeds; and what became of it."""
    found: dict[str, list[Topic]] = {}
    for seed in SEEDS:
        for topic in run(name, loss, back=back, seed=seed)[0]:
            found.setdefault(topic.name, []).append(topic)
    ages = {topic: sum(one.age for one in runs) / len(runs) for topic, runs in found.items()}
    return {
        topic: (
            age / VERSION_0[name, loss, "slots"][topic],
            f"{sum(one.delivered for one in found[topic])} delivered, age {age * 1e3:,.0f} ms",
        )
        for topic, age in ages.items()
    }


def paced(
    name: str,
    loss: float,
    *,
    back: bool,
    seed: int,
    best_effort: Sequence[str],
    duration_s: float | None = None,
    odom_rate: float | None = None,
    tuning: Tuning = Tuning(),
) -> dict[str, float]:
    """Mean age in s of each topic of a scenario in simulated time; of one that delivers nothing, its duration.

    :param back: see :func:`run`
    :param best_effort: topics whose publishers are not reliable, so that no message waits for an earlier one
    :param duration_s: simulated s; None for those of the scenario
    :param odom_rate: messages/s of odometry; None for those of the scenario
    """
    options = [f"topics.{topic}.reliability=best_effort" for topic in best_effort]
    if odom_rate is not None:
        options.append(f"sim.odom_rate={odom_rate}")
    channel = {"packet_loss": loss}
    settings: dict[str, Any] = {"channel": channel, "seed": seed, "time": "packets"}
    if back:
        settings["robots"] = [{}, {"topics": []}]
    if duration_s is not None:
        settings["duration_s"] = duration_s
    result = simulate(load_scenario(name, options, **settings), tuning=tuning)
    ages = {topic.topic.rsplit("/", 1)[-1]: topic.age_s.mean for topic in result.topics}
    return {topic: result.duration_s if age is None else age for topic, age in ages.items()}


def paced_ratios(
    name: str, loss: float, *, back: bool = False, seeds: Sequence[int] = SEEDS, best_effort: Sequence[str] = ()
) -> dict[str, float]:
    """Per topic, as :func:`ratios`, but with packets that leave as soon as the air is free; see :func:`paced`."""
    runs = [paced(name, loss, back=back, seed=seed, best_effort=best_effort) for seed in seeds]
    before = VERSION_0[name, loss, "paced"]
    return {topic: sum(ages[topic] for ages in runs) / len(runs) / age for topic, age in before.items()}


def saturated() -> list[Row]:
    """Each topic's mean age, at most that with version 0."""
    rows: list[Row] = []
    for name in SCENARIOS:
        for loss in LOSSES:
            for topic, ratio in paced_ratios(name, loss, seeds=PACED_SEEDS[loss]).items():
                what = f"saturated: {name}, its own pacing, {loss:.0%} lost, {topic}: mean age over version 0's"
                rows.append(Row(what, ratio, "", "≤", TOLERANCE[loss], "{:.3f}"))
            for topic, (ratio, note) in ratios(name, loss).items():
                what = f"saturated: {name}, {loss:.0%} lost, {topic}: mean age over version 0's"
                rows.append(Row(what, ratio, "", "≤", TOLERANCE[loss], "{:.3f}", note))
    return rows + with_reports()


def with_reports(loss: float = 0.2) -> list[Row]:
    """Odometry with reports and thrifty repair. How far its age can come down in order: :mod:`bench.bound`."""
    name, topic = SCENARIOS[0], "odom"
    what = f"saturated: {name} with reports, {loss:.0%} lost"
    slotted, note = ratios(name, loss, back=True)[topic]
    (ordered,) = paced_ratios(name, loss, back=True).values()
    (newest,) = paced_ratios(name, loss, back=True, best_effort=[topic]).values()
    return [
        Row(f"{what}, {topic}: mean age over version 0's", slotted, "", "≤", TOLERANCE[loss], "{:.3f}", note),
        Row(f"{what}, its own pacing, {topic} in order: mean age over version 0's", ordered, "", "≤", 1.25, "{:.3f}"),
        Row(
            f"{what}, its own pacing, {topic} best effort: mean age over version 0's",
            newest,
            "",
            "≤",
            TOLERANCE[loss],
            "{:.3f}",
        ),
    ]
