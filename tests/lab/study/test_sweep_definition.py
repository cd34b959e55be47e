"""Sweep files: cells, seeds, and one clear line for everything that is wrong, before anything runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.study.sweep.definition import builtin_sweeps, load_sweep, read_sweep
from tests.lab.study.sweeps import plan, write_sweep_file


def test_a_grid_is_all_combinations(tmp_path: Path) -> None:
    made = plan(tmp_path, grid={"channel.packet_loss": [0, 0.1], "packet_len": [64, 128, 256]}, repetitions=1)
    points = [(cell.values["channel.packet_loss"], cell.values["packet_len"]) for cell in made.cells]
    assert points == [(loss, length) for loss in (0.0, 0.1) for length in (64, 128, 256)]
    scenario = made.cells[-1].runs[0]
    assert (scenario.packet_len, scenario.packet_len, scenario.duration_s) == (256, 256, 1.0)
    assert scenario.time == "packets"


def test_a_number_of_robots_stays_a_number(tmp_path: Path) -> None:
    made = plan(tmp_path, scenario="formation", description=None, grid={"robots": [2, 3]}, repetitions=1)
    assert [(cell.values["robots"], len(cell.runs[0].robots)) for cell in made.cells] == [(2, 2), (3, 3)]


def test_a_list_is_run_at_every_point_of_the_grid_and_says_what_it_leaves_as_it_is(tmp_path: Path) -> None:
    entries = [{"phy.name": "direct"}, {"phy.name": "gfsk", "phy.options": {"sps": 4}, "phy.sample_rate": 1e5}]
    made = plan(tmp_path, list=entries, grid={"packet_len": [64, 128]})
    assert made.keys == ["phy.name", "phy.options", "phy.sample_rate", "packet_len"]
    assert [tuple(cell.values.values()) for cell in made.cells] == [
        ("direct", "{}", "auto", 64),
        ("direct", "{}", "auto", 128),
        ("gfsk", '{"sps": 4}', 1e5, 64),
        ("gfsk", '{"sps": 4}', 1e5, 128),
    ]


def test_values_are_taken_as_they_stand(tmp_path: Path) -> None:
    odd = ["1", "null", "a: b", "{x}", "2e5"]
    made = plan(
        tmp_path,
        grid={"topics": [{"odom": {"codec": text}} for text in odd]},
        set={"paper.compression": True},
    )
    found = [cell.runs[0].robots[0].topics["odom"].codec for cell in made.cells]
    assert found == odd


def test_repetitions_differ_in_all_seeds_and_cells_share_them(tmp_path: Path) -> None:
    made = plan(tmp_path, repetitions=3, set={"seed": 5})
    assert len(made.cells) == 3
    for cell in made.cells:
        assert [(run.seed, run.sim.seed, run.channel.seed) for run in cell.runs] == [(n, n, n) for n in (5, 6, 7)]


def test_scenario_and_registry_are_looked_for_beside_the_sweep(tmp_path: Path) -> None:
    (tmp_path / "own.csv").write_text("odom,nav_msgs/Odometry\n")
    (tmp_path / "mine.yaml").write_text("registry: own.csv\nphy: {name: direct}\nrobots: 2\n")
    made = plan(tmp_path, scenario="mine.yaml", grid={"registry": ["own.csv", "odom"]})
    assert made.cells[0].runs[0].registry == str(tmp_path / "own.csv")
    assert made.cells[1].runs[0].registry.endswith("registries/odom.csv")


def test_overrides_of_the_command_line_win_over_the_file_and_not_over_the_sweep(tmp_path: Path) -> None:
    made = load_sweep(write_sweep_file(tmp_path), ["duration_s=0.5", "channel.packet_loss=0.9"])
    assert {run.duration_s for cell in made.cells for run in cell.runs} == {0.5}
    assert [cell.runs[0].channel.packet_loss for cell in made.cells] == [0.0, 0.01, 0.1]


def test_repetitions_and_time_may_be_set_for_the_sweep(tmp_path: Path) -> None:
    made = load_sweep(write_sweep_file(tmp_path), ["repetitions=1", "time=packets", "duration_s=1"])
    assert (made.sweep.repetitions, made.sweep.time) == (1, "packets")
    runs = [run for cell in made.cells for run in cell.runs]
    assert len(runs) == len(made.cells)
    assert {(run.time, run.repetitions, run.duration_s) for run in runs} == {("packets", 1, 1.0)}
    with pytest.raises(ConfigError, match=r"repetitions = 0"):
        load_sweep(write_sweep_file(tmp_path), ["repetitions=0"])
    with pytest.raises(ConfigError, match="repetitions is the same in all cells; write it at the top of the file"):
        load_sweep(write_sweep_file(tmp_path, set={"repetitions": 2}))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"grid": {"channel.snr": [1]}},
            r"cell 1 of 1 \(channel.snr=1\): .*unknown key channel.snr; known are seed, snr_db",
        ),
        (
            {"grid": {"channel.packet_loss": [0.5, 2]}},
            r"cell 2 of 2 \(channel.packet_loss=2\): .*channel.packet_loss = 2: .*less than or equal to 1",
        ),
        ({"grid": {"channel.snr_db": [10]}}, r"cell 1 of 1 .*channel.snr_db = 10.0: phy direct has no samples"),
        (
            {"grid": {"phy.name": ["direct", "ofdm"]}, "set": {"phy.options": {"sps": 2}}},
            r"cell 1 of 2 \(phy.name=direct\): .*sps",
        ),
        ({"grid": {"registry": ["nowhere.csv"]}}, r"cell 1 of 1 .*registry = 'nowhere.csv': no such file"),
        ({"set": {"channel.seed": 3}}, r"cell 1 of 3 .*channel.seed is fixed"),
        ({"topic": "/robot_1/scan"}, r"topic = '/robot_1/scan': not sent; sent are /robot_1/odom"),
        (
            {"set": {"registry": "table4", "duration_s": 1}, "value": "age_mean_s"},
            r"value = 'age_mean_s' has each topic for itself; set topic to one of /robot_1/",
        ),
        ({"scenario": "paper-smoke"}, r"scenario '.*paper-smoke' is neither a file nor built in"),
        ({"grid": None}, "nothing to sweep; give grid, list or both"),
        ({"grid": {"packet_len": []}}, r"grid.packet_len"),
        ({"set": {"channel.packet_loss": 0.5}}, "channel.packet_loss stands in set and is swept"),
        ({"list": [{"channel.packet_loss": 0}]}, "channel.packet_loss stands in grid and in list"),
        ({"x": "packet_len"}, "x = 'packet_len' is not swept; swept are channel.packet_loss"),
        ({"by": ["phy.name"]}, "by = 'phy.name' is not swept"),
        ({"value": "beauty"}, "value = 'beauty': no such number; known are pdr, goodput_Bps"),
        ({"repetitions": 0}, "repetitions = 0"),
        ({"time": "fast"}, "time = 'fast'"),
        ({"colour": "red"}, "unknown key colour; known are description"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_before_anything_runs(
    tmp_path: Path, changes: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        plan(tmp_path, **changes)
    assert "lost.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_sweep_names_those_there_are() -> None:
    with pytest.raises(
        ConfigError, match=r"sweep 'nonsense' is neither a file nor built in; built in are .*pdr-vs-snr"
    ):
        load_sweep("nonsense")


@pytest.mark.parametrize("name", builtin_sweeps())
def test_the_built_in_sweeps_can_be_run(name: str) -> None:
    made = load_sweep(name, ["duration_s=1"])
    assert len(made.cells) >= 12
    assert read_sweep(name).description
