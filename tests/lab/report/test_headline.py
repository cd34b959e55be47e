"""The few lines in which a run ends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gr_ros2_lab.record.result import Result
from gr_ros2_lab.record.team_numbers import airtime_of_senders, team_numbers, team_pairs
from gr_ros2_lab.report.explain import percent
from gr_ros2_lab.report.headline import MOST_LINES, headline, topics_grid
from gr_ros2_lab.run.runner import Progress, run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.lab.record.runs import empty_trace, make_run


def test_delivered_ages_and_reasons(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    delivered, *rest = headline(run.result, run.trace)
    assert delivered == (
        "Delivered: 33 of 49 messages (67%); 8 lost because a fragment did not arrive, "
        "2 too large for the packet length, 6 still in flight at the end."
    )
    assert rest[-1].startswith("Air in use: ")
    grid = topics_grid(run.result)
    assert grid is not None
    assert [line[1] for line in grid.sections[0]] == [f"{t.delivered} of {t.sent}" for t in run.result.topics if t.sent]


def test_a_team_says_its_task_all_its_robots_and_what_was_worst() -> None:
    outcome = run_scenario(load_scenario("team", ("channel.packet_loss=0.3", "repair=off"), duration_s=3))
    lines = headline(replace(outcome.result, task={"formation_error_m": 0.271}), outcome.trace)
    assert lines[0] == "Formation error: 0.271 m."
    assert " messages of 4 robots (" in lines[1]
    assert any(line.startswith("Worst: /robot_") for line in lines)
    assert topics_grid(outcome.result) is None
    assert len(lines) <= MOST_LINES - 3
    all_sent = sum(t.sent for end in (outcome.result, *outcome.result.receivers) for t in end.topics)
    assert f" of {all_sent:,} messages of 4 robots" in lines[1]
    used = team_numbers(outcome.result)["air_use"]
    assert used is not None
    assert any(line.startswith(f"Air in use: {percent(used)} of the time") for line in lines)
    assert airtime_of_senders(outcome.result).keys() == {"1", "2", "3", "4"}
    assert not any("since repair" in line or "after repair" in line or "(repair" in line for line in lines), "it is off"


def test_without_repair_what_says_that_a_packet_is_given_up_is_not_called_repair() -> None:
    outcome = run_scenario(load_scenario("demo", ("repair=off", "time=packets"), duration_s=10))
    delivered, *_, air = headline(outcome.result, outcome.trace)
    assert sum(topic.ledger.get("repaired", 0) for topic in outcome.result.topics) > 0, "one that brings a packet back"
    assert "% after packets that say what is given up)" in delivered
    assert "packets that say what is given up 1%" in air
    assert "repair" not in delivered + air


def test_progress_counts_what_all_robots_send_and_receive() -> None:
    seen: list[Progress] = []
    outcome = run_scenario(load_scenario("team", (), duration_s=3), on_progress=seen.append)
    pairs = team_pairs(outcome.result)
    robots = {topic.src_id for topic in outcome.result.topics}
    assert len(robots) < len({topic.src_id for topic in pairs}), "the first receiver does not hear itself"
    assert seen[-1].sent > sum(topic.sent for topic in outcome.result.topics)
    assert seen[-1].sent <= sum(topic.sent for topic in pairs)
    assert 0 < seen[-1].delivered <= sum(topic.delivered for topic in pairs)


def test_where_nothing_arrives_the_snr_that_the_radio_needs_is_told(result: Result) -> None:
    nothing = tuple(replace(t, delivered=0, ledger={"given_up": t.sent}) for t in result.topics)
    deaf = replace(
        result,
        topics=nothing,
        config={**result.config, "channel": {"snr_db": 3.0}},
        phy={**result.phy, "half_snr_db": 6.1},
    )
    trace = empty_trace()
    assert any("3 dB of SNR, and this radio needs about 6 dB" in line for line in headline(deaf, trace))
    assert not any("dB" in line for line in headline(replace(deaf, topics=result.topics), trace))


def test_who_knew_what_was_oldest_and_how_many_packets_were_lost_is_named() -> None:
    outcome = run_scenario(load_scenario("team", ("channel.packet_loss=0.4", "repair=off"), duration_s=3))
    ends = {f"at /robot_{number})." for number in range(1, 5)}
    lines = headline(outcome.result, outcome.trace)
    (known,) = (line for line in lines if line.startswith("What a receiver knew"))
    assert any(known.endswith(end) for end in ends)
    counts = [outcome.result.packets, *(receiver.packets for receiver in outcome.result.receivers)]
    sent, received = (sum(count[name] for count in counts) for name in ("sent", "received"))
    assert f"On the way {1 - received / sent:.0%} of {sent:,} packets were lost, at all receivers together." in lines


def test_a_task_without_a_number_and_a_meeting_are_said_in_words(result: Result) -> None:
    tasks = {"formation_error_m": None, "time_to_meet_s": 15.0, "met": 0.0}
    lines = headline(replace(result, task=tasks), empty_trace())
    assert lines[:3] == ["Formation error: not known after 15.0 s.", "Time to meet: 15 s.", "The robots have not met."]


def test_what_is_wrong_is_never_cut_off() -> None:
    outcome = run_scenario(load_scenario("demo", ("time=packets",), duration_s=1))
    wrong = tuple(f"capture {number} is not complete" for number in range(3))
    lines = headline(replace(outcome.result, incomplete=wrong), outcome.trace)
    assert set(wrong) <= set(lines)


@pytest.mark.parametrize("name", ["demo", "team", "line"])
def test_no_run_ends_in_more_lines_than_fit(name: str) -> None:
    outcome = run_scenario(load_scenario(name, ("time=packets",), duration_s=2))
    grid = topics_grid(outcome.result)
    rows = 0 if grid is None else 1 + len(grid.sections[0])
    assert len(headline(outcome.result, outcome.trace)) + rows <= MOST_LINES - 3
