"""Runs one scenario with one or two directions, observed by a Recorder.

Invariants: everything that was started is stopped in reverse order, also after an error; a run that is interrupted
still closes its ledger and writes its result.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import Any

from gr_ros2.core.errors import BagError, ConfigError, MiddlewareError, RunError
from gr_ros2.core.files import make_folder, write_whole
from gr_ros2.core.guard import Guard, one_line
from gr_ros2.gr.ends import LiveEnd
from gr_ros2.link.lateness import Lateness
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.middleware import Middleware, Qos
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.record.lateness import lateness_result, modem_lateness
from gr_ros2.record.repetitions import repetition_folder, write_repetitions
from gr_ros2.record.result import RESULT_FILE, LatenessResult, Result, write_result
from gr_ros2.record.trace import Trace, write_trace
from gr_ros2.run.domains import on_own_domains
from gr_ros2.run.load import make_phys, recording
from gr_ros2.run.observers import LiveRun, RunObserver, RunObservers
from gr_ros2.run.outcome import DELIVERED_BAG, Outcome, Progress, phy_numbers
from gr_ros2.run.pulse import Pulse
from gr_ros2.run.recorders import FurtherRecorders, make_recorder
from gr_ros2.run.repeat import repetitions
from gr_ros2.run.robots import halves_of_robots
from gr_ros2.run.scenario import Scenario, dump
from gr_ros2.run.simulated_runner import run_simulated
from gr_ros2.settings.config import robot_of
from gr_ros2.sim.fleet import Fleet
from gr_ros2.sim.publisher import SimPublisher

__all__ = ["DELIVERED_BAG", "Outcome", "Progress", "run_repetitions", "run_scenario"]

REGISTRY_FILE = "registry.csv"
"""Copy of the run's registry, needed to decode its packets later."""

_MATCH_S = 20.0
_POLL_S = 0.05


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


