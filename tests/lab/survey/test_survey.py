"""Surveys: what a drive measures, the path loss that fits it, and the channel that it makes."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, replace
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.link import Received
from gr_ros2_lab.cli.plan import range_words
from gr_ros2_lab.medium.measured import SurveyedPlaces
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.robots import surroundings
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import Scenario, scenario_from
from gr_ros2_lab.run.simulate import Simulation
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.study.forecast import Planner
from gr_ros2_lab.survey.recorder import STALE_S, Place, SurveyRecorder
from gr_ros2_lab.survey.table import Survey, SurveyRow, read_table, write_table

ODOM = str(Path(__file__).parents[3] / "gr_ros2/registries/odom.csv")
EXPONENT = 3.2
LOOK_S = 0.5


def scenario(channel: dict[str, Any], **settings: Any) -> Scenario:
    """Robot 1 sends, and robot 2 hears it while both drive: near the end of its range for some of the time."""
    values: dict[str, Any] = {"name": "survey", "registry": ODOM, "robots": [{}, {"topics": []}], "time": "packets"}
    values |= {"phy": {"name": "psk", "sample_rate": 1e5}, "repair": "off", "duration_s": 90, "packet_len": 128}
    values |= {"sim": {"size_m": 30, "obstacles": 0, "odom_rate": 20}, "channel": channel, "seed": 1}
    return scenario_from({**values, **settings})


FAR = {"from": "positions", "exponent": EXPONENT, "tx_power_dbm": -33.0}


def driven(chosen: Scenario) -> list[SurveyRow]:
    """What a survey records on a drive: the run itself, in simulated time."""
    registry = chosen.load_registry()
    run = Simulation(chosen, registry, make_phy(chosen, registry))
    fleet, recorder, packets = Fleet.of(chosen.sim), SurveyRecorder(1), Counter[int]()
    hearer, looked = run.robots[1], 0.0
    for now, robot, event in run.events():
        while looked + LOOK_S <= now:
            looked += LOOK_S
            there, here = fleet.at(looked, fleet.robot_ids[:2])[0]
            recorder.here(Place(looked, *here))
            recorder.there(Place(looked, *there))
            peers = [asdict(peer) for peer in hearer.endpoint.peers(looked)]
            sink = {"packets_of": dict(packets), "topics": {}}
            recorder.look({"uptime_s": looked, "peers": peers, "phy": {"snr_db": None}, "sink": sink}, looked)
        if robot is hearer and isinstance(event, Received):
            packets[event.packet.src_id] += 1
    return recorder.finish()


@pytest.fixture(scope="module")
def rows() -> list[SurveyRow]:
    return driven(scenario(FAR))


def lost(rows: list[SurveyRow], t_s: Floats | None = None) -> float:
    chosen = rows if t_s is None else [row for row in rows if t_s[0] <= row.t_s < t_s[1]]
    return sum(row.lost for row in chosen) / max(sum(row.lost + row.packets for row in chosen), 1)


def test_a_drive_with_a_known_path_loss_returns_its_exponent(rows: list[SurveyRow]) -> None:
    line = Survey("drive", rows).path_loss
    assert line.exponent == pytest.approx(EXPONENT, abs=3 * line.slope_error)
    assert line.slope_error < 0.1
    assert line.rms < 1.5, "the receiver's SNR is exact to 1 dB"
    assert 0.05 < lost(rows) < 0.6, "or the drive says little"


def test_a_scenario_with_the_survey_as_its_channel_repeats_the_losses(rows: list[SurveyRow], tmp_path: Path) -> None:
    write_table(rows, tmp_path / "survey.csv")
    again = driven(scenario({"trace": str(tmp_path / "survey.csv")}))
    assert lost(again) == pytest.approx(lost(rows), abs=0.04)
    windows = [(t, t + 15.0) for t in range(0, 90, 15)]
    before, then = ([lost(some, np.array(window)) for window in windows] for some in (rows, again))
    assert max(before) - min(before) > 0.2
    assert then == pytest.approx(before, abs=0.16)


def test_holes_are_filled_by_the_path_loss(rows: list[SurveyRow], tmp_path: Path) -> None:
    """Another drive, through other places: the levels are those of the true path loss."""
    write_table(rows, tmp_path / "survey.csv")
    truth, told = (
        surroundings(scenario(channel, seed=8), 1e5) for channel in (FAR, {"trace": str(tmp_path / "survey.csv")})
    )
    levels = [(a.hearers(0, t).at[1], b.hearers(0, t).at[1]) for t in range(60) for a, b in [(truth, told)]]
    apart_db = 10 * np.log10([one / other for one, other in levels])
    assert np.sqrt((apart_db**2).mean()) < 1.5
    assert isinstance(told, SurveyedPlaces)


def test_a_plan_takes_the_survey_and_says_the_error_of_its_fit(rows: list[SurveyRow], tmp_path: Path) -> None:
    write_table(rows, tmp_path / "survey.csv")
    planner = Planner(scenario({"trace": str(tmp_path / "survey.csv")}, duration_s=30))
    (topic,) = planner.forecast().topics
    assert topic.result.pdr is not None
    assert topic.result.pdr < 0.99, "what was measured is lost in the forecast too"
    assert planner.survey is not None
    assert f"exponent {planner.survey.path_loss.exponent:.2f} ± " in planner.survey.words()
    half_m = planner.range_m(0.5)
    true_m = Planner(scenario(FAR, duration_s=30)).range_m(0.5)
    assert half_m == pytest.approx(true_m, rel=0.15)


def test_a_survey_in_which_the_snr_does_not_fall_tells_no_range(tmp_path: Path) -> None:
    write_table([row(float(x), snr_db=14.0) for x in range(2, 40)], tmp_path / "survey.csv")
    planner = Planner(scenario({"trace": str(tmp_path / "survey.csv")}, duration_s=30))
    assert range_words(planner).startswith("The link ends beyond 390 m, 10 times as far as the survey goes")


def row(x: float, **values: Any) -> SurveyRow:
    plain = {"t_s": x, "robot": 1, "x_m": x, "y_m": 0.0, "their_x_m": 0.0, "their_y_m": 0.0, "latitude": nan}
    rest = {"longitude": nan, "packets": 10.0, "lost": 0.0, "snr_db": nan, "rate_hz": 0.0, "age_s": nan}
    return SurveyRow(**{**plain, **rest, **values})  # type: ignore[arg-type]


def test_losses_count_where_the_phy_has_no_level(tmp_path: Path) -> None:
    """Nothing crosses from 30 m on; a radio that knows no SNR has measured it."""
    write_table([row(float(x), lost=90.0 if x >= 30 else 0.0) for x in range(1, 60)], tmp_path / "survey.csv")
    survey = Survey("survey", read_table(tmp_path / "survey.csv"))
    here = np.zeros(2)
    assert survey.loss_between(here, np.array([10.0, 0.0])) < 0.1
    assert survey.loss_between(here, np.array([45.0, 0.0])) == pytest.approx(0.9, abs=0.05)
    assert survey.loss_between(np.array([45.0, 0.0]), here) == pytest.approx(0.9, abs=0.05), "both ways alike"
    assert "by the line that fits, of which they differ by 12.3% rms, 96% at 59 m" in survey.words()
    chosen = scenario({"trace": str(tmp_path / "survey.csv")}, phy={"name": "direct"})
    ledger = run_scenario(chosen).result.topics[0]
    assert ledger.pdr is not None
    assert 0.1 < ledger.pdr < 0.95


@pytest.mark.parametrize("sent", [2, 40])
def test_losses_are_fitted_however_few_packets_a_place_has(sent: int) -> None:
    """A place of two packets that both arrived does not say that a fifth is lost there."""
    rng = np.random.default_rng(3)
    odds = {x: 12 - 0.8 * 10 * np.log10(x) for x in range(2, 60)}
    survey = Survey(
        "survey",
        (
            row(float(x), packets=float(sent - lost), lost=float(lost))
            for x, level in odds.items()
            for lost in rng.binomial(sent, 1 / (1 + np.exp(level)), 400 // sent)
        ),
    )
    assert survey.loss_line.slope == pytest.approx(-0.8, abs=3 * survey.loss_line.slope_error)
    assert survey.loss_line.slope_error < 0.05
    assert survey.loss_line.at(np.array([31.6])) == pytest.approx(0.0, abs=0.2)


@pytest.mark.parametrize("dead_m", [1, 30, 60])
def test_losses_that_know_no_half_way_have_a_line(dead_m: int) -> None:
    """All is lost from there on, and nothing before."""
    lost = {float(x): 10.0 * (x >= dead_m) for x in range(2, 60)}
    line = Survey("survey", [row(x, packets=10.0 - part, lost=part) for x, part in lost.items()]).loss_line
    assert np.isfinite([line.slope, line.at_1_m, line.slope_error]).all()
    assert line.rms < 0.1


def test_a_place_where_nothing_arrived_stays_dead() -> None:
    measured = [row(float(x), snr_db=40.0 - 20 * np.log10(x)) for x in range(1, 40) if abs(x - 20) > 3]
    survey = Survey("survey", [*measured, *(row(float(x), packets=0.0, lost=10.0) for x in range(17, 24))])
    at = survey.snr_between(np.zeros(2), np.array([[20.0, 0.0], [38.0, 0.0]]))
    assert at[0] < 0 < at[1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x_m,y_m,their_x_m,their_y_m,packets,lost\n1,2,0,0,5,nan\n", "line 2: lost = 'nan'"),
        ("x_m,y_m,their_x_m,their_y_m,packets,lost\n1,2,0,0,-5,0\n", "line 2: packets = -5: not within 0"),
        ("robot,x_m,y_m,their_x_m,their_y_m,packets,lost\n1e30,1,2,0,0,5,0\n", "line 2: robot = .* not within 0"),
        ("x_m,y_m,their_x_m,their_y_m,packets,lost\n1,-1e200,0,0,5,0\n", "line 2: y_m = .* not within"),
        ("x_m,y_m,their_x_m,their_y_m,packets,lost\n1,2,0,0,0,0\n", "counts no packet"),
        ("x_m,y_m,their_x_m,their_y_m,packets,lost\n1,2,0,0,9,0\n", "1 places from 2.2 to 2.2 m say no path loss"),
    ],
)
def test_a_survey_with_a_fault_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "survey.csv").write_text(text)
    with pytest.raises(ConfigError, match=said):
        run_scenario(scenario({"trace": str(tmp_path / "survey.csv")}, phy={"name": "direct"}))


def stats(packets: int, lost: int, *, robot: bool = True, snr_db: float | None = 12.0, uptime: float = 9.0) -> Any:
    peers = [{"robot": 4, "lost": lost, "snr_db": snr_db}] if robot else []
    sink = {"packets_of": {"4": packets}, "topics": {"/a": {"src_id": 4, "delivered": packets, "age_s": 0.2}}}
    return {"uptime_s": uptime, "peers": peers, "phy": {"snr_db": None}, "sink": sink}


def looked(*seen: Any) -> SurveyRecorder:
    recorder = SurveyRecorder()
    for now, one in enumerate(seen):
        recorder.here(Place(float(now), 10.0 * now, 0.0))
        recorder.look(one, float(now))
    return recorder


def test_what_was_lost_in_a_silence_counts_where_it_was_silent() -> None:
    recorder = looked(stats(0, 0), stats(10, 0), stats(10, 0), stats(10, 0), stats(20, 30))
    assert [(row.x_m, row.packets, row.lost) for row in recorder.finish()] == [
        *((10.0, 10, 0.0), (20.0, 0, 10.0), (30.0, 0, 10.0), (40.0, 10, 10.0))
    ]


def test_a_robot_that_was_forgotten_sent_as_before() -> None:
    silence = [stats(10, 0, robot=False)] * 4
    recorder = looked(stats(0, 0), stats(10, 0), *silence, stats(20, 0))
    assert [row.lost for row in recorder.finish()] == [0, 10, 10, 10, 10, 0]


def test_a_robot_that_never_comes_back_was_out_of_reach_too() -> None:
    recorder = looked(stats(0, 0), stats(10, 0), *[stats(10, 0)] * 5)
    assert [row.lost for row in recorder.finish()] == [0, 10, 10, 10, 10, 10]


def test_a_link_that_begins_anew_and_places_that_are_old_make_no_row() -> None:
    recorder = looked(stats(0, 0), stats(10, 0), stats(3, 0, uptime=0.5), stats(8, 0, uptime=1.5))
    assert [row.packets for row in recorder.rows] == [10, 5]
    recorder.look(stats(9, 0, uptime=9), 3.0 + STALE_S + 0.1)
    assert recorder.missed == {"no place": 0, "old place": 1}
    assert looked().rows == []


def test_rows_are_what_was_heard(tmp_path: Path) -> None:
    recorder = looked(stats(0, 0), stats(8, 2))
    (made,) = recorder.finish()
    assert (made.robot, made.snr_db, made.rate_hz, made.age_s, made.loss) == (4, 12.0, 8.0, 0.2, 0.2)
    assert (made.their_x_m, made.their_y_m) == (0.0, 0.0), "it stands where this one set out"
    write_table([replace(made, latitude=48.5, longitude=9.25)], tmp_path / "one.csv")
    assert read_table(tmp_path / "one.csv")[0].latitude == 48.5
