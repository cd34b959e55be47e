"""Packets that overlap: the measured tables, and the same schedules at packets and at samples."""

from __future__ import annotations

import json
import logging
import random
from collections import Counter
from functools import cache
from math import sqrt
from pathlib import Path

import numpy as np
import pytest

from gr_ros2.phy import PHY, Phy
from gr_ros2.settings.config import ChannelConfig
from gr_ros2_lab.medium import FixedPaths, Medium, RadioPath, make_medium
from gr_ros2_lab.medium import collision_table as collisions
from gr_ros2_lab.medium.collision_table import (
    OFFSETS,
    PACKETS,
    SIRS_DB,
    CollisionTable,
    collision_table,
    delivered_at,
    edge,
)
from gr_ros2_lab.medium.loss_table import BUILTIN_DIR
from gr_ros2_lab.medium.packets import PacketMedium

pytestmark = pytest.mark.xdist_group("collisions")  # what is received at samples is worked out once

PACKET_LEN = 64


def radio(name: str, packet_len: int = PACKET_LEN, **options: object) -> Phy:
    made: Phy = PHY.load(name)(packet_len, 1e5, **options)
    return made


Received = set[tuple[int, int, int]]
"""Sender, number of the packet, and receiver."""


def paths(robots: int, seed: int) -> FixedPaths:
    """Levels between 8 and 35 dB, the same in both directions of a pair."""
    draw = random.Random(seed)
    levels = {(one, other): draw.uniform(8, 35) for one in range(robots) for other in range(one)}
    return FixedPaths(
        [
            [
                RadioPath(other, ChannelConfig(snr_db=levels[max(one, other), min(one, other)], seed=9 * one + other))
                for other in range(robots)
                if other != one
            ]
            for one in range(robots)
        ]
    )


def schedule(robots: int, load: float, packets: int, seed: int) -> list[tuple[float, int]]:
    """Starts in airtimes and senders: packets at random, ``load`` of them in an airtime, at each robot in a row."""
    draw, free, now = random.Random(seed), [0.0] * robots, 0.0
    sent = []
    for _ in range(packets):
        now += draw.expovariate(load)
        sender = draw.randrange(robots)
        start = max(now, free[sender])
        free[sender] = start + 1.0
        sent.append((start, sender))
    return sorted(sent)


def received(medium: Medium, of: Phy, sent: list[tuple[float, int]]) -> Received:
    draw, airtime = random.Random(0), of.airtime()
    for start, sender in sent:
        medium.send(sender, draw.randbytes(PACKET_LEN), start * airtime, airtime)
    heard = medium.receptions((sent[-1][0] + 3) * airtime)
    return {(one.sent.sender, one.sent.number, one.receiver) for one in heard}


@cache
def received_at_samples(name: str, robots: int, load: float) -> Received:
    of, sent = radio(name), schedule(robots, load, 1200, seed=1)
    return received(make_medium(paths(robots, 1), [of] * robots, samples=True, shared=True), of, sent)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "robots", "load"), [("ofdm", 6, 1.0), ("psk", 2, 0.3), ("gfsk", 6, 1.0)])
def test_both_levels_receive_the_same(name: str, robots: int, load: float) -> None:
    """At least 97 % of all receptions are equal, and the PDR of every pair is within its 99 % interval, over all pairs:
    each is tested at 1 % divided by their number."""
    of, sent = radio(name), schedule(robots, load, 1200, seed=1)
    at_samples = received_at_samples(name, robots, load)
    at_packets = received(make_medium(paths(robots, 1), [of] * robots, samples=False, shared=True), of, sent)
    everything = len(sent) * (robots - 1)
    assert len(at_samples ^ at_packets) / everything < 0.03
    packets = Counter(sender for _, sender in sent)
    limit = {2: 2.81, 6: 3.59}[robots]  # of a normal distribution, at 0.01 / pairs
    for sender in range(robots):
        for receiver in set(range(robots)) - {sender}:
            counts = [sum(one[::2] == (sender, receiver) for one in each) for each in (at_samples, at_packets)]
            number = packets[sender]
            pdr = sum(counts) / (2 * number)
            spread = sqrt(max(pdr * (1 - pdr), 1 / number) * 2 / number)
            assert abs(counts[0] - counts[1]) / number < limit * spread, (sender, receiver, counts, number)


