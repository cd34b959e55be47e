"""Robots with whole endpoints on one channel: slots against sending at once, sealed and not, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.link import Delivered
from gr_ros2.state.keys import new_key_file
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.run.simulate import Simulation

BOTH_WAYS = ("sim.odom_rate=35", "packet_len=96", "phy.sample_rate=300000")


def delivered(name: str, *overrides: str, duration_s: float) -> tuple[dict[int, int], Simulation]:
    """Messages that others have received of each robot."""
    scenario = load_scenario(name, overrides, duration_s=duration_s)
    registry = scenario.load_registry()
    run = Simulation(scenario, registry, make_phy(scenario, registry))
    counts = {robot.src_id: 0 for robot in run.robots}
    for _, _, event in run.events():
        if isinstance(event, Delivered):
            counts[event.src_id] += 1
    return counts, run


@pytest.mark.slow
def test_two_robots_both_ways_lose_nothing_in_slots_and_most_of_it_otherwise() -> None:
    counts, _ = delivered("two-robots-half-duplex", *BOTH_WAYS, "medium=slots", duration_s=10)
    assert min(counts.values()) >= 0.99 * 350
    at_once, _ = delivered("two-robots-half-duplex", *BOTH_WAYS, duration_s=10)
    assert sum(at_once.values()) <= 0.65 * sum(counts.values())


@pytest.mark.parametrize("sample_rate", [24_000, 8_000])
def test_packets_of_200_ms_share_a_channel_as_shorter_ones_do(sample_rate: int) -> None:
    two = ("robots=2", "sim.robots=2", "sim.odom_rate=1", f"phy.sample_rate={sample_rate}")
    counts, _ = delivered("team", *two, duration_s=60)
    assert min(counts.values()) >= 58


def test_four_robots_share_a_channel() -> None:
    counts, run = delivered("team", duration_s=10)
    assert min(counts.values()) >= 0.99 * 3 * 100
    assert run.medium.lost.total("collision") < 40, "of those that enter together"


def test_twenty_robots_share_a_channel() -> None:
    counts, _ = delivered("twenty-robots", duration_s=2)
    assert sum(counts.values()) >= 0.95 * 20 * 19 * 4


def test_sealed_packets_carry_slots_too(tmp_path: Path) -> None:
    key = tmp_path / "fleet.key"
    new_key_file(key)
    counts, _ = delivered("team", f"key={key}", duration_s=8)
    assert min(counts.values()) >= 0.97 * 3 * 80


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["medium=slots", "paper={}"], "version 0"),
        (["medium=slots", "phy.name=direct"], "direct"),
        (["medium=slots", "duplex=full"], "duplex: half"),
        (["medium=slot"], "medium"),
        (["robots=256"], "robots = 256: a robot has an id of 0..254; set up to 255 robots$"),
        (["robots=100000000000"], "up to 255 robots$"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(overrides: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said) as refused:
        load_scenario("two-robots-half-duplex", overrides)
    assert "\n" not in str(refused.value)


def test_corrections_of_a_base_station_reach_every_robot() -> None:
    counts, run = delivered("rtk", duration_s=15)
    assert len(run.robots) == 5
    assert counts.pop(1) == 4 * 15
    assert min(counts.values()) >= 0.9 * 4 * 30
