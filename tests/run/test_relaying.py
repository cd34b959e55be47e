"""`relay` of a scenario: what reaches robots that do not hear the sender, sealed and not."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.errors import ConfigError
from gr_ros2.link import Delivered
from gr_ros2.run.load import make_phys
from gr_ros2.run.scenario import load_scenario
from gr_ros2.run.simulate import Simulation
from gr_ros2.state.keys import new_key_file


def from_end_to_end(*overrides: str) -> int:
    """Messages of the first robot of `line` that the last one has received, of 16 sent in 8 s."""
    scenario = load_scenario("line", overrides, duration_s=8)
    registry = scenario.load_registry()
    run = Simulation(scenario, registry, make_phys(scenario.directions(), registry))
    pairs = Counter((event.src_id, robot.src_id) for _, robot, event in run.events() if isinstance(event, Delivered))
    assert pairs[1, 2] >= 15
    return pairs[1, 10]


def test_messages_cross_three_hops() -> None:
    assert from_end_to_end() >= 12
    assert not from_end_to_end("relay='off'")


def test_sealed_messages_cross_three_hops(tmp_path: Path) -> None:
    new_key_file(tmp_path / "fleet.key")
    assert from_end_to_end(f"key={tmp_path / 'fleet.key'}") >= 10


def test_relaying_needs_slots() -> None:
    with pytest.raises(ConfigError, match="relay = 'gain': the packets of slots name who hears whom"):
        load_scenario("line", ["medium=exclusive"])
