"""Why a run came out as it did."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gr_ros2.link.ledger_rows import ROWS, LedgerRow
from gr_ros2.record.result import LatenessResult, air_uses
from gr_ros2.report.explain import explanation
from gr_ros2.report.page import read_runs, write_report
from gr_ros2.report.table import air_grid
from gr_ros2.run.runner import run_scenario
from gr_ros2.run.scenario import load_scenario
from tests.record.results import RESULT
from tests.record.runs import empty_trace, make_run


def test_sentences_are_computed_from_the_run(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    outcome, capacity, packets, fragments, in_flight, trend = explanation(run.result, run.trace)
    assert outcome == (
        "Of 49 messages sent: 33 (67%) delivered, 8 (16%) lost because a fragment did not arrive, "
        "2 (4%) too large for the packet length, 6 (12%) still in flight at the end."
    )
    assert "10.0 ms of air, so the link carries at most 100.0 packets/s" in capacity
    # 38 messages of two fragments and 9 of one share packets as those did that left: 83 entries in 74 packets
    assert f"come to {(38 * 2 + 9) * 74 / 83 / 4:.1f} packets/s: 19% of what the link has" in capacity
    assert packets.startswith("Of 74 packets that left the source, 58 (78%) reached the sink intact, 8 were lost")
    assert "8 had not come out of the PHY by the end; those that arrived took 14% of the air" in packets
    assert "of 41 messages that left whole 33 (80%) arrived complete" in fragments
    assert "5 had left the source whole and waited in the PHY or on the air, 0 had left in part, and 1 had" in in_flight
    assert trend.endswith("it stayed the same.")


def test_what_the_sources_graph_lost_is_told(tmp_path: Path) -> None:
    run = make_run(tmp_path, missed=51)
    assert explanation(run.result, run.trace)[0].startswith("Of 100 messages sent: 33 (33%) delivered, ")
    assert (
        "51 (51%) lost by the ROS graph of the source before the link had them" in explanation(run.result, run.trace)[0]
    )


def test_an_overloaded_link_is_told_by_how_much(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    slow = replace(run.result, phy={**run.result.phy, "airtime_s": 0.5, "airtime_mean_s": 0.5})
    assert f"{(38 * 2 + 9) * 74 / 83 / 4 * 0.5:.1f} times what the link has" in explanation(slow, run.trace)[1]


@pytest.mark.parametrize("airtime", [None, 0.0])
def test_without_airtime_nothing_is_said_of_the_air(tmp_path: Path, airtime: float | None) -> None:
    run = make_run(tmp_path)
    text = " ".join(explanation(replace(run.result, phy={"name": "direct", "airtime_s": airtime}), run.trace))
    assert "air," not in text.replace("on the air,", "")
    assert "took" not in text


def test_as_fast_as_the_flowgraph_runs_the_clock_says_nothing_of_the_air(tmp_path: Path) -> None:
    run = make_run(tmp_path, paced=False)
    assert "packets/s" not in " ".join(explanation(run.result, run.trace))


LATE = LatenessResult({"threads": 0.24, "gate": 0.06, "modem": 0.012}, 3, 0.045, 16, 5, 200, 20)


def test_a_computer_that_was_late_is_named(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    late = replace(run.result, lateness=LATE)
    assert explanation(late, run.trace)[-1] == (
        "The computer was up to 240 ms late (threads; gate 60.0 ms, modem 12.0 ms), 3 times by 50.0 ms or more, 4% of "
        "the run; 31% of the losses follow such moments, as do 10% of all messages."
    )
    without = replace(late, lateness=replace(LATE, lost=0, lost_after=0, worst_s={"threads": 0.24}))
    assert explanation(without, run.trace)[-1] == (
        "The computer was up to 240 ms late (threads), 3 times by 50.0 ms or more, 4% of the run."
    )


def test_nothing_is_said_of_a_computer_that_kept_up(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    in_time = replace(run.result, lateness=replace(LATE, moments=0, share=0.0))
    assert explanation(in_time, run.trace) == explanation(run.result, run.trace)


def test_nothing_sent() -> None:
    assert explanation(replace(RESULT, topics=()), empty_trace()) == ["No message was sent."]


def test_every_row_of_the_ledger_is_said_in_words(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    everything = replace(run.result.topics[0], ledger=dict.fromkeys(ROWS, 1), sent=len(ROWS))
    outcome, *_ = explanation(replace(run.result, topics=(everything,)), run.trace)
    assert all(row.words in outcome for row in LedgerRow)


def test_what_repair_did_is_told_and_tabulated(tmp_path: Path) -> None:
    out = tmp_path / "repaired"
    settings = ["version=1", "reports={}", "channel.packet_loss=0.2", "time=packets"]
    outcome = run_scenario(load_scenario("paper-ofdm-paced", settings, duration_s=4.0), out)
    result = outcome.result
    (odom,), packets = result.topics, result.packets
    repair, air = explanation(result, outcome.trace)[-2:]
    assert repair.startswith(f"Repair recovered {odom.ledger['repaired']:,} messages (")
    assert repair.endswith(f"{odom.ledger.get('given_up', 0):,} were given up.")
    assert f" {packets['air_new']:,} for new messages (" in air
    assert f" {packets['air_repair']:,} for repair (" in air
    assert f"{packets['sent'] / odom.delivered:.2f} packets for each message delivered" in air
    uses = {use.kind: use for use in air_uses(result)}
    assert sum(use.share for use in uses.values()) == pytest.approx(1)
    grid = air_grid(result)
    assert grid is not None
    assert [line[0] for line in grid.sections[0]] == ["new", "repair", "report", "hello"]
    page = write_report(read_runs([out]), out)[0].read_text()
    assert "What the air was used for" in page
    assert (out / "air.png").is_file()


def test_version_0_has_nothing_to_tell_of_repair(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    assert air_uses(run.result) == []
    assert air_grid(run.result) is None
    assert "epair" not in " ".join(explanation(run.result, run.trace))