def test_taking_interference_for_noise_does_not_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Why there are tables: without them the same schedule differs in 5 % of the receptions."""
    of, sent = radio("gfsk"), schedule(6, 1.0, 1200, seed=1)
    at_samples = received_at_samples("gfsk", 6, 1.0)
    medium = PacketMedium(paths(6, 1), [of] * 6, shared=True)
    monkeypatch.setattr(medium, "_table", lambda *_, **__: None)
    assert len(at_samples ^ received(medium, of, sent)) / (5 * len(sent)) > 0.04


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Tables that are measured in a second, and kept in a folder of the test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(collisions, "ABOVE_DB", (3.0, 20.0))
    monkeypatch.setattr(collisions, "PACKETS", 2)
    monkeypatch.setattr(collisions, "_EDGE", 0.1)
    return tmp_path / "gr-ros2" / "losses" / "collisions"


@pytest.mark.usefixtures("small")
def test_a_table_that_is_missing_is_measured_once_and_said(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    of = radio("psk", 20)
    assert collision_table(of, ChannelConfig(), measured=False) is None
    with caplog.at_level(logging.WARNING):
        table = collision_table(of, ChannelConfig())
    assert table is not None
    assert [record.message.split(";")[0] for record in caplog.records] == ["measuring collisions of psk, 20 B"]
    monkeypatch.setattr(collisions, "measure", None)  # calling it would fail
    again = collision_table(of, ChannelConfig(snr_db=3, seed=4, packet_loss=0.5))
    assert again is not None
    assert again.delivered.tolist() == table.delivered.tolist()
    assert again.edges == table.edges


def test_a_damaged_table_is_measured_again(small: Path) -> None:
    of = radio("psk", 20)
    first = collision_table(of, ChannelConfig())
    assert first is not None
    (file,) = small.glob("*.json")
    values = json.loads(file.read_text())
    for content in (
        "{",
        '{"delivered": [[1]]}',
        json.dumps({**values, "sent": 0}),
        json.dumps({**values, "edges": [0.5, float("nan")]}),
        json.dumps({**values, "snrs_db": values["snrs_db"][::-1]}),
    ):
        file.write_text(content)
        again = collision_table(of, ChannelConfig())
        assert again is not None
        assert again.delivered.tolist() == first.delivered.tolist()


def test_stock_receivers_have_no_table() -> None:
    assert collision_table(radio("ofdm", detection_threshold="stock"), ChannelConfig()) is None


def table_of(delivered: float | np.ndarray, sent: int = 100) -> CollisionTable:
    shape = (2, len(SIRS_DB), len(OFFSETS))
    return CollisionTable({}, (0.0, 10.0), sent, np.broadcast_to(delivered, shape).astype(float), (0.0, 0.0))


def test_between_points_the_share_lies_between_theirs() -> None:
    by_sir = np.linspace(0, 100, len(SIRS_DB))[None, :, None]
    sirs_db = np.linspace(SIRS_DB[0], SIRS_DB[-1], 40)
    survival = table_of(by_sir).survival(np.full(40, 5.0), sirs_db, 0.3)
    assert (np.diff(survival) >= 0).all()
    assert survival[-1] == pytest.approx(1.0)
    assert survival[0] < 0.001
    beyond = table_of(by_sir).survival(np.array([np.inf, -5.0]), np.array([90.0, -90.0]), -0.3)
    assert beyond.tolist() == pytest.approx([1.0, 0.0], abs=0.001)


@pytest.mark.parametrize("offset", [-1.0, 1.0])
def test_packets_that_only_touch_do_not_disturb_each_other(offset: float) -> None:
    by_sir = np.linspace(0, 100, len(SIRS_DB))[None, :, None]
    assert table_of(by_sir).survival(np.array([5.0]), np.array([-8.0]), offset)[0] == pytest.approx(1.0)


FILES = sorted((BUILTIN_DIR / "collisions").glob("*.json"))


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_the_tables_that_come_with_it_are_those_of_the_phys_as_they_are(file: Path) -> None:
    setting = json.loads(file.read_text())["setting"]
    of = radio(setting["phy"], setting["packet_len"], **setting["options"])
    table = collision_table(of, ChannelConfig(), measured=False)
    assert table is not None
    assert table.sent == PACKETS
    middles = np.abs(table.delivered / table.sent - 0.5)
    for row in range(len(table.snrs_db)):
        column, place = np.unravel_index(int(middles[row].argmin()), middles[row].shape)
        levels = table.snrs_db[row], OFFSETS[place], float(SIRS_DB[column])
        again = delivered_at(of, ChannelConfig(), *levels)
        assert again == table.delivered[row, column, place], "changed since: run tools/measure-losses"
    assert edge(of, ChannelConfig(), -1) == table.edges[0]


def test_there_are_tables() -> None:
    assert len(FILES) >= 3
