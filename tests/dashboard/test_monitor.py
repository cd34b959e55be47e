"""The monitor on a real run: snapshots, the radio, the channel settings."""

from __future__ import annotations

import threading
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU RadioView 3.10")

from gr_ros2.core.errors import RunError
from gr_ros2.dashboard.monitor import RunMonitor
from gr_ros2.link.events import Delivered
from gr_ros2.observe.observers import LiveRun
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.waiting import wait_for

ENDS = ("graph.middleware=memory",)
OFDM = ("phy.name=ofdm", "phy.sample_rate=2e6", "packet_len=220", "channel.snr_db=30")


def run(monitor: RunMonitor, *overrides: str, duration_s: float) -> tuple[threading.Thread, list[Any]]:
    scenario = load_scenario("paper-direct", [*ENDS, *overrides], duration_s=duration_s)
    outcomes: list[Any] = []
    thread = threading.Thread(target=lambda: outcomes.append(run_scenario(scenario, observers=[monitor])))
    thread.start()
    return thread, outcomes


@pytest.mark.slow
def test_a_run_is_seen_changed_and_ends_with_its_result() -> None:
    monitor = RunMonitor()
    assert monitor.tick().phase == "waiting"
    monitor.set_packet_loss(0.5)  # nothing to set yet
    thread, outcomes = run(monitor, *OFDM, duration_s=3.0)
    wait_for(lambda: monitor.tick().delivered > 5, "deliveries")
    wait_for(lambda: [monitor.look(), monitor.tick(), monitor.radio.spectrum_db is not None][-1], "a spectrum")
    assert monitor.radio.has_samples
    assert monitor.radio.symbols is not None
    assert monitor.radio.snr_db == pytest.approx(30, abs=1.5)
    monitor.set_snr_db(-20.0)
    monitor.set_frequency_offset(0.001)
    monitor.set_packet_loss(1.0)
    assert monitor.refused == ""
    monitor.set_packet_loss(2.0)
    assert "packet_loss" in monitor.refused
    monitor.tick()
    channel = monitor.radio.channel
    assert channel is not None
    assert (channel.snr_db, channel.frequency_offset, channel.packet_loss) == (-20.0, 0.001, 1.0)
    thread.join()
    (outcome,) = outcomes
    assert monitor.snapshot.phase == "ended"
    assert monitor.tick() is monitor.snapshot  # nothing moves any more
    (view,), (topic,) = monitor.snapshot.topics, outcome.result.topics
    assert (view.sent, view.delivered, dict(view.ledger)) == (topic.sent, topic.delivered, topic.ledger)
    assert topic.delivered < topic.sent
    changes = outcome.result.changes
    assert [(change.setting, change.value) for change in changes] == [
        ("channel.snr_db", -20.0),
        ("channel.frequency_offset", 0.001),
        ("channel.packet_loss", 1.0),
    ], "what was refused was not changed"
    assert monitor.snapshot.air is not None
    assert len(monitor.snapshot.air.changes) == len(changes), "nor is it marked"
    times = [change.t for change in changes if change.t is not None]
    assert 0 < times[0] <= times[1] <= times[2] < 4


def test_a_page_that_is_opened_late_knows_what_others_have_announced() -> None:
    monitor = RunMonitor()
    announced = (9, "/rx_robot_9/cmd_vel", Topic(0, "cmd_vel", "geometry_msgs/msg/Twist"))
    own = Registry.from_rows({"odom": "nav_msgs/msg/Odometry"})
    monitor.run_started(
        LiveRun("late", 0.0, 64, own, {(1, 0): "/robot_1/odom"}, {}, (), None, announced=lambda: (announced,))
    )
    monitor.receiver_event(Delivered(9, 0, bytes(8), 0, "key"), 1.0)
    assert [(topic.name, topic.type_name) for topic in monitor.tick().topics] == [
        ("/robot_1/odom", "nav_msgs/msg/Odometry"),
        ("/rx_robot_9/cmd_vel", "geometry_msgs/msg/Twist"),
    ]


def test_a_phy_without_samples_says_so_and_can_still_lose() -> None:
    monitor = RunMonitor()
    thread, _ = run(monitor, duration_s=1.0)
    wait_for(lambda: monitor.tick().phase == "running", "the first message")
    monitor.set_snr_db(10.0)
    assert "direct" in monitor.refused
    monitor.set_packet_loss(0.25)
    assert monitor.refused == ""
    thread.join()
    assert not monitor.radio.has_samples
    assert monitor.radio.snr_db is None
    assert monitor.radio.channel is not None
    assert monitor.radio.channel.packet_loss == 0.25


def test_the_next_run_starts_from_nothing() -> None:
    monitor = RunMonitor()
    run(monitor, duration_s=0.5)[0].join()
    sent = monitor.snapshot.sent
    thread, outcomes = run(monitor, duration_s=0.5)
    thread.join()
    assert sent
    assert monitor.snapshot.sent == outcomes[0].result.topics[0].sent


def test_a_run_that_fails_is_said_to_have_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = RunMonitor()
    monkeypatch.setattr("gr_ros2_lab.run.runner._MATCH_S", -1.0)
    monkeypatch.setattr("gr_ros2_lab.run.runner._Run._sim_matched", lambda _: False)
    scenario = load_scenario("paper-direct", ENDS, duration_s=0.5)
    with pytest.raises(RunError, match="did not find each other"):
        run_scenario(scenario, observers=[monitor])
    assert monitor.snapshot.phase == "failed"
