"""Runs a sweep: workers do the runs that are missing in its folder, and each result is stored when its run ends.

Invariants: if a sweep ends early, for any reason, all finished runs are kept, and the next call does only the others;
tables, figures and page are made from the results that exist.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.study.sweep.cluster import Failed, local_workers, remote_workers, run_all
from gr_ros2_lab.study.sweep.definition import SweepPlan
from gr_ros2_lab.study.sweep.store import Store, run_key
from gr_ros2_lab.study.sweep.summaries import Results
from gr_ros2_lab.study.sweep.sweep_page import write_sweep


@dataclass(frozen=True)
class SweepProgress:
    """Progress of a sweep: all runs, runs with a result, how many of these were already in the folder, and failed
    runs."""

    total: int
    done: int
    found: int
    failed: int


@dataclass(frozen=True)
class SweepOutcome:
    """The outcome of a sweep.

    :param results: by cell number and repetition
    :param failures: runs without a result, one line each
    :param files: what was written, the page first
    :param interrupted: by KeyboardInterrupt
    """

    results: Results
    failures: tuple[str, ...]
    files: tuple[Path, ...]
    interrupted: bool


def run_sweep(
    plan: SweepPlan,
    out: Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    fresh: bool = False,
    on_progress: Callable[[SweepProgress], None] | None = None,
) -> SweepOutcome:
    """Run what is missing of a sweep. KeyboardInterrupt stops it.

    :param out: folder of the sweep, made if missing; a sweep that was stopped is continued
    :param scheduler: address of a Dask cluster; None starts processes on this machine
    :param workers: number of processes on this machine; None starts one per core, or one for runs in real time
    :param fresh: run everything again
    :param on_progress: called at the start and after every run
    :raises ConfigError: when the folder cannot be used, nothing answers at ``scheduler``, or ``workers`` does not fit
    :raises RunError: when the cluster is lost
    """
    count = _workers(plan, scheduler, workers)
    store = Store(out)
    places: dict[str, list[tuple[int, int]]] = {}
    scenarios: dict[str, Scenario] = {}
    for cell in plan.cells:
        for repetition, scenario in enumerate(cell.runs):
            key = run_key(scenario)
            scenarios[key] = scenario  # two cells may have the same settings; these run once
            places.setdefault(key, []).append((cell.number, repetition))
    found = {} if fresh else {key: kept for key in scenarios if (kept := store.find(key)) is not None}
    done, failed, interrupted = dict(found), dict[str, str](), False

    def report() -> None:
        if on_progress is not None:
            on_progress(SweepProgress(len(scenarios), len(done), len(found), len(failed)))

    report()
    # Random order: the estimate of the time left then uses all kinds of cells, and neighbouring cells do not wait for
    # the same table of losses.
    order = random.Random(0).sample(list(scenarios), len(scenarios))
    missing = {key: scenarios[key] for key in order if key not in done}
    try:
        if missing:
            crew = local_workers(min(count, len(missing))) if scheduler is None else remote_workers(scheduler)
            with crew as client, closing(run_all(client, missing)) as ended:
                for key, outcome in ended:
                    if isinstance(outcome, Failed):
                        failed[key] = outcome.reason
                    elif not outcome.interrupted:
                        store.keep(key, outcome)
                        done[key] = outcome
                    report()
    except KeyboardInterrupt:
        interrupted = True
    results = {place: done[key] for key, at in places.items() for place in at if key in done}
    labels = {cell.number: cell.label for cell in plan.cells}
    failures = [
        f"cell {number} ({labels[number]}), repetition {repetition}: {reason}"
        for key, reason in failed.items()
        for number, repetition in places[key]
    ]
    # After Ctrl-C the command ends at once; drawing would take seconds.
    files = [] if interrupted or not results else write_sweep(plan, results, failures, out)
    return SweepOutcome(results, tuple(failures), tuple(files), interrupted)


def _workers(plan: SweepPlan, scheduler: str | None, workers: int | None) -> int:
    if scheduler is not None and workers is not None:
        raise ConfigError(f"workers = {workers}: the cluster at {scheduler} has its own; leave it out")
    if plan.real_time:
        if (workers or 1) > 1:
            raise ConfigError(f"workers = {workers}: runs in real time need the machine for themselves; leave it out")
        return 1
    return workers or len(os.sched_getaffinity(0))
