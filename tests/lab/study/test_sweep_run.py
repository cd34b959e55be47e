"""Sweeps on real Dask clusters: resumed, robbed of a worker, and never at a loss for what went wrong."""

from __future__ import annotations

import fcntl
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import distributed
import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.study.sweep import store
from gr_ros2_lab.study.sweep.cluster import alone_on_this_machine, local_cluster
from gr_ros2_lab.study.sweep.run import SweepOutcome, SweepProgress, run_sweep
from gr_ros2_lab.study.sweep.store import Store, run_key
from tests.lab.study.sweeps import plan
from tests.waiting import wait_for


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two worker processes; Dask's own cluster would give up a lost one at once, as it does on a busy machine."""
    with dask.config.set({"distributed.deploy.lost-worker-timeout": 0}), local_cluster(2) as made:
        yield made


def outcome_numbers(outcome: SweepOutcome) -> dict[tuple[int, int], tuple[TopicResult, ...]]:
    return {place: result.topics for place, result in outcome.results.items()}


class Assassin:
    """Kills a worker that is at work once a run has ended."""

    def __init__(self, cluster: Any) -> None:
        self.pids = {nanny.worker_address: nanny.pid for nanny in cluster.workers.values()}
        self.client = distributed.Client(cluster)
        self.victim: str | None = None
        self.robbed: set[str] = set()
        self.total = 0

    def __call__(self, progress: SweepProgress) -> None:
        self.total = progress.total
        if self.victim is None and progress.done:
            at_work = {worker: keys for worker, keys in self.client.processing().items() if keys}
            self.victim, keys = next(iter(at_work.items()))
            self.robbed = {str(key) for key in keys}
            os.kill(self.pids[self.victim], signal.SIGKILL)


@pytest.mark.slow
def test_a_sweep_survives_the_loss_of_a_worker(tmp_path: Path, cluster: Any) -> None:
    """Robots × range × policy, at packets."""
    grid = {"robots": [2, 3], "gains_db": [-100, -115], "medium": ["slots", "aloha", "exclusive"]}
    made = plan(tmp_path, scenario="formation", description=None, grid=grid, repetitions=1)
    assassin = Assassin(cluster)
    outcome = run_sweep(made, tmp_path / "out", scheduler=cluster.scheduler_address, on_progress=assassin)
    assert assassin.robbed
    assert assassin.total == len(outcome.results) == 12
    assert (outcome.failures, outcome.interrupted) == ((), False)
    wait_for(lambda: len(assassin.client.nthreads()) == 2, "the worker's successor")
    assert assassin.victim not in assassin.client.nthreads()
    assassin.client.close()
    robbed = next(run for cell in made.cells for run in cell.runs if f"gr-ros2-{run_key(run)}" in assassin.robbed)
    place = next((cell.number, n) for cell in made.cells for n, run in enumerate(cell.runs) if run is robbed)
    assert outcome.results[place].topics == run_scenario(robbed).result.topics


@pytest.mark.slow
def test_a_worker_that_has_run_many_flowgraphs_makes_room_for_another(tmp_path: Path, cluster: Any) -> None:
    def patience(runs: int) -> int:
        from gr_ros2_lab.study.sweep import cluster as there

        there.RUNS_PER_PROCESS = runs
        return os.getpid()

    with distributed.Client(cluster) as client:
        before = set(client.run(patience, 2).values())
        radio = {"duration_s": 0.2, "phy": {"name": "psk", "sample_rate": 1e6}}
        made = plan(tmp_path, time="samples", set=radio, grid={"seed": list(range(6))}, repetitions=1)
        outcome = run_sweep(made, tmp_path / "out", scheduler=cluster.scheduler_address)
        assert (len(outcome.results), outcome.failures) == (6, ())
        wait_for(lambda: len(client.nthreads()) == 2, "the successor")
        assert set(client.run(os.getpid).values()) != before


