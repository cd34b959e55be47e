"""Runs on simulated time: the same numbers each time, those of real time, and nothing left behind."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from math import sqrt
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from gr_ros2.core.errors import ConfigError
from gr_ros2.dashboard.monitor import RunMonitor
from gr_ros2.link.events import Delivered, ReceiverEvent, SenderEvent
from gr_ros2.middleware.bag_files import bag_topics, read_bag
from gr_ros2.observe.observers import LiveRun
from gr_ros2.paper.endpoint import EndpointV0
from gr_ros2.phy import measure
from gr_ros2_lab.medium import loss_table
from gr_ros2_lab.record.result import Result, read_result
from gr_ros2_lab.run.outcome import DELIVERED_BAG, Outcome, Progress
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.e2e.support import check_books, check_complete, scenario
from tests.programs import run_program

BOTH = ("samples", "packets")
PLAIN = ("paper.compression=true",)
"""Each message is one packet, which nothing repairs and beside which nothing is sent."""
NOISY = ("channel.snr_db=14", "channel.packet_loss=0.02", "channel.outages=[[0.5, 0.7]]", "channel.doppler_hz=3")


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder that is empty at the beginning."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    monkeypatch.setattr(loss_table, "PACKETS", 100)
    return folder


def run(name: str, time: str, *overrides: str, duration_s: float = 3.0, seed: int = 0) -> Outcome:
    return run_scenario(load_scenario(name, [f"time={time}", *overrides], duration_s=duration_s, seed=seed))


def numbers(result: Result) -> Any:
    """All of a result that is not wall-clock time, as it stands in the file."""
    return json.loads(TypeAdapter(Result).dump_json(replace(result, wall_s=None)))


@pytest.mark.slow
@pytest.mark.parametrize("time", BOTH)
def test_equal_seeds_give_equal_results_in_one_process_and_in_another(
    time: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # the other process has the cache folder and the number of packets of this one
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, again = (numbers(run("paper-ofdm-paced", time, *NOISY).result) for _ in range(2))
    assert first == again
    settings = [word for override in (f"time={time}", *NOISY) for word in ("--set", override)]
    command = [sys.executable, "-m", "gr_ros2.cli", "run", "paper-ofdm-paced", *settings]
    out = tmp_path / "out"
    run_program(
        [*command, "--duration", "3", "--seed", "0", "--no-report", "--out", str(out)],
        check=True,
        env=os.environ,
        capture_output=True,
    )
    other = numbers(read_result(out))
    heard = other["counters"].pop("listener")
    first["counters"].pop("listener")  # only a run with a folder keeps what it delivers
    assert other == first
    assert heard == {"/rx_robot_1/odom": first["topics"][0]["delivered"]}
    assert 0 < first["topics"][0]["pdr"] < 1
    assert first["counters"]["channel"]["outages"] > 0
    assert numbers(run("paper-ofdm-paced", time, *NOISY, seed=1).result)["topics"] != first["topics"]


@pytest.mark.slow
@pytest.mark.real_time
def test_without_noise_real_time_samples_and_packets_agree() -> None:
    patient = "queue_depth=100"  # a busy computer may hold up real time, which must not lose messages
    real = run_scenario(scenario("paper-ofdm-paced", *PLAIN, patient, duration_s=3.0)).result
    samples, packets = (run("paper-ofdm-paced", time, *PLAIN, patient).result for time in BOTH)
    span = {"air_span_s": real.phy["air_span_s"]}  # the wall clock's
    for result in (real, samples, packets):
        check_complete(result)
        assert result.packets["sent"] == result.packets["received"] == real.packets["sent"]
        assert result.phy | span == real.phy, "packets, airtime and bytes on the air"
    assert (samples.topics, samples.phy) == (packets.topics, packets.phy)
    there, simulated = real.topics[0].latency_s, samples.topics[0].latency_s
    assert there.p50 is not None and simulated.p50 is not None
    assert simulated.p50 < there.p50, "the computer adds DDS, Python, and a flowgraph that waits for a processor"


@pytest.mark.slow
def test_in_noise_packets_lose_what_samples_lose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss_table, "PACKETS", 1000)
    monkeypatch.setattr(loss_table, "BUILTIN_DIR", Path("none"))
    samples, packets = (run("paper-ofdm-paced", time, *PLAIN, "channel.snr_db=12.25", duration_s=20.0) for time in BOTH)
    one, other = samples.result.topics[0], packets.result.topics[0]
    assert one.sent == other.sent == 700
    assert one.pdr is not None and other.pdr is not None
    spread = sqrt(one.pdr * (1 - one.pdr) * (1 / one.sent + 1 / other.sent + 2 / 1000))
    assert abs(one.pdr - other.pdr) < 2.58 * spread, "99 %, the two points of the table included"
    assert 0.3 < one.pdr < 0.9


@pytest.mark.parametrize("time", BOTH)
def test_a_source_without_pacing_queues_for_the_air(time: str) -> None:
    outcome = run("paper-ofdm", time, duration_s=5.0)
    result = outcome.result
    check_books(result)
    odom = result.topics[0]
    assert odom.pdr is not None and 0.1 < odom.pdr < 0.2
    assert odom.latency_s.max is not None and odom.latency_s.max > 4
    assert odom.ledger["in_flight"] == odom.sent - odom.delivered
    (messages,) = outcome.trace.messages()
    assert result.packets["received"] == int((5.0 - messages.t_sent[0]) / result.phy["airtime_s"]), (
        "the air never idles"
    )


def test_both_directions_of_a_two_way_scenario_are_there() -> None:
    result = run("two-way", "packets", "channel.snr_db=null", duration_s=2.0).result
    check_books(result)
    assert {topic.src_id for topic in result.topics} == {1, 2}
    assert all(topic.delivered for topic in result.topics)
    assert result.phy["channels"] == 2
    assert result.counters["back"]["source"]["packets"] > 0


def test_a_phy_without_samples_loses_only_what_it_is_told_to() -> None:
    result = run("paper-direct", "samples", "channel.outages=[[1, 2]]").result
    odom = result.topics[0]
    assert odom.ledger == {"delivered": 60, "lost_fragments": 30}
    assert odom.latency_s.max == 0


def test_batches_change_nothing_without_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run("paper-ofdm-paced", "samples")
    monkeypatch.setattr(measure, "_BATCH_SAMPLES", 40_000)
    assert numbers(run("paper-ofdm-paced", "samples").result) == numbers(whole.result)


def test_many_runs_in_one_process_leave_little_shared_memory_behind() -> None:
    def segments() -> int:
        return sum(
            line.split()[4] == str(os.getpid()) for line in Path("/proc/sysvipc/shm").read_text().splitlines()[1:]
        )

    before = segments()
    for _ in range(5):
        run("paper-ofdm-paced", "samples", duration_s=0.5)
    # Two for each of the two blocks with message ports, which GNU Radio does not let go of.
    assert segments() <= before + 5 * 4


def test_what_is_delivered_is_kept_with_both_times(tmp_path: Path) -> None:
    settings = ["time=packets", "sim.start_time_s=1000"]
    outcome = run_scenario(load_scenario("paper-ofdm-paced", settings, duration_s=2.0), tmp_path / "out")
    bag = tmp_path / "out" / DELIVERED_BAG
    assert [info.topic for info in bag_topics(bag)] == ["/rx_robot_1/odom"]
    stamps = [message.stamp_ns for message in read_bag(bag)]
    (odom,) = outcome.trace.messages()
    assert stamps == [1_000_000_000_000 + round(t * 1e9) for t in odom.t_delivered.tolist()]
    with pytest.raises(ConfigError, match="holds a run already"):
        run_scenario(load_scenario("paper-ofdm-paced", settings), tmp_path / "out")


def test_what_is_delivered_is_kept_under_the_name_the_sinks_options_give_it(tmp_path: Path) -> None:
    settings = ["time=packets", "publish.topics={odom: {as: '/fleet/r{robot}/pose'}}"]
    outcome = run_scenario(load_scenario("paper-ofdm-paced", settings, duration_s=1.0), tmp_path / "out")
    assert [info.topic for info in bag_topics(tmp_path / "out" / DELIVERED_BAG)] == ["/fleet/r1/pose"]
    assert list(outcome.result.counters["listener"]) == ["/fleet/r1/pose"]


class RecordingObserver:
    """Notes what it hears and when."""

    instruments = False

    def __init__(self) -> None:
        self.run: LiveRun | None = None
        self.times: list[float] = []
        self.heard = 0
        self.result: Result | None = None

    def run_started(self, run: LiveRun) -> None:
        self.run = run

    def run_ended(self, result: Result | None) -> None:
        self.result = result

    def sender_event(self, src_id: int, event: SenderEvent) -> None:  # noqa: ARG002
        assert self.run is not None
        self.times.append(self.run.clock())

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        self.times.append(now)
        self.heard += isinstance(event, Delivered)


def test_onlookers_hear_everything_in_the_order_of_time() -> None:
    observer, seen = RecordingObserver(), list[Progress]()
    settings = load_scenario("paper-ofdm-paced", ["time=packets"], duration_s=3.0)
    outcome = run_scenario(settings, None, seen.append, [observer])
    assert observer.result is outcome.result
    assert observer.times == sorted(observer.times)
    assert observer.heard == outcome.result.topics[0].delivered
    assert seen and seen[-1].duration_s == 3.0


def test_a_dashboard_shows_the_run_and_says_that_there_is_no_channel_to_change() -> None:
    monitor = RunMonitor()

    def look(progress: Progress) -> None:  # noqa: ARG001
        monitor.look()
        monitor.tick()
        monitor.set_snr_db(3.0)

    settings = load_scenario("paper-direct", ["time=packets"], duration_s=2.0)
    outcome = run_scenario(settings, None, look, [monitor])
    assert "simulated time" in monitor.refused
    assert (monitor.snapshot.phase, monitor.snapshot.elapsed_s) == ("ended", 2.0)
    assert monitor.snapshot.delivered == outcome.result.topics[0].delivered == 60


def test_the_dashboard_of_a_team_says_whose_view_it_is() -> None:
    for name, shown in (("team", "team, as /robot_1 receives it"), ("paper-direct", "paper-direct")):
        monitor = RunMonitor()
        outcome = run_scenario(load_scenario(name, ["time=packets"], duration_s=1.0), None, None, [monitor])
        assert monitor.snapshot.name == shown
        assert monitor.snapshot.delivered == sum(topic.delivered for topic in outcome.result.topics)


def test_a_run_that_is_interrupted_leaves_nothing_in_the_way_of_the_next(tmp_path: Path) -> None:
    def interrupt(progress: Progress) -> None:  # noqa: ARG001
        raise KeyboardInterrupt

    settings = load_scenario("paper-direct", ["time=packets"], duration_s=1.0)
    with pytest.raises(KeyboardInterrupt):
        run_scenario(settings, tmp_path / "out", interrupt)
    assert run_scenario(settings, tmp_path / "out").result.topics[0].pdr == 1


def test_what_cannot_be_simulated_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"channel.epsilon = 1.001.*time to samples"):
        run("channel-clock-offset", "packets")
    with pytest.raises(ConfigError, match="time = 'never'"):
        run("paper-ofdm-paced", "never")


def test_samples_go_packet_by_packet_where_an_end_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without noise nothing depends on how many packets pass through the flowgraph at a time."""
    together = run("paper-ofdm-paced", "samples", duration_s=1.0).result
    monkeypatch.setattr(EndpointV0, "answers", True)
    one_by_one = run("paper-ofdm-paced", "samples", duration_s=1.0).result
    assert one_by_one.topics == together.topics
    assert one_by_one.packets == together.packets
