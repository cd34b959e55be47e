"""Why a run came out as it did."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gr_ros2.link.fates import FATES, Fate
from gr_ros2_lab.record.result import ChangeResult, LatenessResult, air_uses, read_result, write_result
from gr_ros2_lab.report.explain import explanation
from gr_ros2_lab.report.headline import headline
from gr_ros2_lab.report.page import read_runs, write_report
from gr_ros2_lab.report.table import air_grid
from gr_ros2_lab.report.timelines import Deliveries, delivery_figure
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.lab.record.results import RESULT
from tests.lab.record.runs import empty_trace, make_run


def test_sentences_are_computed_from_the_run(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    outcome, air, packets, fragments, in_flight = explanation(run.result, run.trace)
    assert outcome == (
        "Of 49 messages sent: 33 (67%) delivered, 8 (16%) lost because a fragment did not arrive, "
        "2 (4%) too large for the packet length, 6 (12%) still in flight at the end."
    )
    # 74 packets of 10 ms; the last of them left 3.62 s after the first
    assert air == f"Air in use: {0.74 / 3.63:.0%} of the time, with new messages."
    assert packets == (
        "Of 74 packets with messages, 58 (78%) arrived, 8 lost on the way, "
        "8 left after the last that arrived (lost, or in the PHY at the end)."
    )
    assert "of 41 messages that left whole 33 (80%) arrived complete" in fragments
    assert in_flight == (
        "Of the messages in flight at the end, 5 had left the source whole and waited in the PHY or on the air, "
        "1 had not left the source's queue."
    )


def test_what_the_sources_graph_lost_is_told(tmp_path: Path) -> None:
    run = make_run(tmp_path, missed=51)
    assert explanation(run.result, run.trace)[0].startswith("Of 100 messages sent: 33 (33%) delivered, ")
    assert (
        "51 (51%) lost by the ROS graph of the source before the link had them" in explanation(run.result, run.trace)[0]
    )


def test_an_overloaded_link_is_told_by_how_much(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    slow = replace(run.result, phy={**run.result.phy, "airtime_s": 0.5, "airtime_mean_s": 0.5})
    # 38 messages of two fragments and 9 of one share packets as those did that left: 83 entries in 74 packets
    assert explanation(slow, run.trace)[2] == (
        "The messages do not fit: all of them would have needed "
        f"{(38 * 2 + 9) * 74 / 83 / 4 * 0.5:.1f} times the air that there is."
    )


def test_what_was_changed_meanwhile_is_told_and_drawn(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    drawn = [ChangeResult(1.2 + place / 100, "channel.snr_db", 20.0 - place) for place in range(9)]
    changed = replace(run.result, changes=(*drawn, ChangeResult(2.5, "transmit", False)))
    line = "Changed while it ran: channel.snr_db to 12 at 1.3 s, transmit to off at 2.5 s."
    assert line in explanation(changed, run.trace)
    assert line in headline(changed, run.trace)
    assert read_result(write_result(changed, tmp_path / "changed.json")).changes == changed.changes
    messages = {m.topic: Deliveries.of([m]) for m in run.messages()}
    figure = delivery_figure(messages, 4.0, [change.t for change in changed.changes if change.t is not None])
    assert [len(axes.lines) for axes in figure.axes] == [
        len(axes.lines) + 10 for axes in delivery_figure(messages, 4.0).axes
    ]


@pytest.mark.parametrize("airtime", [None, 0.0])
def test_without_airtime_nothing_is_said_of_the_air(tmp_path: Path, airtime: float | None) -> None:
    run = make_run(tmp_path)
    text = " ".join(explanation(replace(run.result, phy={"name": "direct", "airtime_s": airtime}), run.trace))
    assert "air," not in text.replace("on the air,", "")
    assert "took" not in text


LATE = LatenessResult({"threads": 0.24, "gate": 0.06, "modem": 0.012}, 3, 0.045, 16, 5, 200, 20)


def test_a_computer_that_was_late_is_named_first(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    late = replace(run.result, lateness=LATE)
    assert explanation(late, run.trace)[0] == (
        "The computer did not keep up with the clock: 3 times it was 50 ms late or more, for 4% of the run (at most: "
        "threads 240 ms, gate 60.0 ms, modem 12.0 ms); latencies include that; 31% of the losses follow such moments, "
        "as do 10% of all messages."
    )
    without = replace(late, lateness=replace(LATE, lost=0, lost_after=0, moments=1, worst_s={"threads": 0.24}))
    assert explanation(without, run.trace)[0] == (
        "The computer did not keep up with the clock: once it was 50 ms late or more, for 4% of the run (at most: "
        "threads 240 ms); latencies include that."
    )


def test_robots_that_a_computer_carries_slower_than_real_time_are_named_first(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    config = {**run.result.config, "robots": [{}] * 9}
    slow = replace(run.result, config=config, counters={"medium": {"slow_s": run.result.duration_s}})
    assert explanation(slow, run.trace)[0].startswith("The computer carried 9 robots at 50% of real time: ")
    slightly = replace(slow, counters={"medium": {"slow_s": 0.009 * run.result.duration_s}})
    assert explanation(slightly, run.trace) == explanation(run.result, run.trace)


def test_nothing_is_said_of_a_computer_that_kept_up(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    in_time = replace(run.result, lateness=replace(LATE, moments=0, share=0.0))
    assert explanation(in_time, run.trace) == explanation(run.result, run.trace)


def test_nothing_sent() -> None:
    assert explanation(replace(RESULT, topics=()), empty_trace()) == ["No message was sent."]


def test_every_fate_of_the_ledger_is_said_in_words(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    everything = replace(run.result.topics[0], ledger=dict.fromkeys(FATES, 1), sent=len(FATES))
    outcome, *_ = explanation(replace(run.result, topics=(everything,)), run.trace)
    assert all(fate.words in outcome for fate in Fate)


@pytest.mark.usefixtures("undrawn")
def test_what_repair_did_is_told_and_tabulated(tmp_path: Path) -> None:
    out = tmp_path / "repaired"
    settings = ["robots=[{}, {topics: []}]", "channel.packet_loss=0.2", "time=packets"]
    outcome = run_scenario(load_scenario("paper-ofdm-paced", settings, duration_s=4.0), out)
    result = outcome.result
    (odom,), packets = result.topics, result.packets
    messages, air, *_ = explanation(result, outcome.trace)
    assert f" {odom.ledger['delivered']:,} (" in messages
    assert "delivered at the first try, " in messages
    assert f" {odom.ledger['repaired']:,} (" in messages
    spent, span = result.phy["airtime_of_senders_s"], result.phy["air_span_s"]
    there, back = (spent[src_id] for src_id in sorted(spent, key=lambda src_id: src_id != "1"))
    assert f"the channel of robot 1 {sum(there.values()) / span:.0%} of the time (new messages" in air
    assert f"repair {there['repair'] / span:.0%}" in air
    assert f"the channel back {sum(back.values()) / span:.0%} of the time (reports" in air
    assert sum(packets[f"air_{kind}"] for kind in ("new", "repair", "report", "hello")) == packets["sent"]
    uses = {use.kind: use for use in air_uses(result)}
    assert sum(use.share for use in uses.values()) == pytest.approx(1)
    grid = air_grid(result)
    assert grid is not None
    assert [line[0] for line in grid.sections[0]] == ["new", "repair", "report", "hello"]
    page = write_report(read_runs([out]), out, pictures=True)[0].read_text()
    assert "What the air was used for" in page
    assert (out / "air.png").is_file()


def test_version_0_has_nothing_to_tell_of_repair(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    assert air_uses(run.result) == []
    assert air_grid(run.result) is None
    assert "epair" not in " ".join(explanation(run.result, run.trace))


def test_a_link_that_falls_behind_is_told_and_one_whose_queues_fluctuate_is_not(tmp_path: Path) -> None:
    settings = ["time=packets", "phy.name=ofdm"]
    behind = run_scenario(load_scenario("paper-ofdm", settings, duration_s=4.0), tmp_path / "behind")
    assert "The link fell behind: the median latency was " in " ".join(explanation(behind.result, behind.trace))
    steady = run_scenario(load_scenario("paper-ofdm-paced", settings, duration_s=4.0), tmp_path / "steady")
    assert "fell behind" not in " ".join(explanation(steady.result, steady.trace))


def test_the_announcement_of_topics_has_a_name(tmp_path: Path) -> None:
    outcome = run_scenario(load_scenario("demo", ["time=packets"], duration_s=1.0), tmp_path / "run")
    topics = set(outcome.trace.packets().topic)
    assert "the topics that /robot_1 announces" in topics
    assert not any("topic_2" in topic for topic in topics)
