"""The report of one or several runs: one HTML file that needs no network, its figures as PNG and SVG, and a table of
all numbers as CSV and Parquet.

Invariant: everything comes from the runs' own files (`result.json` and the tables of ``record.trace``), so a
report can be made again at any time; files that contradict each other are refused.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pa_parquet
import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from gr_ros2 import __version__
from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import write_text, write_whole
from gr_ros2.link.fates import Fate
from gr_ros2_lab.record.repetitions import run_folders
from gr_ros2_lab.record.result import RESULT_FILE, Result, air_uses, read_result, topic_numbers
from gr_ros2_lab.record.team import Team, read_team
from gr_ros2_lab.record.trace import Messages, Trace, read_trace, write_csv
from gr_ros2_lab.report.explain import explanation
from gr_ros2_lab.report.figures import air_figure, latency_figure, ledger_figure, path_figure, save_figure
from gr_ros2_lab.report.headline import headline
from gr_ros2_lab.report.snr_map import map_of
from gr_ros2_lab.report.table import (
    MOST_PATHS,
    PAPER,
    Grid,
    air_grid,
    ends,
    hops_grid,
    ledger_grid,
    notes,
    pairs_grids,
    paper_grid,
    paper_results,
    summary_grid,
    team_grid,
)
from gr_ros2_lab.report.team_figures import belief_figure, hearing_figure, strip_figure
from gr_ros2_lab.report.timelines import Deliveries, age_figure, airtime_figure, delivery_figure, packets_figure

REPORT_FILE = "report.html"
SUMMARY = "summary"
"""File name, without suffix, of the table with one line per run and topic."""

_TEMPLATES = Path(__file__).resolve().parent / "templates"
_LARGEST_SVG = 1_000_000
"""Bytes. A larger drawing is embedded in the HTML as PNG."""


@dataclass(frozen=True)
class Run:
    """One run: its folder, its name in the report, and its files."""

    directory: Path
    label: str
    result: Result
    trace: Trace

    def messages(self) -> list[Messages]:
        """The messages of every topic on which something was sent, in the order of the result."""
        order = {(topic.topic, topic.src_id): place for place, topic in enumerate(self.result.topics)}
        return sorted(self.trace.messages(), key=lambda m: order.get((m.topic, m.src_id), len(order)))


@dataclass(frozen=True)
class Picture:
    """A figure that was written.

    :param files: one, or a PNG and an SVG
    """

    caption: str
    files: Sequence[Path]
    wide: bool = False

    def data_uri(self) -> str:
        """The picture itself as a data URI, for embedding in HTML."""
        svg = self.files[-1]
        path = svg if svg.stat().st_size <= _LARGEST_SVG else self.files[0]
        kind = "svg+xml" if path.suffix == ".svg" else "png"
        return f"data:image/{kind};base64,{b64encode(path.read_bytes()).decode('ascii')}"


@dataclass(frozen=True)
class Drawings:
    """Where the figures of a page are written.

    :param kept: write each as PNG and SVG; otherwise only the one that the page embeds
    """

    folder: Path
    kept: bool = True

    def save(self, figure: Figure, name: str, caption: str, wide: bool = False) -> Picture:
        """Write a figure.

        :raises ConfigError: when it cannot be written
        """
        files = save_figure(figure, self.folder, name, largest_svg=0 if self.kept else _LARGEST_SVG)
        return Picture(caption, files, wide)


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    heading: str = ""
    lead: str = ""
    sentences: Sequence[str] = ()
    grids: Sequence[Grid] = ()
    pictures: Sequence[Picture] = ()
    details: Mapping[str, str | Grid] = field(default_factory=dict)


def read_runs(directories: Iterable[str | Path]) -> list[Run]:
    """Read run folders. A folder with repetitions stands for the folders of its repetitions. The label of a run is its
    scenario, or its folder where the scenario is ambiguous.

    :raises ConfigError: when a folder is missing, or one of its files is missing, damaged or half-written; names it
    """
    paths = [folder for directory in directories for folder in run_folders(Path(directory))]
    found = []
    for path in paths:
        if not (path / RESULT_FILE).exists():
            what = f"{path / RESULT_FILE}: no such file" if path.is_dir() else f"{path}: no such folder"
            raise ConfigError(f"{what}; give the folder of a run, with {RESULT_FILE} in it")
        found.append((path, read_result(path), read_trace(path)))
    twice = [str(path) for path in paths if sum(path.resolve() == other.resolve() for other in paths) > 1]
    if twice:
        raise ConfigError(f"{twice[0]}: given twice; give each run once")
    labels = _labels([(path, result.scenario) for path, result, _ in found])
    runs = [Run(path, label, result, trace) for (path, result, trace), label in zip(found, labels, strict=True)]
    for run in runs:
        _check(run)
    return runs


def write_report(runs: Sequence[Run], out: Path, *, pictures: bool = False) -> list[Path]:
    """Write ``report.html``, which has everything in it; of several runs also the table of all numbers.

    :param out: folder, made if missing; it may be the folder of a single run itself
    :param pictures: write the figures as PNG and SVG and the table of all numbers beside it
    :return: the files written, the report first
    :raises ConfigError: when they cannot be written
    """
    several = len(runs) > 1
    with drawing(out, pictures) as drawn:
        return _write_report(runs, out, drawn, several or pictures)


def _write_report(runs: Sequence[Run], out: Path, drawn: Drawings, tables: bool) -> list[Path]:
    several = len(runs) > 1
    results = [replace(run.result, scenario=run.label) for run in runs]
    joint = [drawn.save(latency_figure(latencies(runs)), "latency", _LATENCY)] if several else []
    papers = [paper_grid(results)] if paper_results([run.result for run in runs]) else []
    few = [result for result in results if several and not pairs_grids(result)]
    sections = [Section(grids=[*papers, *([summary_grid(few)] if few else ())], pictures=joint)] if several else []
    for run in runs:
        sections += _run_sections(run, drawn, f"{stem(run.label)}_" if several else "", papers, several)
    title = ", ".join(run.label for run in runs)
    lead = f"{len(runs)} runs" if several else lead_of(runs[0])
    return render_page(out / REPORT_FILE, title, lead, sections, write_summary(runs, out) if tables else [])


@contextmanager
def drawing(out: Path, pictures: bool) -> Iterator[Drawings]:
    """The figures of a page: in the page's own folder, or in one that is removed when the page is written.

    :param pictures: whether the figures stay
    """
    if pictures:
        yield Drawings(out)
        return
    with TemporaryDirectory(prefix="gr-ros2-") as folder:
        yield Drawings(Path(folder), kept=False)


def render_page(path: Path, title: str, lead: str, sections: Sequence[Section], tables: Sequence[Path]) -> list[Path]:
    """Write an HTML page with its pictures inside.

    :param tables: files with the numbers, already written to the same folder
    :return: all files of the page, the page first
    :raises ConfigError: when it cannot be written
    """
    environment = Environment(loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    text = environment.get_template("report.html.j2").render(
        title=title,
        lead=lead,
        sections=sections,
        paper=PAPER,
        version=__version__,
        files=f"Beside it: {', '.join(table.name for table in tables)} with every number." if tables else "",
    )
    write_whole(path, text, write_text)
    pictures = [file for section in sections for picture in section.pictures for file in picture.files]
    return [path, *tables, *(file for file in pictures if file.parent == path.parent)]


def latencies(runs: Sequence[Run]) -> dict[str, Sequence[float]]:
    """Every latency, s, by the name of its curve: the run, the topic, or both, as needed to distinguish the curves."""
    curves = {}
    for run in runs:
        topics = run.messages()
        for m in topics:
            name = m.topic if len(runs) == 1 else run.label if len(topics) == 1 else f"{run.label} {m.topic}"
            curves[name] = (m.t_delivered - m.t_sent)[m.delivered]
    return curves  # type: ignore[return-value]  # arrays are used as sequences


def stem(label: str) -> str:
    """A label as part of a file name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", label).strip("_.") or "run"


