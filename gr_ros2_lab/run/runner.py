"""Runs a scenario, in real time here, observed by a Recorder.

Invariants: everything that was started is stopped in reverse order, also after an error; a run that is interrupted
still closes its ledger and writes its result.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np

from gr_ros2.core.errors import BagError, ConfigError, MiddlewareError, RunError
from gr_ros2.core.files import make_folder, write_whole
from gr_ros2.core.guard import Guard, one_line
from gr_ros2.core.watch import wait_until
from gr_ros2.link.fates import Fate
from gr_ros2.link.lateness import Lateness
from gr_ros2.middleware import Middleware, Qos, join
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.observe.observers import RunObserver, RunObservers
from gr_ros2.settings.config import ChannelConfig, Traffic
from gr_ros2_lab.record.repetitions import repetition_folder, write_repetitions
from gr_ros2_lab.record.result import RESULT_FILE, LatenessResult, Result, write_result
from gr_ros2_lab.record.trace import Trace, write_trace
from gr_ros2_lab.run.domains import on_own_domains
from gr_ros2_lab.run.load import make_phy, recording
from gr_ros2_lab.run.outcome import DELIVERED_BAG, Outcome, Progress
from gr_ros2_lab.run.recorders import RunRecords
from gr_ros2_lab.run.robots import surroundings
from gr_ros2_lab.run.scenario import Scenario, changed
from gr_ros2_lab.run.simulated_runner import run_simulated
from gr_ros2_lab.run.task_run import TaskRun
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.publisher import SimPublisher
from gr_ros2_lab.sim.sim_settings import SimSettings

__all__ = ["DELIVERED_BAG", "Outcome", "Progress", "run_repetitions", "run_scenario"]

REGISTRY_FILE = "registry.csv"
"""Copy of the run's registry, needed to decode its packets later."""

_MATCH_S = 20.0
_CONTROLLERS_S = 60.0
"""s within which controllers have to be there. Somebody starts them by hand, once the run says on which graphs."""
_POLL_S = 0.05
AFTER_S = 1.0
"""s. After this time, queues that became full in a late moment are empty again, and incomplete messages have been given
up."""
PERIOD_S = 0.02


