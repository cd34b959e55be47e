"""The report: one file that needs no network, made of the runs' own files."""

from __future__ import annotations

import re
import shutil
from base64 import b64decode
from html.parser import HTMLParser
from pathlib import Path

import pyarrow.csv as pa_csv
import pyarrow.parquet as pa_parquet
import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.report.headline import headline
from gr_ros2_lab.report.page import read_runs, write_report
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.lab.record.runs import IMU, ODOM, make_run

FIGURES = ("path", "latency", "ledger", "delivery", "age", "airtime", "packets")


class _Page(HTMLParser):
    """What a browser would load, and the tags that are open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "link", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_a_report_stands_alone(tmp_path: Path) -> None:
    make_run(tmp_path)
    before = set(tmp_path.iterdir())
    assert write_report(read_runs([tmp_path]), tmp_path) == [tmp_path / "report.html"]
    assert set(tmp_path.iterdir()) - before == {tmp_path / "report.html"}
    page, *others = write_report(read_runs([tmp_path]), tmp_path, pictures=True)
    assert page == tmp_path / "report.html"
    text = page.read_text()
    html = _Page(text)
    assert html.open == []
    assert len(html.sources) == len(FIGURES)
    assert all(source.startswith("data:image/") for source in html.sources)
    assert "<svg" in b64decode(html.sources[0].partition("base64,")[2]).decode()
    assert "url(" not in text
    assert "<script" not in text
    assert {path.name for path in others} == {
        *(f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")),
        *("summary.csv", "summary.parquet"),
    }
    assert all(path.stat().st_size for path in others)


@pytest.mark.usefixtures("undrawn")
def test_the_papers_numbers_stand_above_the_runs(tmp_path: Path) -> None:
    make_run(tmp_path)
    text = write_report(read_runs([tmp_path]), tmp_path)[0].read_text()
    cells = re.sub(r"<[^>]+>", " ", text[text.index("Table 6") : text.index("Delivery and latency")]).split()
    assert " ".join(cells).endswith(
        "OFDM the paper 38.0 1328 12 0.01 228.6 OFDM paper-ofdm 4.0 40 25 0.62 "
        f"{_goodput(tmp_path)} Direct the paper 15.0 452 452 1.00 21767.9"
    )
    assert "made &lt;by&gt; hand" in text
    assert "8 (16%) lost because a fragment did not arrive" in text


@pytest.mark.usefixtures("undrawn")
def test_other_scenarios_have_nothing_of_the_paper(tmp_path: Path) -> None:
    make_run(tmp_path, "demo")
    assert "of the paper" not in write_report(read_runs([tmp_path]), tmp_path)[0].read_text()


def _goodput(directory: Path) -> str:
    return f"{read_runs([directory])[0].result.topics[0].goodput_Bps:.1f}"


@pytest.mark.slow
def test_the_same_files_give_the_same_report(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    before = write_report([run], tmp_path / "a", pictures=True)
    after = write_report(read_runs([tmp_path / "run"]), tmp_path / "b", pictures=True)
    compared = set()
    for one, other in zip(before, after, strict=True):
        if one.suffix in (".png", ".csv", ".parquet"):
            assert one.read_bytes() == other.read_bytes(), one.name
            compared.add(one.suffix)
    assert compared == {".png", ".csv", ".parquet"}


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_several_runs_share_a_report(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "paper-ofdm")
    make_run(tmp_path / "b", "paper-direct")
    page, *others = write_report(read_runs([tmp_path / "a", tmp_path / "b"]), tmp_path / "out", pictures=True)
    names = {path.name for path in others}
    assert {"latency.svg", "paper-ofdm_latency.png", "paper-direct_ledger.svg"} <= names
    assert page.read_text().count("<h2>") == 2
    table = pa_parquet.read_table(tmp_path / "out" / "summary.parquet")
    assert table.column("run").to_pylist() == ["paper-ofdm"] * 2 + ["paper-direct"] * 2
    assert table.column("sent").to_pylist() == [ODOM, IMU] * 2
    assert table.column("ledger_too_large").to_pylist() == [2, 0] * 2
    assert pa_csv.read_csv(tmp_path / "out" / "summary.csv").column_names == table.column_names


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_runs_of_one_scenario_are_called_after_their_folders(tmp_path: Path) -> None:
    paths = [tmp_path / "x" / "one", tmp_path / "x" / "two", tmp_path / "y" / "one"]
    for path in paths:
        make_run(path)
    assert [run.label for run in read_runs(paths[:2])] == ["one", "two"]
    assert [run.label for run in read_runs(paths[1:])] == ["two", "one"]
    assert [run.label for run in read_runs(paths)] == [str(path) for path in paths]
    assert len(write_report(read_runs(paths), tmp_path / "out", pictures=True)) > 3 * 2 * len(FIGURES)


def test_what_is_no_run_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere: no such folder"):
        read_runs([tmp_path / "nowhere"])
    with pytest.raises(ConfigError, match=r"result\.json: no such file; give the folder of a run"):
        read_runs([tmp_path])
    make_run(tmp_path / "a")
    with pytest.raises(ConfigError, match="a: given twice"):
        read_runs([tmp_path / "a", tmp_path / "a" / ".." / "a"])


def test_files_of_two_runs_are_refused(tmp_path: Path) -> None:
    make_run(tmp_path / "a")
    text = (tmp_path / "a" / "result.json").read_text()
    (tmp_path / "a" / "result.json").write_text(text.replace("/robot_1/odom", "/robot_2/odom"))
    with pytest.raises(ConfigError, match=r"messages.parquet: /robot_2/odom has 0 messages, .* says 40 and 25"):
        read_runs([tmp_path / "a"])


@pytest.mark.usefixtures("undrawn")
def test_the_report_of_a_team_begins_as_its_run_ended_and_folds_what_is_long(tmp_path: Path) -> None:
    outcome = run_scenario(load_scenario("team", duration_s=2.0), tmp_path)
    text = write_report(read_runs([tmp_path]), tmp_path)[0].read_text()
    told = [re.sub(r"<[^>]+>", "", item) for item in re.findall(r"<li>.*?</li>", text)]
    first = headline(outcome.result, outcome.trace)
    assert [line.replace("&lt;", "<") for line in told[: len(first)]] == first
    assert len(set(told)) == len(told), "nothing is said twice"
    open_parts = re.sub(r"<details>.*?</details>", "", text, flags=re.DOTALL)
    assert "/robot_1/odom at /robot_2" in text
    assert open_parts.count("<tr>") < 40
    assert "At /robot_1, of what it could hear" in open_parts


@pytest.mark.usefixtures("undrawn")
def test_what_the_sources_graph_lost_is_in_every_part(tmp_path: Path) -> None:
    make_run(tmp_path, missed=51)
    page, *_ = write_report(read_runs([tmp_path]), tmp_path, pictures=True)
    assert "lost by the ROS graph of the source" in page.read_text()
    summary = pa_csv.read_csv(tmp_path / "summary.csv").to_pylist()[0]
    assert (summary["sent"], summary["ledger_lost_on_graph"]) == (ODOM + 51, 51)


@pytest.mark.usefixtures("undrawn")
def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    run = make_run(tmp_path / "a")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        write_report([run], tmp_path / "file")


@pytest.mark.usefixtures("undrawn")
def test_the_run_folder_can_be_moved(tmp_path: Path) -> None:
    make_run(tmp_path / "a")
    shutil.move(tmp_path / "a", tmp_path / "b")
    assert write_report(read_runs([tmp_path / "b"]), tmp_path / "b")[0].is_file()