@pytest.mark.slow
def test_a_run_that_takes_its_process_down_fails_alone_and_is_tried_again(tmp_path: Path) -> None:
    made = plan(tmp_path, repetitions=3)
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), local_cluster(2) as cluster:
        assassin = Assassin(cluster)
        outcome = run_sweep(made, tmp_path / "out", scheduler=cluster.scheduler_address, on_progress=assassin)
        assassin.client.close()
        assert 1 <= len(outcome.failures) <= len(assassin.robbed)
        assert "the process that ran it ended" in outcome.failures[0]
        assert outcome.failures[0].startswith("cell ")
        assert len(outcome.results) == 9 - len(outcome.failures)
        assert "runs are missing" in outcome.files[0].read_text()
        again = run_sweep(made, tmp_path / "out", scheduler=cluster.scheduler_address)
    assert (len(again.results), again.failures) == (9, ())
    assert "missing" not in again.files[0].read_text()


def test_a_stopped_sweep_goes_on_with_what_is_left(tmp_path: Path, cluster: Any) -> None:
    made = plan(tmp_path)
    seen: list[SweepProgress] = []

    def stop(progress: SweepProgress) -> None:
        seen.append(progress)
        if progress.done == 2:
            raise KeyboardInterrupt

    address = cluster.scheduler_address
    stopped = run_sweep(made, tmp_path / "out", scheduler=address, on_progress=stop)
    assert (stopped.interrupted, stopped.files, len(stopped.results)) == (True, (), 2)
    seen.clear()
    outcome = run_sweep(made, tmp_path / "out", scheduler=address, on_progress=seen.append)
    assert (seen[0], seen[-1]) == (SweepProgress(6, 2, 2, 0), SweepProgress(6, 6, 2, 0))
    assert not outcome.interrupted and len(outcome.results) == 6
    seen.clear()
    wider = plan(tmp_path, grid={"channel.packet_loss": [0.0, 0.01, 0.1, 0.2]})
    run_sweep(wider, tmp_path / "out", scheduler=address, on_progress=seen.append)
    assert (seen[0].found, seen[-1].done) == (6, 8)
    seen.clear()
    fresh = run_sweep(made, tmp_path / "out", scheduler=address, fresh=True, on_progress=seen.append)
    assert seen[0] == SweepProgress(6, 0, 0, 0)
    assert outcome_numbers(fresh) == outcome_numbers(outcome)


@pytest.mark.slow
def test_processes_of_this_machine_give_what_a_run_gives_and_none_when_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = plan(tmp_path, repetitions=1, list=[{}, {}])  # every cell twice: each is run once
    seen: list[SweepProgress] = []
    outcome = run_sweep(made, tmp_path / "out", workers=2, on_progress=seen.append)
    assert (seen[-1].total, len(outcome.results)) == (3, 6)
    for cell in made.cells:
        assert outcome.results[cell.number, 0].topics == run_scenario(cell.runs[0]).result.topics
    shares = [outcome.results[number, 0].topics[0].pdr for number in (1, 2, 3)]
    assert shares[0] == 1.0 and shares == sorted(shares, key=lambda share: -(share or 0))

    def nobody(count: int) -> None:
        raise AssertionError(f"{count} workers started for nothing")

    monkeypatch.setattr("gr_ros2_lab.study.sweep.run.local_workers", nobody)
    assert outcome_numbers(run_sweep(made, tmp_path / "out")) == outcome_numbers(outcome)