def lead_of(run: Run) -> str:
    """A description of the run in one line."""
    result = run.result
    parts = [
        str(result.config.get("description") or result.scenario),
        f"{result.duration_s:.1f} s",
        f"seed {result.seed}",
    ]
    rate = result.phy.get("sample_rate")
    parts.append(f"PHY {result.phy.get('name')}" + (f" at {rate:,.0f} samples/s" if rate else ""))
    if result.interrupted:
        parts.append("stopped before its end")
    return " · ".join(parts)


_LATENCY = "End-to-end latency: share of the delivered messages that took at most so long"


def _run_sections(run: Run, out: Drawings, prefix: str, papers: list[Grid], several: bool) -> Iterator[Section]:
    """What came of a run in few lines, why, and what its first receiver got.

    :param papers: the paper's table, which a page of several runs has above
    """
    result, pairs = run.result, pairs_grids(run.result)
    first = headline(result, run.trace)
    summary, ledger = summary_grid([result]), ledger_grid(result)
    topics = pairs or ([ledger] if several else [*papers, summary, ledger])
    yield Section(run.label if several else "", lead_of(run) if several else "", first, topics)
    settings = {
        "All settings": yaml.safe_dump(result.config, sort_keys=False, allow_unicode=True),
        "All counters": yaml.safe_dump(
            {"packets": result.packets, "phy": result.phy, **result.counters}, sort_keys=False, allow_unicode=True
        ),
    }
    more = [line for line in (*explanation(result, run.trace), *notes(result)) if line not in first]
    grids = [grid for grid in (team_grid(result), hops_grid(result)) if grid is not None]
    used = [grid for grid in (air_grid(result),) if grid is not None]
    happened = Section("" if several else "What happened", "", more, grids, _draw(run, out, prefix))
    received = _draw_received(run, out, prefix)
    if not result.receivers:
        yield replace(happened, grids=grids + used, pictures=[*happened.pictures, *received], details=settings)
        return
    every = {f"{grid.title}, of all robots": grid for grid in (summary, ledger) if pairs}
    yield replace(happened, details=every)
    at = f"At {next(ends(result))[0]}, of what it could hear"
    yield Section(f"{run.label}: {at}" if several else at, grids=used, pictures=received, details=settings)


