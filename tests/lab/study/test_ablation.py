"""One part off at a time: which parts there are, and that each run differs in its part alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.record.result import read_result
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.study.ablation import run_variants, variants, worth_grid


def named(name: str, *overrides: str) -> list[str]:
    return [variant.name for variant in variants(load_scenario(name, overrides))]


def test_each_part_that_is_on_has_a_variant() -> None:
    assert named("six-topics-paced") == ["whole", "no-compression", "no-pull", "no-repair", "no-latest"]
    assert named("paper-ofdm-paced") == ["whole", "no-compression", "no-pull", "no-repair"]
    plain = ("robots=[{direction: send}, {direction: receive}]", "compression=false", "repair='off'", "packet_rate=0")
    assert named("demo", *plain, "topics.odom.depth=1") == ["whole", "no-latest"]
    assert named("demo", "paper={}", "robots=[{direction: send}, {direction: receive}]") == ["whole", "no-pull"]
    assert named("demo") == ["whole", "no-compression", "no-pull", "no-repair", "no-reports"]
    with pytest.raises(ConfigError, match="scenario paper-ofdm: nothing to switch off"):
        named("paper-ofdm")


def test_a_part_goes_with_its_details_which_have_no_effect_without_it() -> None:
    details = ["expected_loss=0.4", "topics.odom.quantize=pose.pose.position=0.1"]
    whole = load_scenario("six-topics-paced", details)
    for variant in variants(whole):
        assert load_scenario("six-topics-paced", [*details, *variant.settings]) != whole or variant.name == "whole"


def flat(config: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting by its dotted name."""
    for key, value in config.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def test_every_run_differs_in_its_part_alone(tmp_path: Path) -> None:
    seen: list[str] = []
    settings = ["time=packets", "phy.sample_rate=32000"]
    runs = run_variants(
        "six-topics-paced", tmp_path, settings, lambda variant: seen.append(variant.name), seed=3, duration_s=4.0
    )
    assert seen == [run.directory.name for run in runs]
    whole, *others = (dict(flat(read_result(run.directory).config)) for run in runs)
    for config in (whole, *others):
        del config["description"]  # it is made from the settings
    assert whole["seed"] == 3
    differing = [{key for key in whole.keys() | other.keys() if whole.get(key) != other.get(key)} for other in others]
    queues = {f"topics.{topic}.queue" for topic in ("scan", "odom", "imu", "cmd_vel", "map", "clock")}
    assert differing == [
        {"compression"},
        {"packet_rate"},
        {"repair"},
        queues,
    ]

    grid = worth_grid(runs)
    assert grid.headings[2:] == tuple(seen)
    table = {line[:2]: line[2:] for section in grid.sections for line in section}
    whole_age, no_compression, no_pull, *_ = map(float, table["/robot_1/odom", "mean age [ms]"])
    assert whole_age < no_compression
    assert whole_age < no_pull
    rate = float(table["/robot_1/odom", "messages/s"][0])
    assert rate == pytest.approx(runs[0].result.topics[1].delivered / 4.0, abs=0.01)
    assert float(table["link", "air bytes per message"][0]) < float(table["link", "air bytes per message"][1])


def test_the_papers_blocks_are_told_by_their_own_setting() -> None:
    whole, first, *_ = variants(load_scenario("paper-ofdm", ["paper.compression=true"]))
    assert (whole.settings, first.settings) == ((), ("paper.compression=false",))
