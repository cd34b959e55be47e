"""Runs one scenario: input -> ROS Source -> PHY and channel -> ROS Sink -> output, watched by a Recorder.

Laws: everything started is stopped in reverse order whatever happens; a run that is interrupted still closes its books
and writes its result; the only path from input graph to output graph is the link.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from gr_ros2.errors import BagError, ConfigError, MiddlewareError, RunError
from gr_ros2.experiment.load import make_phy, source_names
from gr_ros2.experiment.recorder import Recorder
from gr_ros2.experiment.result import RESULT_FILE, Result, write_result
from gr_ros2.experiment.scenario import Scenario, dump
from gr_ros2.experiment.trace import Trace, write_trace
from gr_ros2.experiment.watch import Fanout, LiveRun, Watcher
from gr_ros2.gr import RosSink, RosSource
from gr_ros2.middleware import MIDDLEWARE, Middleware, Qos
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.bag_files import bag_topics
from gr_ros2.phy import Phy
from gr_ros2.phy.loopback import LoopbackLink
from gr_ros2.sim.fleet import Fleet
from gr_ros2.sim.publisher import SimPublisher

DELIVERED_BAG = "delivered"
"""Folder of the bag with what came out on the receiving graph."""

_MATCH_S = 20.0
_POLL_S = 0.05
_QUIET_S = 0.3
"""A PHY that has given no packet for so long, with nothing waiting, is empty."""


@dataclass(frozen=True)
class Progress:
    """Where a run is: s since it began, s it takes (0 = until the bag ends), messages sent and delivered."""

    elapsed_s: float
    duration_s: float
    sent: int
    delivered: int


@dataclass
class Outcome:
    """What a run gives back: the result, and what happened message by message."""

    result: Result
    trace: Trace


class Listener:
    """An independent subscriber on the receiving graph, which records what comes out there as a bag."""

    def __init__(self, graph: Middleware, bag: Path, topics: dict[str, str]) -> None:
        self.received: Counter[str] = Counter()
        self._bag = BagMiddleware(path=bag, mode="write")
        self._publishers = {name: self._bag.advertise(name, kind, Qos()) for name, kind in topics.items()}
        self._subscriptions = [
            graph.subscribe(name, kind, Qos("reliable", None, 0), partial(self._take, name))
            for name, kind in topics.items()
        ]

    def _take(self, name: str, payload: bytes) -> None:
        self._publishers[name].publish(payload)
        self.received[name] += 1

    def matched(self) -> bool:
        """Whether every topic has found its publisher."""
        return all(subscription.matched() for subscription in self._subscriptions)

    def close(self) -> None:
        """Stop listening and finish the bag."""
        for subscription in self._subscriptions:
            subscription.close()
        self._bag.close()


def run_scenario(
    scenario: Scenario,
    out: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    watchers: Sequence[Watcher] = (),
) -> Outcome:
    """Run a scenario to its end, or until KeyboardInterrupt.

    :param out: folder for ``result.json``, the tables of the trace and the bag of delivered messages, made if missing;
        None writes nothing
    :param on_progress: called about 20 times a second
    :param watchers: onlookers; with one, the link is built so that its channel can be changed and its signal seen
    :raises ConfigError: when the scenario cannot be set up
    :raises RunError: when it fails under way
    """
    if out is not None and (out / DELIVERED_BAG).exists():
        raise ConfigError(f"{out}: holds a run already; choose another folder")
    outcome: Outcome | None = None
    try:
        with ExitStack() as stack:
            outcome = _Run(scenario, out, stack, watchers).execute(on_progress)
    finally:
        for watcher in watchers:
            watcher.run_ended(None if outcome is None else outcome.result)
    if out is not None:
        write_trace(outcome.trace, out)
        write_result(outcome.result, out / RESULT_FILE)
    return outcome


class _Run:
    def __init__(
        self, scenario: Scenario, out: Path | None, stack: ExitStack, watchers: Sequence[Watcher] = ()
    ) -> None:
        self.scenario = scenario
        self.watchers = watchers
        self.registry = scenario.load_registry()
        self.phy: Phy = make_phy(scenario, self.registry)
        self.src_id = scenario.ros_source.src_id()
        self.topics = source_names(scenario, self.registry)
        namespaces = {self.src_id: scenario.ros_source.namespace}
        self.recorder = Recorder(self.registry, namespaces, self.topics.values())
        self.ears = Fanout([self.recorder, *watchers])
        self.interrupted = False
        self.listener: Listener | None = None
        self.sim: SimPublisher | None = None
        try:
            self._open(out, stack)
        except MiddlewareError as error:
            raise error if isinstance(error, BagError) else RunError(f"{scenario.name}: {error}") from error

    def _open(self, out: Path | None, stack: ExitStack) -> None:
        scenario = self.scenario
        self.input = stack.enter_context(self._input_graph())
        output = stack.enter_context(self._graph(scenario.ros_sink.middleware, scenario.ros_sink.domain_id, "sink"))
        # Pulling a bag as fast as the link takes it needs a source that holds it back instead of dropping.
        backpressure = scenario.ros_source.backpressure or (
            isinstance(self.input, BagMiddleware) and self.input.speed == 0
        )
        self.source = RosSource(
            self.registry,
            middleware=self.input,
            observer=partial(self.ears.sender_event, self.src_id),
            seed=scenario.seed,
            **_values(replace(scenario.ros_source, backpressure=backpressure)),
        )
        stack.callback(self.source.close)
        self.sink = RosSink(
            self.registry,
            middleware=output,
            observer=lambda event: self.ears.receiver_event(event, time.monotonic()),
            packet_observer=lambda data: self.ears.packet_received(data, time.monotonic()),
            **_values(scenario.ros_sink),
        )
        stack.callback(self.sink.close)
        self.sink.announce(self.src_id, self.topics.values())
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            self.listener = self._listen(out, stack)
        self.link = LoopbackLink(
            self.phy,
            self.source,
            self.sink,
            channel=scenario.channel,
            pace=scenario.pace,
            paced=scenario.paced,
            instrumented=bool(self.watchers),
        )
        stack.callback(self.link.stop)
        for watcher in self.watchers:
            watcher.run_started(self._live())
        if scenario.bag_path is None:
            robots = {robot_id: output for robot_id in self._robot_ids() if robot_id != self.src_id}
            if self.src_id in self._robot_ids():
                robots[self.src_id] = stack.enter_context(
                    self._graph(scenario.ros_source.middleware, scenario.ros_source.domain_id, "robot")
                )
            self.sim = SimPublisher(Fleet(scenario.sim), robots, scenario.duration_s)
            stack.callback(self.sim.close)

    def _live(self) -> LiveRun:
        return LiveRun(
            name=self.scenario.name,
            duration_s=self.scenario.duration_s,
            packet_len=self.scenario.packet_len,
            registry=self.registry,
            topics={(self.src_id, topic_id): name for name, topic_id in self.topics.items()},
            sources={self.src_id: self.source},
            links=(self.link,),
            ledger=self.recorder.ledger,
        )

    def _robot_ids(self) -> range:
        return range(1, self.scenario.sim.robots + 1)

    def _graph(self, name: str, domain_id: int, node: str) -> Middleware:
        settings: dict[str, Any] = {"domain_id": domain_id, "node_name": f"gr_ros2_{node}"}
        if name == "dds":
            settings["localhost_only"] = self.scenario.localhost_only
        graph: Middleware = MIDDLEWARE.load(name)(**settings)
        return graph

    def _input_graph(self) -> Middleware:
        path = self.scenario.bag_path
        if path is None:
            source = self.scenario.ros_source
            return self._graph(source.middleware, source.domain_id, "source")
        found = [info.topic for info in bag_topics(path)]
        if not set(found) & set(self.topics):
            raise ConfigError(f"{path}: has none of {', '.join(self.topics)}; it has {', '.join(found) or 'no topics'}")
        return BagMiddleware(path=path, speed=self.scenario.bag_speed)

    def _listen(self, out: Path, stack: ExitStack) -> Listener:
        sink = self.scenario.ros_sink
        graph = stack.enter_context(self._graph(sink.middleware, sink.domain_id, "listener"))
        listener = Listener(graph, out / DELIVERED_BAG, self._output_topics())
        stack.callback(listener.close)
        return listener

    def _output_topics(self) -> dict[str, str]:
        """Name and type of every topic at the sink."""
        format_ = self.scenario.ros_sink.namespace_format
        rows = [self.registry[topic_id] for topic_id in self.topics.values()]
        return {topic.republished(format_, self.src_id): topic.type_name for topic in rows}

    def execute(self, on_progress: Callable[[Progress], None] | None) -> Outcome:
        scenario = self.scenario
        wall = begin = end = time.monotonic()
        try:
            self.link.start()
            self._wait_matched()
            begin = end = time.monotonic()
            (self.sim or self.input).start()
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
        self.link.stop()
        played = end - begin
        if scenario.duration_s and not self.interrupted:
            played = min(scenario.duration_s, played) if scenario.bag_path is not None else scenario.duration_s
        topics = self.recorder.finish(played, end, drained)
        result = Result(
            scenario=scenario.name,
            seed=scenario.seed,
            duration_s=played,
            config=dump(scenario),
            topics=topics,
            packets=self.recorder.ledger.packets(),
            phy=self._phy_numbers(),
            wall_s=time.monotonic() - wall,
            interrupted=self.interrupted,
            counters=self._counters(),
        )
        names = dict(zip(self.topics, self._output_topics(), strict=True))
        return Outcome(result, self.recorder.trace(begin, end, names))

    def _wait_matched(self) -> None:
        """Wait until every end of both graphs has found the other, so that no message goes unheard."""
        limit = time.monotonic() + _MATCH_S
        while time.monotonic() < limit:
            heard = self.listener is None or self.listener.matched()
            if heard and (self.sim is None or (self._sim_matched() and self.source.matched)):
                return
            time.sleep(_POLL_S)
        raise RunError(
            f"{self.scenario.name}: publishers and subscribers did not find each other within {_MATCH_S:g} s; "
            "is the loopback interface up, and the domain free?"
        )

    def _sim_matched(self) -> bool:
        assert self.sim is not None
        return all(self.sim.publishers[name].matched() for name in self.topics if name in self.sim.publishers)

    def _submitted(self, begin: float) -> bool:
        if self.sim is not None:
            return self.sim.finished
        assert isinstance(self.input, BagMiddleware)
        if self.input.error is not None:
            raise self.input.error
        over = bool(self.scenario.duration_s) and time.monotonic() - begin >= self.scenario.duration_s
        return self.input.finished or over

    def _drain(self, on_progress: Callable[[Progress], None] | None, begin: float) -> None:
        """Let the link deliver what it holds, for at most ``drain_s`` without news in pace `flow`."""
        limit = time.monotonic() + self.scenario.drain_s
        before = (0, 0)
        while time.monotonic() < limit and self.recorder.ledger.unresolved():
            time.sleep(_POLL_S)
            self._report(on_progress, begin)
            if self.scenario.pace == "flow" and (now := self.recorder.progress()) != before:
                before, limit = now, time.monotonic() + self.scenario.drain_s

    def _empty(self) -> bool:
        """Whether nothing is left at the source, at the gate or in the PHY."""
        counts = self.link.counts()
        if not self.source.idle or counts.backlog or counts.transmitted < counts.passed:
            return False
        time.sleep(_QUIET_S if self.recorder.ledger.unresolved() else 0)
        return self.link.counts() == counts

    def _report(self, on_progress: Callable[[Progress], None] | None, begin: float) -> None:
        if on_progress is not None:
            sent, delivered = self.recorder.progress()
            on_progress(Progress(time.monotonic() - begin, self.scenario.duration_s, sent, delivered))

    def _phy_numbers(self) -> dict[str, Any]:
        phy = self.phy
        airtime = phy.airtime() if phy.has_samples else None
        return {
            "name": phy.name,
            "sample_rate": phy.sample_rate if phy.has_samples else None,
            "airtime_samples": phy.airtime_samples() if phy.has_samples else None,
            **self.recorder.airtime(airtime),
        }

    def _counters(self) -> dict[str, Any]:
        heard = {} if self.listener is None else dict(self.listener.received)
        return {"source": self.source.stats(), "sink": self.sink.stats(), "listener": heard}


def _values(config: Any) -> dict[str, Any]:
    """The settings of a block, without what is handed over as an object."""
    values = {name: getattr(config, name) for name in config.__dataclass_fields__}
    del values["registry"], values["middleware"]
    return values
