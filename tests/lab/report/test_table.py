"""The tables a person reads."""

from __future__ import annotations

import io
from dataclasses import replace

from rich.console import Console

from gr_ros2.observe.result import AgeResult, LatencyResult
from gr_ros2_lab.record.result import ReceiverResult, Result
from gr_ros2_lab.report.table import (
    MOST_PATHS,
    Grid,
    as_table,
    faults,
    ledger_grid,
    notes,
    pairs_grids,
    paper_grid,
    summary_grid,
)


def _text(grid: Grid, width: int = 140) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(as_table(grid))
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


def test_the_papers_table_with_latency(result: Result) -> None:
    lines = _text(summary_grid([result])).splitlines()
    heading = " ".join(lines[2].split() + lines[3].split())
    for name in ("Topic", "Sent", "Recv", "PDR", "Goodput", "[B/s]", "p50", "p99", "[ms]"):
        assert name in heading
    odom = next(line for line in lines if "odom" in line).split()
    assert odom == ["/robot_1/odom", "10", "9", "0.90", "123.5", "100", "200", "300"]
    lines = _text(summary_grid([result, replace(result, scenario="again")])).splitlines()
    assert " ".join(lines[3].split()).startswith("Config Topic [s] Sent Recv")
    assert [next(line for line in lines if name in line).split()[2] for name in ("paper-direct", "again")] == [
        "15.0"
    ] * 2
    assert next(line for line in lines if "imu" in line).split()[-3:] == ["–", "–", "–"]


def test_latencies_keep_three_digits(result: Result) -> None:
    quick = replace(result, topics=(replace(result.topics[0], latency_s=LatencyResult(0.00123456, 0.0567, 1.234)),))
    assert next(line for line in _text(summary_grid([quick])).splitlines() if "odom" in line).split()[-3:] == [
        *("1.23", "56.7", "1234"),
    ]


def test_nothing_is_cut_off_in_80_columns(result: Result) -> None:
    assert "…" not in _text(summary_grid([result]), width=80)


def test_the_ledger_shows_every_row_that_occurred(result: Result) -> None:
    text = _text(ledger_grid(result))
    assert "lost_fragments" in text
    assert "expired" not in text
    assert next(line for line in text.splitlines() if "odom" in line).split() == ["/robot_1/odom", "10", "9", "1"]


def test_notes_say_what_must_not_be_missed(result: Result) -> None:
    assert len(notes(result)) == 1
    assert "deviates from the sent path by 0.010 m" in notes(result)[0]
    bad = replace(result, topics=(replace(result.topics[0], corrupt=2),), interrupted=True)
    assert "2 messages arrived altered" in faults(bad)[0]
    assert "stopped after 15.0 s" in faults(bad)[-1]
    deaf = replace(result, counters={"sink": {"no_table": [1]}, "robots": [{"sink": {"no_table": [1, 3]}}]})
    said = [line for line in notes(deaf) if "no table of topics" in line]
    assert [line.split(" arrived")[0][-7:] for line in said] == ["robot 1", "robot 3"]
    assert "set repair: auto" in said[0]


def team(result: Result, count: int) -> Result:
    """Every robot hears what every other one sends; all of robot 1's is lost, and half of a percent of the others'."""
    odom = result.topics[0]
    came = {n: 199 if n > 1 else 0 for n in range(1, count + 1)}
    sent = [
        replace(
            odom,
            topic=f"/robot_{n}/odom",
            src_id=n,
            sent=200,
            delivered=delivered,
            pdr=delivered / 200,
            ledger={"delivered": delivered, "given_up": 200 - delivered},
            age_s=AgeResult(0.123 * n, 2.5),
        )
        for n, delivered in came.items()
    ]
    ends = [tuple(topic for topic in sent if topic.src_id != n) for n in range(1, count + 1)]
    receivers = (ReceiverResult(n, topics, f"/robot_{n}") for n, topics in enumerate(ends[1:], 2))
    return replace(result, topics=ends[0], receivers=tuple(receivers), config={"robots": [{"robot": "/robot_1"}]})


def test_twenty_robots_are_two_matrices_that_can_be_read(result: Result) -> None:
    lost, age = pairs_grids(team(result, 20))
    assert [len(lines) for grid in (lost, age) for lines in grid.sections] == [20, 20]
    assert lost.sections[0][1][:4] == ("/robot_2", "100", "", "<1")
    assert age.sections[0][1][:4] == ("/robot_2", ".12", "", ".37")
    assert age.sections[0][0][-1] == "2.5"
    text = _text(lost, width=110) + _text(age, width=110)
    assert "…" not in text
    assert pairs_grids(result) == []


def test_many_paths_have_one_line(result: Result) -> None:
    many = team(result, MOST_PATHS + 3)
    far = replace(many, topics=(*many.topics[:-1], replace(many.topics[-1], rms_error_m=9.5)))
    (line,) = (line for line in notes(far) if "path" in line)
    assert line.startswith(f"Of {MOST_PATHS + 2} received paths, that of /robot_{MOST_PATHS + 3}/odom is furthest")
    assert line.endswith("9.500 m (RMS).")


def test_the_papers_own_line_stands_above_ours(result: Result) -> None:
    text = _text(paper_grid([result, replace(result, scenario="x", phy={"name": "ofdm"})]))
    lines = [line.split() for line in text.splitlines()]
    assert [line for line in lines if line and line[0] in ("OFDM", "Direct")] == [
        ["OFDM", "the", "paper", "38.0", "1328", "12", "0.01", "228.6"],
        ["OFDM", "x", "15.0", "10", "9", "0.90", "123.5"],
        ["Direct", "the", "paper", "15.0", "452", "452", "1.00", "21767.9"],
        ["Direct", "paper-direct", "15.0", "10", "9", "0.90", "123.5"],
    ]