def test_a_run_that_fails_is_named_and_costs_itself_only(tmp_path: Path, cluster: Any) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text(f"odom,nav_msgs/Odometry\n{name},std_msgs/String\n")
    made = plan(tmp_path, grid={"registry": ["a.csv", "b.csv"]}, repetitions=1)
    (tmp_path / "b.csv").unlink()
    outcome = run_sweep(made, tmp_path / "out", scheduler=cluster.scheduler_address)
    assert list(outcome.results) == [(1, 0)]
    (line,) = outcome.failures
    assert line.startswith("cell 2 (registry=b.csv), repetition 0: registry = ")
    assert "b.csv': no such file" in line


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    made = plan(tmp_path)
    folder = tmp_path / "out" / store.RUNS
    folder.mkdir(parents=True)
    damaged = folder / f"{run_key(made.cells[0].runs[0])}.json"
    damaged.write_text('{"scenario": "pap')
    with pytest.raises(ConfigError, match=r"half-written.*delete the file: then this one run is repeated") as caught:
        run_sweep(made, tmp_path / "out")
    assert str(damaged) in str(caught.value)


def test_an_address_without_a_scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2_lab.study.sweep.cluster._CONNECT_S", 0.5)
    for address in ("tcp://127.0.0.1:1", "nonsense://"):
        with pytest.raises(ConfigError, match=f"--scheduler {address}: no Dask scheduler answers"):
            run_sweep(plan(tmp_path), tmp_path / "out", scheduler=address)


def test_workers_that_share_a_process_are_refused(tmp_path: Path) -> None:
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0", protocol="tcp"
        ) as cluster,
        pytest.raises(ConfigError, match=r"has 2 threads.*--nthreads 1"),
    ):
        run_sweep(plan(tmp_path), tmp_path / "out", scheduler=cluster.scheduler_address)


def test_workers_of_another_version_are_refused(tmp_path: Path, cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2_lab.study.sweep.cluster.__version__", "99.0")
    with pytest.raises(ConfigError, match=r"worker tcp://\S+ has \S+, here is 99.0; install the same there"):
        run_sweep(plan(tmp_path), tmp_path / "out", scheduler=cluster.scheduler_address)


@pytest.mark.parametrize(
    ("changes", "settings", "says"),
    [
        ({"time": "real"}, {"workers": 2}, "workers = 2: runs in real time need the machine for themselves"),
        ({}, {"workers": 2, "scheduler": "tcp://x:1"}, "workers = 2: the cluster at tcp://x:1 has its own"),
    ],
)
def test_workers_that_do_not_fit(tmp_path: Path, changes: Any, settings: Any, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        run_sweep(plan(tmp_path, **changes), tmp_path / "out", **settings)


def test_a_key_tells_all_runs_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registry = tmp_path / "own.csv"
    registry.write_text("odom,nav_msgs/Odometry\n")

    def key(*overrides: str, **settings: Any) -> str:
        return run_key(load_scenario("paper-direct", [f"registry={registry}", *overrides], **settings))

    before = key()
    assert key() == before == key("packet_len=64")  # what it is anyway
    others = [key("packet_len=65"), key(seed=1), key("channel.packet_loss=0.1"), key("time=packets")]
    other_place = tmp_path / "elsewhere.csv"
    other_place.write_text(registry.read_text())
    assert key(f"registry={other_place}") == before
    registry.write_text("topic,type,queue\nodom,nav_msgs/Odometry,latest\n")
    others.append(key())
    monkeypatch.setattr(store, "__version__", "99.0")
    others.append(key())
    assert len({before, *others}) == 7


def test_what_is_kept_comes_back(tmp_path: Path, result: Result) -> None:
    kept = Store(tmp_path)
    assert kept.find("one") is None
    kept.keep("one", result)
    assert kept.find("one") == result
    assert [path.name for path in (tmp_path / store.RUNS).iterdir()] == ["one.json"]


def test_runs_in_real_time_have_the_machine_for_themselves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def taken(time: str) -> bool:
        with alone_on_this_machine(load_scenario("paper-direct", [f"time={time}"])):
            for path in tmp_path.iterdir():
                with path.open("w") as lock:
                    try:
                        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    except BlockingIOError:
                        return True
        return False

    assert [taken(time) for time in ("packets", "real", "samples", "real")] == [False, True, False, True]
