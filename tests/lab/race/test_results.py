from __future__ import annotations

import json
from pathlib import Path

import pyarrow.csv
import pyarrow.parquet

from gr_ros2.core.errors import RunError
from gr_ros2_lab.race.contenders import CONTENDERS
from gr_ros2_lab.race.race_settings import RaceRecording, RaceSettings
from gr_ros2_lab.race.results import WON, ahead_of_ours, notes, race_figures, race_grid, race_markdown, write_race
from gr_ros2_lab.race.runner import Race
from tests.lab.race.support import cell

RECORDING = RaceRecording(Path("bag"), "/talk", "std_msgs/msg/String", (b"\0\1\0\0aaaa", b"\0\1\0\0bbbb"), (0.0, 0.1))


def race(*cells: object, **more: object) -> Race:
    return Race(RaceSettings(), RECORDING, list(cells), **more)  # type: ignore[arg-type]


def test_the_table_has_a_section_per_condition_and_a_star_for_who_won() -> None:
    grid = race_grid(race(cell("gr-ros2", pdr=0.9), cell("zenoh-tcp", pdr=1.0), cell("gr-ros2", loss=0.2)))
    assert [len(section) for section in grid.sections] == [2, 1]
    ours, theirs = grid.sections[0]
    assert ours[:4] == ("200%", "5%", "gr-ros2", "0.900 ")
    assert theirs[:4] == ("200%", "5%", "zenoh-tcp", f"1.000{WON}")


def test_everything_is_written_and_can_be_read_again(tmp_path: Path) -> None:
    cells = [cell(name, age_p95=0.04, drops={"on_air": number}) for number, name in enumerate(CONTENDERS)]
    written = write_race(race(*cells, cell("gr-ros2", load=0.5, age_mean=None)), tmp_path / "out")
    pictures = ["race-arrived", "race-age", "race-air", "race-first"]
    names = ["race.json", "race.md", "race.csv", "race.parquet"]
    names += [f"{picture}.{kind}" for picture in pictures for kind in ("png", "svg")]
    assert [path.name for path in written] == names
    assert all(path.stat().st_size for path in written)
    values = json.loads(written[0].read_text("utf-8"))
    assert [each["contender"] for each in values["cells"]] == [*CONTENDERS, "gr-ros2"]
    assert values["winners"][0]["discovery_bytes"] == list(CONTENDERS)
    assert values["recording"]["messages"] == 2
    assert values["settings"]["loss"] == [0.0, 0.05, 0.2, 0.4]
    table = pyarrow.parquet.read_table(written[3])
    assert table.column("dropped_on_air").to_pylist() == [*range(len(CONTENDERS)), 0]
    assert pyarrow.csv.read_csv(written[2]).num_rows == table.num_rows == len(cells) + 1


def test_who_is_ahead_of_ours_is_told_by_the_numbers() -> None:
    found = race(
        cell("gr-ros2", pdr=1.0, latency_p99=0.04),
        cell("zenoh-udp", pdr=0.8, latency_p99=0.015, air_bytes_per_message=70.4),
        cell("zenoh-tcp", pdr=0.99996, latency_p99=None),
        cell("gr-ros2", loss=0.2, latency_p99=None),
        cell("zenoh-tcp", loss=0.2),
        cell("zenoh-tcp", loss=0.4),
    )
    assert ahead_of_ours(found) == [
        "load 200%, loss 5%: ahead of gr-ros2: latency p99 [ms] (zenoh-udp)",
        "load 200%, loss 20%: ahead of gr-ros2: latency p99 [ms] (zenoh-tcp)",
    ]
    lines = race_markdown(found).splitlines()
    assert lines[2].startswith("| 200% | 5% | `gr-ros2` | **1.000** | **10.0** | 40.0 |")
    assert lines[-1] == "- " + ahead_of_ours(found)[-1]


def test_what_a_reader_must_not_miss_is_said() -> None:
    lines = notes(race(cell("zenoh-udp", matched=False, altered=2, busy=2.5), error=RunError("x")))
    assert "load 200% is 100,000 samples/s" in lines[0]
    assert any("zenoh-udp, load 200%, loss 5%: the ends did not find each other" in line for line in lines)
    assert any("2 messages arrived altered" in line for line in lines)
    assert any("up to 2.5 programs per processor" in line for line in lines)
    assert lines[-1] == "stopped before all cells were run"


def test_a_row_has_the_pictures_of_its_questions() -> None:
    cells = [cell("gr-ros2", row="outage-5", fresh_after=0.1, lost=0), cell("zenoh-tcp", row="outage-5", lost=7)]
    figures = race_figures(cells)
    assert {"fresh", "lost"} <= set(figures)
    assert "heard" not in figures
    (panel,) = figures["lost"].axes
    assert [label.get_text() for label in panel.get_yticklabels()] == ["zenoh-tcp", "gr-ros2"]  # the best on top
    (fresh,) = figures["fresh"].axes
    assert len(fresh.patches) == 1
    assert {text.get_text() for text in fresh.texts} == {"0.10", "never"}