def _draw(run: Run, out: Drawings, prefix: str) -> list[Picture]:
    """Where the robots were, and what happened on their channel."""
    pictures = []
    paths = list(run.trace.paths())
    for place, path in enumerate(paths if len(paths) <= MOST_PATHS else ()):  # those of a team are in one figure
        figure = path_figure(path.sent, path.received, path.topic, path.published_as)
        stem = "path" if not place else f"path{path.topic.replace('/', '_')}"
        caption = f"The path of {path.topic}, sent and received"
        pictures.append(out.save(figure, prefix + stem, caption))
    if (world := map_of(run.result)) is not None:
        caption = "SNR over the world for a receiver that stands still; white: obstacles; lines: where the robots drove"
        pictures.append(out.save(world, f"{prefix}snr-map", caption))
    if (team := read_team(run.directory)) is not None:
        pictures += _draw_team(team, out, prefix)
    return pictures


def _draw_received(run: Run, out: Drawings, prefix: str) -> list[Picture]:
    """What the first receiver got."""
    result, trace = run.result, run.trace
    topics = run.messages()
    packets, changes = trace.packets(), [change.t for change in result.changes if change.t is not None]
    drawn = [
        ("latency", latency_figure(latencies([run])), _LATENCY),
        (
            "delivery",
            delivery_figure({m.topic: Deliveries.of([m]) for m in topics}, result.duration_s, changes),
            "Share delivered of the messages submitted in an interval, and bytes delivered in it",
        ),
        (
            "age",
            age_figure({m.topic: {run.label: m} for m in topics}, {run.label: trace.t_end}, changes),
            "Age of what the receiving robot knows: now minus the submission of the newest message delivered",
        ),
    ]
    if airtime := result.phy.get("airtime_mean_s") or result.phy.get("airtime_s"):
        figure = airtime_figure(packets, airtime / result.phy.get("channels", 1), result.duration_s, changes)
        caption = "Airtime of the packets that left the source and of those that arrived, without repairs and reports"
        drawn.append(("airtime", figure, caption))
    figure = ledger_figure({topic.topic: topic.ledger for topic in result.topics})
    caption = "The loss ledger: every sent message has exactly one fate; in brackets how many were sent"
    drawn.append(("ledger", figure, caption))
    if uses := air_uses(result):
        drawn.append(("air", air_figure(uses), "What the packets sent were for, as shares of their airtime"))
    caption = (
        "The first packets with new messages: which topics' entries each carries (every other message lighter), when "
        "it left, and when or whether it arrived"
    )
    drawn.append(("packets", packets_figure(packets, [m.topic for m in topics]), caption))
    return [out.save(figure, prefix + name, caption, name == "packets") for name, figure, caption in drawn]


