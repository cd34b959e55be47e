"""The monitor on a real run: snapshots, the radio, the channel settings."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli.link import _live
from gr_ros2.core.errors import RunError
from gr_ros2.dashboard.monitor import RunMonitor
from gr_ros2.link.events import Delivered, ReceiverEvent
from gr_ros2.observe.observers import LiveRun
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.radio.robots import Robot
from tests.radio.test_spectrum import carrier, noise, robot
from tests.waiting import wait_for

ENDS = ("graph.middleware=memory",)
OFDM = ("phy.name=ofdm", "phy.sample_rate=2e6", "packet_len=220", "channel.snr_db=30")


class MonitoredRun(threading.Thread):
    """A run in a thread, which starts.

    :param duration_s: without it, the run lasts until it is ended
    """

    def __init__(self, monitor: RunMonitor, *overrides: str, duration_s: float = 3600.0) -> None:
        super().__init__()
        self._scenario = load_scenario("paper-direct", [*ENDS, *overrides], duration_s=duration_s)
        self._monitor, self._over = monitor, threading.Event()
        self.start()

    def run(self) -> None:
        self.outcome = run_scenario(self._scenario, on_progress=self._look, observers=[self._monitor])

    def end(self) -> None:
        """As Ctrl-C does, and wait for the end."""
        self._over.set()
        self.join()

    def _look(self, _progress: object) -> None:
        if self._over.is_set():
            raise KeyboardInterrupt


@pytest.mark.slow
def test_a_run_is_seen_changed_and_ends_with_its_result() -> None:
    monitor = RunMonitor()
    assert monitor.tick().phase == "waiting"
    monitor.set_packet_loss(0.5)  # nothing to set yet
    running = MonitoredRun(monitor, *OFDM)
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
    lost = monitor.snapshot.sent - monitor.snapshot.delivered
    wait_for(lambda: monitor.tick().sent - monitor.tick().delivered > lost + 3, "messages to be lost")
    running.end()
    outcome = running.outcome
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
    assert 0 < times[0] <= times[1] <= times[2] < outcome.result.duration_s


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


class Ticking(RunMonitor):
    """Looks often in simulated time, whose seconds are none of the computer's."""

    seen = 0

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        super().receiver_event(event, now)
        self.seen += 1
        if self.seen % 20 == 0:
            self.tick()


def test_simulated_time_has_its_share_of_the_air() -> None:
    monitor = Ticking()
    scenario = load_scenario("team", ["robots=4", "time=packets"], duration_s=10.0)
    phy = run_scenario(scenario, observers=[monitor]).result.phy
    air = monitor.snapshot.air
    assert air is not None
    spans = np.diff(air.t, prepend=0.0)
    for kind, seconds in phy["airtime_of_kinds_s"].items():
        assert float(air.busy[kind] @ spans) == pytest.approx(seconds, rel=0.05), kind  # the last tick is earlier


def test_a_phy_without_samples_says_so_and_can_still_lose() -> None:
    monitor = RunMonitor()
    running = MonitoredRun(monitor)
    wait_for(lambda: monitor.tick().phase == "running", "the first message")
    monitor.set_snr_db(10.0)
    assert "direct" in monitor.refused
    monitor.set_packet_loss(0.25)
    assert monitor.refused == ""
    running.end()
    assert not monitor.radio.has_samples
    assert monitor.radio.snr_db is None
    assert monitor.radio.channel is not None
    assert monitor.radio.channel.packet_loss == 0.25


def test_the_next_run_starts_from_nothing() -> None:
    monitor = RunMonitor()
    MonitoredRun(monitor, duration_s=0.5).join()
    sent = monitor.snapshot.sent
    again = MonitoredRun(monitor, duration_s=0.5)
    again.join()
    assert sent
    assert monitor.snapshot.sent == again.outcome.result.topics[0].sent


def test_a_run_that_fails_is_said_to_have_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = RunMonitor()
    monkeypatch.setattr("gr_ros2_lab.run.runner._MATCH_S", -1.0)
    monkeypatch.setattr("gr_ros2_lab.run.runner._Run._sim_matched", lambda _: False)
    scenario = load_scenario("paper-direct", ENDS, duration_s=0.5)
    with pytest.raises(RunError, match="did not find each other"):
        run_scenario(scenario, observers=[monitor])
    assert monitor.snapshot.phase == "failed"


def test_of_a_front_end_that_hears_always_it_is_said_where_the_band_is_busy(tmp_path: Path) -> None:
    monitor = RunMonitor()
    samples = noise(400, np.random.default_rng(1))
    samples += carrier(400, 24)
    with robot(tmp_path / "in", samples) as one:
        monitor.run_started(_live(one.link))

        def said() -> bool:
            monitor.look()
            monitor.tick()
            return monitor.radio.busy.startswith("busy: 250 to 281.25 kHz for 100.0% of the time")

        wait_for(said, "the carrier")
        monitor.run_ended(None)


def test_of_bursts_alone_it_is_not_said(tmp_path: Path) -> None:
    monitor = RunMonitor()
    phy = {"name": "psk", "sample_rate": 1e6}
    with Robot(1, {"name": "sim"}, phy=phy, instrumented=True, state=str(tmp_path / "state")) as one:
        monitor.run_started(_live(one.link))
        wait_for(lambda: [monitor.look(), monitor.tick(), monitor.radio.spectrum_db is not None][-1], "a spectrum")
        assert monitor.radio.busy == ""
        monitor.run_ended(None)