class Pulse:
    """Measures how late the threads of this process are scheduled, from ``start`` to ``close``: a thread that does
    nothing else wakes up periodically and checks the time."""

    def __init__(self) -> None:
        self.lateness = Lateness()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="gr-ros2-pulse", daemon=True)

    def start(self) -> None:
        """Begin. To be called only once."""
        self._thread.start()

    def close(self) -> None:
        """End. Idempotent; may also be called before the start."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join()

    def _beat(self) -> None:
        while True:
            due = time.monotonic() + PERIOD_S
            if self._over.wait(PERIOD_S):
                return
            self.lateness.happened(due, time.monotonic())


def lateness_result(parts: Mapping[str, Iterable[Lateness]], begin: float, end: float, trace: Trace) -> LatenessResult:
    """The lateness of all parts together, and the messages that were submitted in late moments or up to ``AFTER_S``
    after them. That proves no cause; so the share of all messages that were submitted at such times is told too.

    :param parts: measurements of each part, by name; a part without measurements is left out
    :param begin: s, when submission began; the times of the trace count from there
    :param end: s, when the run was over
    """
    measured = {name: list(several) for name, several in parts.items()}
    worst = {name: max(one.worst for one in several) for name, several in measured.items() if several}
    found = sorted(
        (max(due, begin) - begin, happened - begin)
        for several in measured.values()
        for one in several
        for due, happened in one.moments
        if happened > begin
    )
    moments: list[tuple[float, float]] = []
    for due, happened in found:
        if moments and due <= moments[-1][1]:
            moments[-1] = moments[-1][0], max(happened, moments[-1][1])
        else:
            moments.append((due, happened))
    sent = lost = sent_after = lost_after = 0
    for messages in trace.messages():
        submitted = ~np.isnan(messages.t_sent)
        gone = submitted & ~messages.delivered & (messages.fate != Fate.IN_FLIGHT)
        after = np.zeros(len(submitted), dtype=bool)
        for due, happened in moments:
            after |= (messages.t_sent >= due) & (messages.t_sent <= happened + AFTER_S)
        sent, sent_after = sent + int(submitted.sum()), sent_after + int(after.sum())
        lost, lost_after = lost + int(gone.sum()), lost_after + int((gone & after).sum())
    return LatenessResult(
        worst_s=worst,
        moments=len(moments),
        share=sum(happened - due for due, happened in moments) / max(end - begin, 1e-9),
        lost=lost,
        lost_after=lost_after,
        sent=sent,
        sent_after=sent_after,
    )


class DeliveryRecorder:
    """An independent subscriber on the receiving graphs, which records what is published there in one bag.

    :param graphs: name and type of the topics to subscribe, by graph
    :param definitions: ``.msg`` texts by type name; types that are not in it use the definitions of ROS
    """

    def __init__(
        self, graphs: Mapping[Middleware, Mapping[str, str]], bag: Path, definitions: Mapping[str, str]
    ) -> None:
        self.received: Counter[str] = Counter()
        self._closed = False
        self._guard = Guard("bag of delivered messages")
        # If this subscriber waited for the disk, DDS would delay the link's own publisher.
        self._bag = BagMiddleware(path=bag, mode="write", definitions=definitions, lossless=False)
        self._publishers = {
            name: self._bag.advertise(name, kind, Qos()) for topics in graphs.values() for name, kind in topics.items()
        }
        self._subscriptions = {
            name: graph.subscribe(name, kind, Qos("reliable", None, 0), partial(self._take, name))
            for graph, topics in graphs.items()
            for name, kind in topics.items()
        }

    def _take(self, name: str, payload: bytes) -> None:
        self.received[name] += 1
        self._guard(self._publishers[name].publish, payload)

    def matched(self) -> bool:
        """Whether every topic has found its publisher."""
        return all(subscription.matched() for subscription in self._subscriptions.values())

    def lost(self) -> dict[str, int]:
        """Messages of each topic that were published but that the graph lost on the way here; {} if none was lost."""
        return {name: subscription.lost for name, subscription in self._subscriptions.items() if subscription.lost}

    def close(self) -> None:
        """Stop listening and finish the bag. Idempotent."""
        if not self._closed:
            self._closed = True
            for subscription in self._subscriptions.values():
                subscription.close()
            self._guard.last(self._bag.close)

    def incomplete(self) -> list[str]:
        """What is missing in the bag, as one line; empty if nothing is missing. To be called after :meth:`close`."""
        missed = sum(self._bag.counters.values())
        if self._guard.error is not None:  # a storage writes in chunks: earlier messages may be missing too
            return [f"{one_line(self._guard.error)}; any of its {self.received.total()} messages may be missing"]
        return [f"bag {self._bag.path}: slower than the link; {missed} messages are missing"] if missed else []


def run_scenario(
    scenario: Scenario,
    out: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    observers: Sequence[RunObserver] = (),
) -> Outcome:
    """Run a scenario to its end, or until KeyboardInterrupt.

    :param out: folder for ``result.json``, the tables of the trace, the registry and the bag of delivered messages,
        made if missing; None writes nothing
    :param on_progress: called about 20 times a second
    :param observers: where one has ``instruments``, the link is built so that its channel can be changed and
        its signal observed
    :raises ConfigError: when the scenario cannot be set up
    :raises RunError: when it fails while it runs
    """
    if out is not None and (out / DELIVERED_BAG).exists():
        raise ConfigError(f"{out}: holds a run already; choose another folder")
    run_observers = RunObservers(observers, threaded=not scenario.simulated)
    outcome: Outcome | None = None
    try:
        if not scenario.simulated:
            with ExitStack() as stack:
                outcome = _Run(scenario, out, stack, run_observers).execute(on_progress)
        else:
            outcome = run_simulated(scenario, out, on_progress, run_observers)
    finally:
        run_observers.run_ended(None if outcome is None else outcome.result)
    if out is not None:
        write_trace(outcome.trace, out)
        if outcome.team is not None:
            outcome.team.write(out)
        write_whole(out / REGISTRY_FILE, scenario.registry, copyfile)
        write_result(outcome.result, out / RESULT_FILE)
    return outcome


def run_repetitions(
    scenario: Scenario,
    out: Path,
    on_start: Callable[[], Callable[[Progress], None] | None] = lambda: None,
    observers: Sequence[RunObserver] = (),
) -> list[Result]:
    """Run every repetition of a scenario, each into a folder of its own. KeyboardInterrupt stops the series.

    :param out: folder for ``rep-0``, ``rep-1``, ... and ``repetitions.json``, made if missing
    :param on_start: called before each run; returns the ``on_progress`` of that run
    :param observers: see :func:`run_scenario`
    :return: the results of the runs that were completed
    :raises ConfigError: when the scenario cannot be set up, or the folder already holds a run
    :raises RunError: when a run fails while it runs
    """
    results: list[Result] = []
    for k, one in enumerate(repetitions(scenario)):
        try:
            result = run_scenario(one, repetition_folder(out, k), on_start(), observers).result
        except KeyboardInterrupt:  # between two runs: handled as during a run
            break
        if result.interrupted:
            break
        results.append(result)
        write_repetitions(results, out)  # after each run, so that the file is complete even if the next run fails
    return results


_Seeded = Traffic | ChannelConfig | SimSettings
_SEEDED: tuple[type[_Seeded], ...] = (Traffic, ChannelConfig, SimSettings)
"""Settings with a seed."""


def repetitions(scenario: Scenario) -> Iterator[Scenario]:
    """The scenario once per repetition, each with its own seeds: in repetition k (from 0) every seed is k higher."""
    for k in range(scenario.repetitions):
        yield replace(changed(scenario, _SEEDED, partial(_reseeded, by=k)), repetitions=1)


def _reseeded(part: _Seeded, by: int) -> _Seeded:
    return replace(part, seed=part.seed + by)


class _Run:
    def __init__(self, scenario: Scenario, out: Path | None, stack: ExitStack, run_observers: RunObservers) -> None:
        self.registry = registry = scenario.load_registry()
        phy = make_phy(scenario, registry)
        self.task = TaskRun(scenario, registry) if scenario.task else None
        around = surroundings(scenario, phy.sample_rate, self.task)
        self.records = RunRecords(scenario, registry, phy, around, run_observers=run_observers, task=self.task)
        self.scenario, robots = scenario, on_own_domains(scenario, stack)
        self.run_observers = run_observers
        self.progress_guard = Guard("progress")
        self.pulse = Pulse()
        stack.callback(self.pulse.close)
        self.interrupted = False
        self.listener: DeliveryRecorder | None = None
        self.sim: SimPublisher | None = None
        try:
            from gr_ros2_lab.run.live import LiveRobots  # only a run in real time needs GNU Radio

            self.live = LiveRobots(scenario, robots, registry, phy, around, records=self.records, stack=stack)
            self.clock = self.live.clock
            if out is not None:
                self.listener = self._listen(make_folder(out), stack)
            live = self.live
            run_observers.run_started(self.records.live_run(self.clock, live.sources, live.links, live.alarms))
            if scenario.bag_path is None:
                fleet = self.task or Fleet(scenario.sim)
                fleet.drive_ahead(scenario.duration_s)
                graphs = {src_id: self.live.graph_of(src_id, stack) for src_id in fleet.robot_ids}
                self.sim = SimPublisher(fleet, graphs, scenario.duration_s, clock=self.clock)
                stack.callback(self.sim.close)
                if self.task is not None:
                    self.task.join(graphs, self.clock)
        except MiddlewareError as error:
            raise error if isinstance(error, BagError) else RunError(f"{scenario.name}: {error}") from error

    def _listen(self, out: Path, stack: ExitStack) -> DeliveryRecorder:
        graphs = {
            stack.enter_context(join(robot.settings.config.graph, "gr_ros2_listener")): robot.heard
            for robot in self.live.recorded
            if robot.settings.takes
        }
        listener = DeliveryRecorder(graphs, out / DELIVERED_BAG, recording(self.scenario).texts)
        stack.callback(listener.close)
        return listener

    def execute(self, on_progress: Callable[[Progress], None] | None) -> Outcome:
        scenario = self.scenario
        wall = time.monotonic()
        begin = end = self.clock()
        try:
            self.live.start()
            self._wait_matched(on_progress)
            begin = end = self.clock()
            self.pulse.start()
            if self.task is not None:
                self.task.begin(begin)
            self.live.began()
            (self.sim or self.live.robots[0].graph).start()
            while not self._submitted(begin):
                time.sleep(_POLL_S)
                self._report(on_progress, begin)
            end = self.clock()
            if self.sim is not None:
                self.sim.stop()
            self._drain(on_progress, begin)
        except KeyboardInterrupt:
            self.interrupted = True
            end = self.clock()
        except MiddlewareError as error:
            raise error if isinstance(error, BagError) else RunError(f"{scenario.name}: {error}") from error
        drained = not self.interrupted and self.live.empty(bool(self.records.unresolved()))
        self.pulse.close()
        stopped = self.clock()
        self.live.stop()
        self.run_observers.settle()
        self.records.check()
        self._check_alone()
        played = end - begin
        if scenario.duration_s and not self.interrupted:
            ends = scenario.bag_path is not None or (self.task is not None and self.task.over)
            played = min(scenario.duration_s, played) if ends else scenario.duration_s
        return self.records.outcome(
            begin=begin,
            end=end,
            played=played,
            drained=drained,
            channels=self.live.channels,
            began=wall,
            lateness=partial(self._lateness, begin, stopped),
            interrupted=self.interrupted,
            counters=self._counters(),
            incomplete=tuple(self._incomplete()),
        )

    def _lateness(self, begin: float, end: float, trace: Trace) -> LatenessResult | None:
        """How late the computer was; None where the links wait for the computer."""
        parts = self.live.lateness()
        if parts is None:
            return None
        return lateness_result({"threads": [self.pulse.lateness], **parts}, begin, end, trace)

    def _wait_matched(self, on_progress: Callable[[Progress], None] | None) -> None:
        """Wait until all publishers and subscribers of all graphs have found each other, so that no message is missed,
        and the robots their controllers."""
        self._wait(
            lambda: (self.listener is None or self.listener.matched()) and self._sim_matched(),
            _MATCH_S,
            "publishers and subscribers did not find each other",
            "is the loopback interface up, and the domain free?",
        )
        task = self.task
        if task is not None and (missing := task.uncommanded()):
            self._report(on_progress, self.clock())  # it says on which graphs controllers are to start
            what = f"nobody publishes {', '.join(missing)}"
            remedy = "start the controllers on the graphs of their robots, or set controller: task"
            self._wait(lambda: not task.uncommanded(), _CONTROLLERS_S, what, remedy)

    def _wait(self, condition: Callable[[], bool], most_s: float, otherwise: str, remedy: str) -> None:
        if not wait_until(condition, most_s, look_s=_POLL_S):
            raise RunError(f"{self.scenario.name}: {otherwise} within {most_s:g} s; {remedy}")

    def _sim_matched(self) -> bool:
        if (sim := self.sim) is None:
            return True
        wanted = [name for robot in self.live.offering for name in robot.topics if name in sim.publishers]
        matched = all(sim.publishers[name].matched() for name in wanted)
        return matched and all(source.matched for source in self.live.sources.values())

    def _submitted(self, begin: float) -> bool:
        if self.sim is not None:
            return self.sim.finished
        bag = self.live.robots[0].graph
        assert isinstance(bag, BagMiddleware)
        if bag.error is not None:
            raise bag.error
        over = bool(self.scenario.duration_s) and self.clock() - begin >= self.scenario.duration_s
        return bag.finished or over

    def _drain(self, on_progress: Callable[[Progress], None] | None, begin: float) -> None:
        """Let the link deliver what it holds, for at most ``drain_s``."""
        until = time.monotonic() + self.scenario.drain_s
        while self.records.unresolved() and time.monotonic() < until:
            time.sleep(_POLL_S)
            self._report(on_progress, begin)

    def _check_alone(self) -> None:
        """Check that the links sent only what this run's robots published, and that nobody else published what comes
        out of them.

        :raises RunError: when another program is on one of the graphs
        """
        heard = {} if self.listener is None else dict(self.listener.received)
        for source in self.live.sources.values():
            sent = {name: topic["submitted"] for name, topic in source.stats()["topics"].items()}
            own = {} if self.sim is None else self.sim.published
            self._compare(source.middleware, sent, own, own.keys())
        for robot in self.live.recorded:
            came_out = {name: topic["delivered"] for name, topic in robot.link.sink.stats()["topics"].items()}
            self._compare(robot.graph, heard, came_out, robot.heard)

    def _compare(
        self, graph: Middleware, found: Mapping[str, int], own: Mapping[str, int], names: Iterable[str]
    ) -> None:
        for name in names:
            if found.get(name, 0) > own.get(name, 0):
                raise RunError(
                    f"{self.scenario.name}: {found[name]} messages were received on {name} and this run published "
                    f"{own.get(name, 0)}: another program publishes there, on ROS domain {graph.domain_id}; end it, or "
                    "set another domain_id"
                )

    def _report(self, on_progress: Callable[[Progress], None] | None, begin: float) -> None:
        self.records.check()
        self.live.check()
        if on_progress is not None:
            sent, delivered = self.records.progress()
            now = Progress(self.clock() - begin, self.scenario.duration_s, sent, delivered, self.live.graphs)
            self.progress_guard(on_progress, now)

    def _incomplete(self) -> list[str]:
        """What observers and the bag of delivered messages missed. The bag is closed first."""
        if self.listener is None:
            return self.run_observers.incomplete()
        self.listener.close()
        return [*self.run_observers.incomplete(), *self.listener.incomplete()]

    def _counters(self) -> dict[str, Any]:
        heard = {} if self.listener is None else dict(self.listener.received)
        unheard = {} if self.listener is None else self.listener.lost()
        return {
            **self.live.counters(),
            "listener": heard,
            **({"commands": dict(self.task.commands)} if self.task is not None else {}),
            **({"listener_lost": unheard} if unheard else {}),
        }
