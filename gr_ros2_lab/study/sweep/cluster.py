"""Runs on Dask: worker processes of this machine, or an existing cluster.

Invariants: a run that ends in an error, or that crashes its process, does not affect other runs; runs of a worker that
is lost are given to another worker; Ctrl-C reaches this process and never the workers, which end when this process
tells them to.
"""

from __future__ import annotations

import fcntl
import logging
import os
import signal
import tempfile
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster, as_completed, get_worker, wait
from distributed.client import FuturesCancelledError
from distributed.scheduler import KilledWorker

from gr_ros2 import __version__
from gr_ros2.core.errors import ConfigError, GrRos2Error, RunError
from gr_ros2.core.forks import FORKS, interrupts_ignored, load_for_forks
from gr_ros2.settings.files import REGISTRY_DIR, find_registry
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import Scenario, dump, scenario_from
from gr_ros2_lab.study.sweep.store import without_registry

RUNS_PER_PROCESS = 200
"""Runs after which a worker is replaced. A system has 4096 shared memory segments. This limit protects against
flowgraphs that do not free theirs at their end, which has happened before."""

_CONNECT_S = 15.0
_WORKERS_S = 60.0


@dataclass(frozen=True)
class Failed:
    """A run that gave no result, and the reason in one line."""

    reason: str


@contextmanager
def local_cluster(processes: int) -> Iterator[LocalCluster]:
    """Worker processes of one thread each, on this machine, reachable from this machine only.

    A worker that is lost is replaced, however long its successor takes to start. Dask would give up both after
    ``lost-worker-timeout`` (15 s), which a busy machine exceeds, and a sweep without workers waits forever.
    """
    settings = {
        "distributed.deploy.lost-worker-timeout": "365 days",
        "distributed.worker.multiprocessing-method": FORKS.get_start_method(),
    }
    with dask.config.set(settings):
        with interrupts_ignored():
            _load_for_workers()
            cluster = LocalCluster(
                n_workers=processes,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address=None,
                # Dask starts an HTTP server in any case. It must not take the default port of a Dask dashboard.
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                silence_logs=logging.CRITICAL,  # errors are returned as results
            )
        with cluster:
            yield cluster


def _load_for_workers() -> None:
    """Start the process that workers are forked from. It loads what each would load for a second of processor time, in
    the environment that Dask gives to its workers: one thread for linear algebra."""
    before = dict(os.environ)
    os.environ.update(
        {key: str(value) for key, value in dask.config.get("distributed.nanny.pre-spawn-environ").items()}
    )
    try:
        load_for_forks(__name__)
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def local_workers(processes: int) -> Iterator[Client]:
    """A client of this many worker processes on this machine."""
    with local_cluster(processes) as cluster, Client(cluster) as client:
        yield client


@contextmanager
def remote_workers(address: str) -> Iterator[Client]:
    """A client of the workers of an existing cluster.

    :param address: of its scheduler, such as tcp://10.0.0.1:8786
    :raises ConfigError: when no scheduler answers there, or a worker does not have this version of gr-ros2
    """
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise ConfigError(
            f"--scheduler {address}: no Dask scheduler answers ({str(error) or 'timeout'}); "
            "start one with: dask scheduler"
        ) from error
    with client:
        _check_workers(client, address)
        yield client


def run_all(client: Client, scenarios: Mapping[str, Scenario]) -> Generator[tuple[str, Result | Failed]]:
    """Run scenarios in any order, and yield each result when its run ends. If the caller stops early, the remaining
    runs are cancelled.

    :param scenarios: by the key that is yielded with the result
    :raises RunError: when the cluster is lost
    """
    client.forward_logging("gr_ros2")  # log messages of workers appear in this process
    futures = {
        client.submit(run_one, _portable(scenario), __version__, key=f"gr-ros2-{key}", pure=False): key
        for key, scenario in scenarios.items()
    }
    try:
        for future in as_completed(list(futures)):
            if future.status == "lost" and client.status == "running":
                # The worker that had the result is lost, and another worker repeats the run.
                with suppress(FuturesCancelledError):
                    wait(future)
            yield futures[future], _outcome(future)
            future.release()
    finally:
        if client.status == "running":
            client.cancel(list(futures), force=True)


def run_one(values: Mapping[str, Any], version: str) -> Result | Failed:
    """Execute one run in a worker. A run in real time has the machine for itself."""
    try:
        if version != __version__:
            raise ConfigError(f"a worker has gr-ros2 {__version__}, the sweep {version}; install the same")
        scenario = scenario_from({**values, "registry": find_registry(values["registry"], Path())})
        _make_room(scenario)
        with alone_on_this_machine(scenario):
            return run_scenario(scenario).result
    except GrRos2Error as error:
        return Failed(str(error))


_flowgraphs = count(1)


def _make_room(scenario: Scenario) -> None:
    """End a worker that has run many flowgraphs. Dask then starts a new worker and gives it the run."""
    if scenario.time == "packets" or next(_flowgraphs) <= RUNS_PER_PROCESS:
        return
    with suppress(ValueError):  # not in a worker
        get_worker()
        os.kill(os.getpid(), signal.SIGKILL)


def _portable(scenario: Scenario) -> dict[str, Any]:
    """The settings of a scenario for a machine on which gr-ros2 may be installed in another folder."""
    path = Path(scenario.registry)
    return {**without_registry(dump(scenario)), "registry": path.name if path.parent == REGISTRY_DIR else str(path)}


def _outcome(future: Any) -> Result | Failed:
    if future.status == "finished":
        outcome: Result | Failed = future.result()
        return outcome
    if future.status in ("cancelled", "lost"):
        raise RunError("the Dask cluster went away; the same command continues with what is left")
    error = future.exception()
    if isinstance(error, KilledWorker):
        return Failed("the process that ran it ended, again and again: out of memory, or a crash in the flowgraph")
    return Failed(f"{type(error).__name__}: {error}")


def _check_workers(client: Client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_WORKERS_S)
    except TimeoutError as error:
        raise ConfigError(
            f"--scheduler {address}: has no workers; start one with: dask worker {address} --nthreads 1"
        ) from error
    threads = client.nthreads()
    crowded = next((worker for worker, number in threads.items() if number > 1), None)
    if crowded is not None:
        raise ConfigError(
            f"--scheduler {address}: worker {crowded} has {threads[crowded]} threads, and a flowgraph needs a process "
            "to itself; start workers with --nthreads 1"
        )

    def version_there() -> str:
        try:
            import gr_ros2
        except ImportError:
            return ""
        return gr_ros2.__version__

    # A function inside a function is sent as code, so a worker without gr_ros2 can run it.
    for worker, version in client.run(version_there).items():
        if version != __version__:
            raise ConfigError(
                f"--scheduler {address}: worker {worker} has {version or 'no gr-ros2'}, here is {__version__}; "
                "install the same there"
            )


@contextmanager
def alone_on_this_machine(scenario: Scenario) -> Iterator[None]:
    """Lock this machine for a run in real time. Such a run needs the whole computer and the scenario's DDS domains, so
    only one of them runs at a time."""
    if scenario.simulated:
        yield
        return
    path = Path(tempfile.gettempdir()) / f"gr-ros2-{os.getuid()}.lock"
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # released when the file is closed, also at the end of the process
        yield