def _draw_team(team: Team, out: Drawings, prefix: str) -> list[Picture]:
    """What robots on one channel saw."""
    drawn = {
        "slots": (
            strip_figure(team),
            "The channel while the robots enter, and at the end: who sent, and what became of it",
        ),
        "hearing": (hearing_figure(team), "SNR with which each robot hears the others"),
        "beliefs": (belief_figure(team), "Where each robot drove, and where the others believed it to be"),
    }
    return [out.save(figure, f"{prefix}{name}", caption, name == "slots") for name, (figure, caption) in drawn.items()]


def write_summary(runs: Sequence[Run], out: Path) -> list[Path]:
    """One line per run and topic with every number of ``result.json``, as CSV and Parquet."""
    lines: list[dict[str, Any]] = []
    fates = sorted({fate for run in runs for topic in run.result.topics for fate in topic.ledger})
    for run in runs:
        result = run.result
        for topic in result.topics:
            lines.append(
                {
                    **{"run": run.label, "scenario": result.scenario, "seed": result.seed},
                    **{
                        "duration_s": result.duration_s,
                        "interrupted": result.interrupted,
                        "phy": result.phy.get("name"),
                    },
                    **topic_numbers(topic, fates),
                }
            )
    table = pa.Table.from_pylist(lines)
    return [
        write_whole(out / f"{SUMMARY}.csv", table, write_csv),
        write_whole(out / f"{SUMMARY}.parquet", table, pa_parquet.write_table),
    ]


def _check(run: Run) -> None:
    counts: dict[tuple[str, int], Messages] = {(m.topic, m.src_id): m for m in run.trace.messages()}
    for topic in run.result.topics:
        messages = counts.get((topic.topic, topic.src_id))
        sent, delivered = (len(messages.serial), int(messages.delivered.sum())) if messages is not None else (0, 0)
        # Messages that were lost before the link are only counted. They are not in the trace.
        submitted = topic.sent - topic.ledger.get(Fate.LOST_ON_GRAPH, 0)
        if (sent, delivered) != (submitted, topic.delivered):
            raise ConfigError(
                f"{run.directory / 'messages.parquet'}: {topic.topic} has {sent} messages, {delivered} delivered, but "
                f"result.json says {submitted} and {topic.delivered}: not of the same run"
            )


def _labels(runs: Sequence[tuple[Path, str]]) -> list[str]:
    scenarios = [scenario for _, scenario in runs]
    if len(set(scenarios)) == len(runs):
        return scenarios
    names = [path.resolve().name for path, _ in runs]
    return names if len(set(names)) == len(runs) else [str(path) for path, _ in runs]
