"""The desk on a real run: snapshots, the radio, the knobs."""

from __future__ import annotations

import threading
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.dashboard.desk import Desk
from gr_ros2.errors import RunError
from gr_ros2.run.runner import run_scenario
from gr_ros2.run.scenario import load_scenario
from tests.waiting import wait_for

ENDS = ("ros_source.middleware=memory", "ros_sink.middleware=memory")
OFDM = ("phy.name=ofdm", "phy.sample_rate=2e6", "packet_len=220", "channel.snr_db=30")


def run(desk: Desk, *overrides: str, duration_s: float) -> tuple[threading.Thread, list[Any]]:
    scenario = load_scenario("paper-direct", [*ENDS, *overrides], duration_s=duration_s)
    outcomes: list[Any] = []
    thread = threading.Thread(target=lambda: outcomes.append(run_scenario(scenario, watchers=[desk])))
    thread.start()
    return thread, outcomes


@pytest.mark.slow
def test_a_run_is_seen_changed_and_ends_with_its_result() -> None:
    desk = Desk()
    assert desk.tick().phase == "waiting"
    desk.set_packet_loss(0.5)  # nothing to set yet
    thread, outcomes = run(desk, *OFDM, duration_s=3.0)
    wait_for(lambda: desk.tick().delivered > 5, "deliveries")
    wait_for(lambda: [desk.look(), desk.tick(), desk.radio.spectrum_db is not None][-1], "a spectrum")
    assert desk.radio.has_samples
    assert desk.radio.symbols is not None
    assert desk.radio.snr_db == pytest.approx(30, abs=1.5)
    desk.set_snr_db(-20.0)
    desk.set_frequency_offset(0.001)
    desk.set_packet_loss(1.0)
    assert desk.refused == ""
    desk.set_packet_loss(2.0)
    assert "packet_loss" in desk.refused
    desk.tick()
    channel = desk.radio.channel
    assert channel is not None
    assert (channel.snr_db, channel.frequency_offset, channel.packet_loss) == (-20.0, 0.001, 1.0)
    thread.join()
    (outcome,) = outcomes
    assert desk.snapshot.phase == "ended"
    assert desk.tick() is desk.snapshot  # nothing moves any more
    (view,), (topic,) = desk.snapshot.topics, outcome.result.topics
    assert (view.sent, view.delivered, dict(view.ledger)) == (topic.sent, topic.delivered, topic.ledger)
    assert topic.delivered < topic.sent


def test_a_phy_without_samples_says_so_and_can_still_lose() -> None:
    desk = Desk()
    thread, _ = run(desk, duration_s=1.0)
    wait_for(lambda: desk.tick().phase == "running", "the first message")
    desk.set_snr_db(10.0)
    assert "direct" in desk.refused
    desk.set_packet_loss(0.25)
    assert desk.refused == ""
    thread.join()
    assert not desk.radio.has_samples
    assert desk.radio.snr_db is None
    assert desk.radio.channel is not None
    assert desk.radio.channel.packet_loss == 0.25


def test_the_next_run_starts_from_nothing() -> None:
    desk = Desk()
    run(desk, duration_s=0.5)[0].join()
    sent = desk.snapshot.sent
    thread, outcomes = run(desk, duration_s=0.5)
    thread.join()
    assert sent
    assert desk.snapshot.sent == outcomes[0].result.topics[0].sent


def test_a_run_that_fails_is_said_to_have_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk()
    monkeypatch.setattr("gr_ros2.run.runner._MATCH_S", -1.0)
    scenario = load_scenario("paper-direct", ENDS, duration_s=0.5)
    with pytest.raises(RunError, match="did not find each other"):
        run_scenario(scenario, watchers=[desk])
    assert desk.snapshot.phase == "failed"
