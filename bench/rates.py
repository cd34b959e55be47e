"""Receivers at different SNRs: how old the newest messages are at each, over how old they are where it is alone.

Odometry at 35 Hz in packets of its own and a scan at 5 Hz in eight packets are more than the air carries as the far
receiver hears them, with the packets that it loses; fewer packets end the bench. An age is the mean over time, over
both topics, and over runs that lose other packets.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from heapq import merge
from pathlib import Path
from statistics import mean
from struct import Struct

from bench.rows import Row, Sense
from gr_ros2.link.events import Delivered, SentPacket
from gr_ros2.link.v1.audiences import Audiences
from gr_ros2.settings.files import find_registry
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import scenario_from
from gr_ros2_lab.run.simulate import Offered, Simulation

NEAR, FAR = 2, 3
SNR_DB = {NEAR: 30.0, FAR: 6.0}
SCAN, ODOM = 0, 1
"""Topic ids of the registry."""
NAMES = {SCAN: "scan", ODOM: "odom"}
LENGTHS, HZ = {SCAN: 1500, ODOM: 100}, {SCAN: 5.0, ODOM: 35.0}
PACKETS = {SCAN: 8, ODOM: 1}
"""Packets in which a message leaves at least; slots take a part of their room."""
COMPRESSION = False
SAMPLE_RATE, SLOTS_RATE = 1.5e5, 1e6
"""In slots every packet takes the time of the longest one with the most robust MCS."""
WARM_UP_S, SECONDS = 5.0, 65.0
SEEDS = range(4)
MOST = {NEAR: 1.3, FAR: 1.5}
_stamp = Struct(">d")

Ages = Mapping[int, Mapping[int, float]]


def ages(snrs_db: Mapping[int, float], sample_rate: float, medium: str = "exclusive") -> dict[int, dict[int, float]]:
    """Mean age in s of each topic at each receiver.

    :param snrs_db: of the receivers, by robot id
    """
    runs = [_ages(snrs_db, sample_rate, medium, seed) for seed in SEEDS]
    return {receiver: {topic: mean(run[receiver][topic] for run in runs) for topic in HZ} for receiver in snrs_db}


def _ages(snrs_db: Mapping[int, float], sample_rate: float, medium: str, seed: int) -> dict[int, dict[int, float]]:
    scenario = scenario_from(
        {
            "name": "rates",
            "seed": seed,
            "registry": find_registry("table4", Path()),
            "time": "packets",
            "packet_len": 220,
            "medium": medium,
            "duplex": "half" if medium == "slots" else "full",
            "robots": [{}, *[{"robot": receiver, "topics": []} for receiver in snrs_db]],
            "topics": {name: {"queue": "latest"} for name in NAMES.values()},
            "compression": COMPRESSION,
            "phy": {"name": "ofdm", "sample_rate": sample_rate, "options": {"rate": "adaptive"}},
            "paths": [{"from": 1, "to": receiver, "snr_db": snr_db} for receiver, snr_db in snrs_db.items()],
            "duration_s": SECONDS,
        }
    )
    registry = scenario.load_registry()
    run = Simulation(scenario, registry, make_phy(scenario, registry), messages=[messages()])
    newest = {(receiver, topic): 0.0 for receiver in snrs_db for topic in HZ}
    area, last = dict.fromkeys(newest, 0.0), dict.fromkeys(newest, WARM_UP_S)

    packets: dict[int, dict[int, set[int]]] = {topic: defaultdict(set) for topic in HZ}

    def until(now: float, at: tuple[int, int]) -> None:
        area[at] += ((now - newest[at]) ** 2 - (last[at] - newest[at]) ** 2) / 2
        last[at] = now

    for now, robot, event in run.events():
        if isinstance(event, SentPacket):
            for entry in event.entries:
                if entry.topic_id in HZ:
                    packets[entry.topic_id][entry.serial].add(event.number)
        if isinstance(event, Delivered) and event.topic_id in HZ and now < SECONDS:
            at = robot.src_id, event.topic_id
            if now > WARM_UP_S:
                until(now, at)
            (newest[at],) = _stamp.unpack_from(event.payload)
    for at in newest:
        until(SECONDS, at)
    each = {topic: max(map(len, found.values())) for topic, found in packets.items()}
    if any(each[topic] < least for topic, least in PACKETS.items()):
        raise SystemExit(f"bench rates: messages leave in {each} packets by topic, not in {PACKETS} or more")
    return {receiver: {topic: area[receiver, topic] / (SECONDS - WARM_UP_S) for topic in HZ} for receiver in snrs_db}


def messages() -> Iterator[Offered]:
    """Messages at equal distances, each with the time at which it was made."""

    def of(topic: int) -> Iterator[Offered]:
        for number in range(int(SECONDS * HZ[topic])):
            at = (number + topic / 3) / HZ[topic]
            yield Offered(at, topic, _stamp.pack(at) + bytes(LENGTHS[topic] - _stamp.size))

    return merge(*(of(topic) for topic in HZ), key=lambda offered: offered.t)


@contextmanager
def for_all() -> Iterator[None]:
    """Every packet is for all, as the weakest robot needs it."""
    chosen = Audiences.of
    Audiences.of = lambda _, __: ()  # type: ignore[assignment,method-assign]
    try:
        yield
    finally:
        Audiences.of = chosen  # type: ignore[method-assign]


def rates() -> list[Row]:
    """A near receiver and a far one, each packet for those for whom it is worth most, and each for all."""
    alone = {receiver: ages({receiver: snr_db}, SAMPLE_RATE)[receiver] for receiver, snr_db in SNR_DB.items()}
    with for_all():
        before = ages(SNR_DB, SAMPLE_RATE)
    rows = _rows("rates", ages(SNR_DB, SAMPLE_RATE), alone, MOST)
    rows += _rows("rates, every packet for all", before, alone, {})
    # Robots share the slots, so that there are as many where one is not alone.
    equal = {r: ages(dict.fromkeys(SNR_DB, snr_db), SLOTS_RATE, "slots")[r] for r, snr_db in SNR_DB.items()}
    return rows + _rows("rates in slots", ages(SNR_DB, SLOTS_RATE, "slots"), equal, MOST)


def _rows(what: str, found: Ages, alone: Ages, most: Mapping[int, float]) -> list[Row]:
    rows = []
    for receiver, snr_db in SNR_DB.items():
        ratio = mean(found[receiver].values()) / mean(alone[receiver].values())
        note = ", ".join(
            f"{NAMES[topic]} {1e3 * age:.0f} ms, alone {1e3 * alone[receiver][topic]:.0f}"
            for topic, age in found[receiver].items()
        )
        label = f"{what}: age at {snr_db:g} dB over alone"
        sense: Sense = "≤" if receiver in most else None
        rows.append(Row(label, ratio, "", sense, most.get(receiver, 0.0), "{:.2f}", note))
    return rows