class _Run:
    def __init__(self, scenario: Scenario, out: Path | None, stack: ExitStack, run_observers: RunObservers) -> None:
        # Only a run in real time needs GNU Radio.
        from gr_ros2.run.direction import Direction, ReportDirection, live_ends

        self.config = dump(scenario)
        self.scenario = scenario = on_own_domains(scenario, stack)
        self.registry = scenario.load_registry()
        ways = scenario.directions()
        phys = make_phys(ways, self.registry)
        self.phy = phys[0]
        self.recorder = make_recorder(self.registry, ways)
        self.further = FurtherRecorders(self.registry, ways)
        self.run_observers = run_observers
        self.progress_guard = Guard("progress")
        self.pulse = Pulse()
        stack.callback(self.pulse.close)
        self.interrupted = False
        self.listener: DeliveryRecorder | None = None
        self.sim: SimPublisher | None = None
        try:
            link_observers = Observers[LinkObserver]()
            self.recording = link_observers.add(self.recorder, needed=True)
            link_observers.add(self.further)
            link_observers.add(run_observers)
            common: dict[str, Any] = {
                "observer": link_observers,
                "stack": stack,
                "instrumented": run_observers.instruments,
            }
            live: list[LiveEnd] = []
            if scenario.version:
                any_length = all(phy.any_length for phy in phys)
                live = live_ends(ways, self.registry, any_length=any_length, mcs_table=self.phy.mcs_table)
            ends: Sequence[LiveEnd | None] = live or [None] * (2 + len(scenario.receivers))
            further = [self.further.at(number) for number in range(1, 1 + len(scenario.receivers))]
            forward = Direction(ways[0], self.registry, phys[0], ends, further=further, **common)
            self.directions = [forward]
            if len(ways) > 1:
                self.directions.append(Direction(ways[1], self.registry, phys[1], ends[1::-1], **common))
            self.links = [direction.link for direction in self.directions]
            if scenario.reports is not None:
                common["delay_s"] = scenario.reports.delay_s
                receivers = zip(live[1:], halves_of_robots(ways)[1:], scenario.report_channels(), strict=True)
                for end, halves, channel in receivers:
                    pair, src_id = (live[0], end), robot_of(*halves)
                    reporting = ReportDirection(forward, self.phy, pair, src_id, channel=channel, **common)
                    self.links.append(reporting.link)
            if out is not None:
                self.listener = self._listen(make_folder(out), stack)
            run_observers.run_started(self._live())
            if scenario.bag_path is None:
                self.sim = SimPublisher(Fleet(scenario.sim), self._robots(stack), scenario.duration_s)
                stack.callback(self.sim.close)
        except MiddlewareError as error:
            raise error if isinstance(error, BagError) else RunError(f"{scenario.name}: {error}") from error

    def _live(self) -> LiveRun:
        return LiveRun(
            name=self.scenario.name,
            duration_s=self.scenario.duration_s,
            packet_len=self.scenario.packet_len,
            registry=self.registry,
            topics={(way.src_id, topic_id): name for way in self.directions for name, topic_id in way.topics.items()},
            sources={way.src_id: way.source for way in self.directions},
            links=self.links,
            ledger=self.recorder.ledger,
        )

    def _robots(self, stack: ExitStack) -> dict[int, Middleware]:
        """The graph of every simulated robot: that of its source, or else the graph at the other end of the link."""
        from gr_ros2.run.direction import open_graph

        ids = range(1, self.scenario.sim.robots + 1)
        robots = dict.fromkeys(ids, self.directions[0].output)
        for way in self.directions:
            if way.src_id in robots:
                end = way.scenario.ros_source
                robots[way.src_id] = stack.enter_context(open_graph(self.scenario, end, f"robot_{way.src_id}"))
        return robots

    def _listen(self, out: Path, stack: ExitStack) -> DeliveryRecorder:
        from gr_ros2.run.direction import open_graph

        graphs = {
            stack.enter_context(open_graph(self.scenario, way.scenario.ros_sink, "listener")): way.output_topics()
            for way in self.directions
        }
        listener = DeliveryRecorder(graphs, out / DELIVERED_BAG, recording(self.scenario).texts)
        stack.callback(listener.close)
        return listener

    def execute(self, on_progress: Callable[[Progress], None] | None) -> Outcome:
        scenario = self.scenario
        wall = begin = end = time.monotonic()
        try:
            for link in self.links:
                link.start()
            self._wait_matched()
            begin = end = time.monotonic()
            self.pulse.start()
            for link in self.links:
                link.run_began(begin)
            (self.sim or self.directions[0].input).start()
            while not self._submitted(begin):
                time.sleep(_POLL_S)
                self._report(on_progress, begin)
            end = time.monotonic()
            if self.sim is not None:
                self.sim.stop()
            self._drain(on_progress, begin)
        except KeyboardInterrupt:
            self.interrupted = True
            end = time.monotonic()
        except MiddlewareError as error:
            raise error if isinstance(error, BagError) else RunError(f"{scenario.name}: {error}") from error
        drained = not self.interrupted and self._empty()
        self.pulse.close()
        stopped = time.monotonic()
        for link in self.links:
            link.stop()
        self.run_observers.settle()
        self._check_recorders()
        self._check_alone()
        played = end - begin
        if scenario.duration_s and not self.interrupted:
            played = min(scenario.duration_s, played) if scenario.bag_path is not None else scenario.duration_s
        topics = self.recorder.finish(played, end, drained)
        names = {
            name: other for way in self.directions for name, other in zip(way.topics, way.output_topics(), strict=True)
        }
        trace = self.recorder.trace(begin, end, names)
        numbers = partial(phy_numbers, self.phy, len(self.directions))
        result = Result(
            scenario=scenario.name,
            seed=scenario.seed,
            duration_s=played,
            config=self.config,
            topics=topics,
            receivers=self.further.finish(played, end, drained, numbers),
            packets=self.recorder.ledger.packets(),
            phy=numbers(self.recorder),
            wall_s=time.monotonic() - wall,
            interrupted=self.interrupted,
            counters=self._counters(),
            lateness=self._lateness(begin, stopped, trace),
            incomplete=tuple(self._incomplete()),
        )
        return Outcome(result, trace)

    def _lateness(self, begin: float, end: float, trace: Trace) -> LatenessResult | None:
        """How late the computer was; None where the link waits for the computer."""
        if self.scenario.time == "unthrottled":
            return None
        parts: dict[str, list[Lateness]] = {"threads": [self.pulse.lateness], "gate": [], "modem": []}
        for way in self.directions:
            gate = way.link.gate_lateness()
            if gate is not None:
                parts["gate"].append(gate)
                parts["modem"].append(modem_lateness(way.link.passed_at(), self.recorder.received_at(way.src_id)))
        return lateness_result(parts, begin, end, trace)

    def _wait_matched(self) -> None:
        """Wait until all publishers and subscribers of both graphs have found each other, so that no message is
        missed."""
        limit = time.monotonic() + _MATCH_S
        while time.monotonic() < limit:
            heard = self.listener is None or self.listener.matched()
            if heard and (self.sim is None or self._sim_matched(self.sim)):
                return
            time.sleep(_POLL_S)
        raise RunError(
            f"{self.scenario.name}: publishers and subscribers did not find each other within {_MATCH_S:g} s; "
            "is the loopback interface up, and the domain free?"
        )

    def _sim_matched(self, sim: SimPublisher) -> bool:
        wanted = [name for way in self.directions for name in way.topics if name in sim.publishers]
        return all(sim.publishers[name].matched() for name in wanted) and all(
            way.source.matched for way in self.directions
        )

    def _submitted(self, begin: float) -> bool:
        if self.sim is not None:
            return self.sim.finished
        bag = self.directions[0].input
        assert isinstance(bag, BagMiddleware)
        if bag.error is not None:
            raise bag.error
        over = bool(self.scenario.duration_s) and time.monotonic() - begin >= self.scenario.duration_s
        return bag.finished or over

    def _drain(self, on_progress: Callable[[Progress], None] | None, begin: float) -> None:
        """Let the link deliver what it holds, for at most ``drain_s``. With time unthrottled, each further message
        restarts that time."""
        limit = time.monotonic() + self.scenario.drain_s
        before = (0, 0)
        while time.monotonic() < limit and self._unresolved():
            time.sleep(_POLL_S)
            self._report(on_progress, begin)
            if self.scenario.time == "unthrottled" and (now := self.recorder.progress()) != before:
                before, limit = now, time.monotonic() + self.scenario.drain_s

    def _empty(self) -> bool:
        """Whether nothing is left in any direction."""
        return all(way.empty(bool(self._unresolved())) for way in self.directions)

    def _check_recorders(self) -> None:
        self.recording.check()
        self.further.check()

    def _check_alone(self) -> None:
        """Check that the links sent only what this run's robots published, and that nobody else published what comes
        out of them.

        :raises RunError: when another program is on one of the graphs
        """
        heard = {} if self.listener is None else dict(self.listener.received)
        for way in self.directions:
            sent = {name: topic["submitted"] for name, topic in way.source.stats()["topics"].items()}
            own = {} if self.sim is None else self.sim.published
            self._compare(way.input, sent, own, own.keys())
            came_out = {name: topic["delivered"] for name, topic in way.sink.stats()["topics"].items()}
            self._compare(way.output, heard, came_out, way.output_topics())

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

    def _unresolved(self) -> int:
        """Messages whose result is open, at all receivers together."""
        return self.recorder.ledger.unresolved() + self.further.unresolved()

    def _report(self, on_progress: Callable[[Progress], None] | None, begin: float) -> None:
        self._check_recorders()
        if on_progress is not None:
            sent, delivered = self.recorder.progress()
            domains = (self.directions[0].input.domain_id, self.directions[0].output.domain_id)
            now = Progress(time.monotonic() - begin, self.scenario.duration_s, sent, delivered, domains)
            self.progress_guard(on_progress, now)

    def _incomplete(self) -> list[str]:
        """What observers and the bag of delivered messages missed. The bag is closed first."""
        if self.listener is None:
            return self.run_observers.incomplete()
        self.listener.close()
        return [*self.run_observers.incomplete(), *self.listener.incomplete()]

    def _counters(self) -> dict[str, Any]:
        forward, *back = (way.counters() for way in self.directions)
        heard = {} if self.listener is None else dict(self.listener.received)
        unheard = {} if self.listener is None else self.listener.lost()
        return {
            **forward,
            **({"back": back[0]} if back else {}),
            "listener": heard,
            **({"listener_lost": unheard} if unheard else {}),
        }
