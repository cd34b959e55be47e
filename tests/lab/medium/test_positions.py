"""Levels from where robots are: counted walls, recordings, and what is computed for a packet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import ChannelConfig, ScenarioChannel, build
from gr_ros2_lab.medium import make_medium
from gr_ros2_lab.medium.base import RadioPath
from gr_ros2_lab.medium.loss_table import LossCurve
from gr_ros2_lab.medium.positions import LEAST_DB, STEP_S, Positions, snr_map
from gr_ros2_lab.medium.propagation import path_loss_db, snr_over_db
from gr_ros2_lab.report.snr_map import map_of
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.robots import surroundings
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import dump, load_scenario, scenario_from
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.world import World
from gr_ros2_lab.study.forecast import Planner

DRIVE = Path(__file__).parents[2] / "data" / "simulated_drive"


def channel(**settings: Any) -> ScenarioChannel:
    return build(ScenarioChannel, {"from": "positions", **settings})


def standing(places: Any, world: World | None = None, velocities: Any = None, **settings: Any) -> Positions:
    """Robots that stand, or move with these velocities."""
    there = np.array(places, float)
    speeds = np.zeros_like(there) if velocities is None else np.array(velocities, float)
    base, count = channel(**settings), len(places)
    paths = [[RadioPath(other, base) for other in range(count) if other != one] for one in range(count)]
    return Positions(
        base, lambda now: (there + now * speeds, speeds), 1e6, [20.0] * count, [6.0] * count, paths=paths, world=world
    )


def test_the_level_follows_from_distance_power_and_noise() -> None:
    around = standing([[0, 0], [10, 0], [0, 100]], exponent=3.0)
    heard = around.hearers(0, 0.0)
    assert heard.ids.tolist() == [1, 2]
    expected = 20 - path_loss_db(channel(exponent=3.0), np.array([10.0, 100.0])) - (-174 + 60 + 6)
    assert heard.snr_db.tolist() == pytest.approx(expected.tolist())
    assert around.hearers(0, 0.05) is heard, "nothing has changed"
    assert around.hearers(1, 0.0).snr_db[0] == pytest.approx(heard.snr_db[0])


def test_robots_that_move_are_where_they_are() -> None:
    around = standing([[0, 0], [10, 0]], velocities=[[0, 0], [10, 0]])
    levels = [float(around.hearers(0, now).snr_db[0]) for now in (0.0, 1.0, 9.0)]
    assert levels[0] - levels[1] == pytest.approx(30 * np.log10(2))
    assert levels[0] - levels[2] == pytest.approx(30)
    assert around.hearers(0, 1.0).shift_hz[0] == pytest.approx(-10 / 299_792_458 * 2.4e9)


def test_each_obstacle_on_the_line_costs_its_loss() -> None:
    """The count is that of an independent check: points on the line that lie in one of the obstacles."""
    world = World(30.0, 60, np.random.default_rng(3))
    rng = np.random.default_rng(4)
    places = rng.uniform(0.5, 29.5, (60, 2))
    places = places[world.clearance(places) > 0]
    alone = [World(30.0, 0, rng) for _ in range(len(world.boxes) + len(world.circles))]
    for number, one in enumerate(alone):
        if number < len(world.boxes):
            one.boxes = world.boxes[[number]]
            one._cos, one._sin = world._cos[[number]], world._sin[[number]]
        else:
            one.circles = world.circles[[number - len(world.boxes)]]
    counts = world.crossed(places[0], places[1:])
    along = np.linspace(0, 1, 4001)[:, None]
    for end, count in zip(places[1:], counts.tolist(), strict=True):
        line = places[0] + along * (end - places[0])
        inside = [one.clearance(line).min() for one in alone]
        assert sum(depth < -1e-3 for depth in inside) <= count <= sum(depth < 1e-3 for depth in inside)
    assert counts.max() >= 2
    assert counts.min() == 0
    free, walled = (standing(places, world, walls_db=db).hearers(0, 0.0) for db in (0.0, 7.0))
    assert (free.snr_db - walled.snr_db).tolist() == pytest.approx((7.0 * counts).tolist())


def test_nobody_beyond_the_reach_is_looked_at_or_missed() -> None:
    rng = np.random.default_rng(5)
    places = rng.uniform(0, 3000, (255, 2))
    near = standing(places, tx_power_dbm=-10.0, exponent=4.0, shadowing_db=3.0)
    heard = near.hearers(7, 0.0)
    assert 5 < len(heard.ids) < 250
    assert heard.snr_db.min() >= LEAST_DB
    assert np.hypot(*(places[heard.ids] - places[7]).T).max() <= near.reach_m
    for other in heard.ids.tolist():
        assert near.near(7, 0.0)[near.hearers(other, 0.0).ids].all()


def test_the_range_is_where_the_level_ends() -> None:
    around = standing([[0, 0], [5, 5]], exponent=3.0)
    for snr_db in (0.0, 10.0, 30.0):
        reach_m = around.range_m(snr_db)
        there = snr_over_db(-path_loss_db(channel(), np.array([reach_m])), 20.0, 6.0, 1e6)
        assert there[0] == pytest.approx(snr_db, abs=0.2)


AMONG_WALLS = (
    "gains_db=null",
    "sim={odom_rate: 10, obstacles: 20, size_m: 40}",
    "channel={from: positions, walls_db: 15, shadowing_db: 4, tx_power_dbm: -14, exponent: 3.5}",
)
PLACED = ("gains_db=null", "channel={from: positions, walls_db: 10}")


def test_a_scenario_takes_the_places_of_its_simulator() -> None:
    scenario = load_scenario("two-robots-half-duplex", PLACED)
    assert scenario_from(dump(scenario)) == scenario
    around = surroundings(scenario, 1e6)
    fleet = Fleet(scenario.sim)
    for now in (0.0, 3.0, 7.0):
        places, _ = fleet.at(now, (1, 2))
        apart = np.hypot(*(places[1] - places[0]))
        walls = fleet.world.crossed(places[0], places[1:])[0]
        expected = 20 - path_loss_db(scenario.channel, np.array([apart])) - 10 * walls - (-174 + 60 + 6)
        assert around.hearers(0, now + STEP_S / 2).snr_db == pytest.approx(expected)
        assert around.hearers(1, now).snr_db == pytest.approx(expected)


def test_a_recording_tells_places_by_its_odometry() -> None:
    """The receiver has no odometry in it, so it stands where the drive began."""
    settings = (
        f"source=bag:{DRIVE}",
        "time=packets",
        "topics=[odom]",
        "robots=[{}, {topics: []}]",
    )
    around = surroundings(load_scenario("paper-ofdm-paced", [*settings, "channel={from: positions}"]), 1e6)
    levels = [float(around.hearers(0, now).snr_db[0]) for now in np.arange(0, 6, 0.5)]
    assert levels[0] == pytest.approx(20 - 40.05 + 108, abs=0.01), "nearer than a metre"
    assert min(levels) < levels[0] - 3
    assert float(around.hearers(1, 5.0).snr_db[0]) == pytest.approx(float(around.hearers(0, 5.0).snr_db[0]))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["channel={from: positions, snr_db: 3}"], r"channel: snr_db = 3.0: follows from positions; leave it out"),
        (
            ["channel={walls_db: 3}"],
            "walls_db = 3.0: acts only where levels follow from positions; set from: positions",
        ),
        (["channel={from: places}"], "channel.from = 'places': must be 'settings' or 'positions'"),
        (
            ["channel={from: positions, model: hata}"],
            "channel.model = 'hata': must be 'log_distance', 'two_ray' or 'fr",
        ),
        (["channel={from: positions, height_m: 2}"], "height_m = 2.0: only model two_ray has it"),
        (
            ["channel={from: positions, decorrelation_m: 2}"],
            "decorrelation_m = 2.0: nothing is shadowed; set shadowing_db above 0",
        ),
        (["channel={from: positions}", "gains_db=-100"], "gains_db: levels follow from positions"),
        (["channel={from: positions}", "phy={name: direct}"], "phy direct has no samples, so no level"),
        (["gains_db=-100", "phy={name: direct}"], "gains_db: phy direct has no samples, so no level"),
        (["channel={from: positions}", "sim.robots=1"], "/robot_2 is none of the 1 simulated robots, so nobody knows"),
    ],
)
def test_what_does_not_go_together_is_said_in_a_line(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        surroundings(load_scenario("two-robots-half-duplex", ["gains_db=null", *overrides]), 1e6)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["channel={from: positions, walls_db: 3}"], "a recording has no world to count walls in"),
        (["channel={from: positions}", "robots.0.robot=/robot_9"], "has no odometry of /robot_9; it has "),
    ],
)
def test_a_recording_without_what_it_takes_is_refused(overrides: list[str], message: str) -> None:
    drive = [f"source=bag:{DRIVE}", "time=packets", "topics=[odom]"]
    with pytest.raises(ConfigError, match=message):
        surroundings(load_scenario("paper-ofdm-paced", [*drive, *overrides]), 1e6)


@pytest.mark.parametrize("time", ["packets", "samples"])
def test_a_drive_behind_obstacles_loses_what_the_tables_say(time: str) -> None:
    """Packets by their SNR, which follows from places and walls: those that arrive, against the PDR of the table."""
    scenario = load_scenario("two-robots-half-duplex", [*AMONG_WALLS, "duration_s=60"])
    of = make_phy(scenario, scenario.load_registry())
    around = surroundings(scenario, of.sample_rate)
    medium = make_medium(around, [of] * 2, samples=time == "samples", shared=True)
    snrs_db, arrived = [], []
    for number in range(1000):
        now = 0.06 * number
        medium.send(0, number.to_bytes(64, "big"), now, of.airtime())
        snrs_db.append(float(around.hearers(0, now).snr_db[0]))
        arrived.append(any(True for _ in medium.receptions(now + 0.05)))
    expected = LossCurve(of, ChannelConfig()).pdr(np.array(snrs_db))
    assert 0.1 < expected.mean() < 0.9
    assert np.ptp(snrs_db) > 25
    spread = np.sqrt((expected * (1 - expected)).sum()) + 3.0
    assert abs(sum(arrived) - expected.sum()) < 3 * spread
    good = expected > 0.99
    assert np.array(arrived)[good].mean() > 0.98
    assert np.array(arrived)[expected < 0.01].mean() < 0.02


def test_a_report_has_the_map_and_a_plan_the_range() -> None:
    scenario = load_scenario("two-robots-half-duplex", [*AMONG_WALLS, "duration_s=2", "time=packets"])
    result = run_scenario(scenario).result
    figure = map_of(result)
    assert figure is not None
    middles, snr_db = snr_map(scenario.channel, Fleet.of(scenario.sim).world, np.array([20.0, 20.0]), 2e5)
    place = np.array([middles[80], middles[20]])
    paths = [[RadioPath(1, scenario.channel)], [RadioPath(0, scenario.channel)]]
    places = np.array([[20.0, 20.0], place])
    there = Positions(
        scenario.channel,
        lambda _: (places, np.zeros((2, 2))),
        2e5,
        [scenario.channel.tx_power_dbm] * 2,
        [scenario.channel.noise_figure_db] * 2,
        paths=paths,
        world=Fleet.of(scenario.sim).world,
    )
    assert snr_db[20, 80] == pytest.approx(there.hearers(0, 0.0).snr_db[0], abs=0.01)
    assert map_of(run_scenario(load_scenario("two-robots-half-duplex", ["duration_s=0.5"])).result) is None
    one_way = load_scenario("paper-ofdm-paced", ["channel={from: positions, tx_power_dbm: -20}", "time=packets"])
    half_m, most_m = (Planner(replace(one_way, duration_s=1.0)).range_m(pdr) for pdr in (0.5, 0.95))
    assert half_m is not None
    assert most_m is not None
    assert 1.02 * most_m < half_m < 2 * most_m
    assert Planner(load_scenario("paper-ofdm-paced", ["duration_s=1"])).range_m(0.5) is None
