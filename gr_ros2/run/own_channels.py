"""A channel for each robot that sends, in one flowgraph: full duplex in real time.

Packets pass at the pace of the air, or with time ``unthrottled`` as fast as the flowgraph takes them. Every robot has a
receiver for each channel that it hears. A robot that sends nothing but reports has a source without topics.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr import RosSink, RosSource
from gr_ros2.gr.block_settings import own_settings
from gr_ros2.gr.factory import EndpointSetup, make_endpoint
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.link.lateness import Lateness
from gr_ros2.medium.base import Surroundings
from gr_ros2.middleware import Middleware
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.phy import Phy
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.loopback import SimulatedLink
from gr_ros2.record.lateness import modem_lateness
from gr_ros2.run.domains import open_graph
from gr_ros2.run.load import recorded_names
from gr_ros2.run.recorders import RunRecords
from gr_ros2.run.robots import Halves, halves_of_robots, start_of_run
from gr_ros2.run.scenario import Scenario
from gr_ros2.settings.config import SinkConfig, SourceConfig, replaced, robot_of
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry, options_of

_QUIET_S = 0.3
"""A PHY is empty if nothing waits for it and it has given no packet for this time."""


class OwnChannels:
    """See :class:`gr_ros2.run.live.LiveMedium`, and :class:`gr_ros2.run.live.LiveRobots` for the parameters."""

    def __init__(
        self,
        scenario: Scenario,
        registry: Registry,
        phys: Sequence[Phy],
        around: Surroundings,
        *,
        records: RunRecords,
        stack: ExitStack,
    ) -> None:
        self._scenario, self._registry, self._records, self._stack = scenario, registry, records, stack
        ways = scenario.directions()
        self._hearing = Counter(receiver for number in range(around.robots) for receiver in around.reached(number))
        any_length = all(phy.any_length for phy in phys)
        start = start_of_run(ways, any_length=any_length, mcs_table=phys[0].mcs_table)
        self.blocks = [
            self._blocks(number, halves, start, sends=bool(around.reached(number)))
            for number, halves in enumerate(halves_of_robots(ways))
        ]
        self._flowgraph = Flowgraph("gr_ros2_channels", scenario.name)
        self.links = [
            self._link(number, phys[number if number < len(ways) else 0], around)
            for number in range(around.robots)
            if around.reached(number)
        ]
        self._offering = [way.ros_source.src_id() for way in ways]
        stack.callback(self.stop)
        self.clock: Callable[[], float] = time.monotonic
        self.channels = len(ways)

    def start(self) -> None:
        """Start the flowgraph."""
        self._flowgraph.start()
        if self._throttled:
            self.links[0].phy.prefer_latency()

    def run_began(self, now: float) -> None:
        """Messages come from now on, s, monotonic."""
        for link in self.links:
            link.run_began(now)

    def check(self) -> None:
        """Nothing here can break."""

    def stop(self) -> None:
        """Stop the flowgraph."""
        self._flowgraph.stop()

    def empty(self, unresolved: bool) -> bool:
        """Whether nothing is left at a gate or in a PHY; see :class:`gr_ros2.run.live.LiveMedium`."""
        before = [link.counts() for link in self.links]
        if any(counts.backlog or counts.transmitted < counts.passed for counts in before):
            return False
        time.sleep(_QUIET_S if unresolved else 0)
        return [link.counts() for link in self.links] == before

    def lateness(self, records: RunRecords) -> dict[str, list[Lateness]] | None:
        """How late packets were in each part; None where the links wait for the computer."""
        if not self._throttled:
            return None
        parts: dict[str, list[Lateness]] = {"gate": [], "modem": []}
        for src_id, link in zip(self._offering, self.links, strict=False):
            gate = link.gate_lateness()
            if gate is not None:
                parts["gate"].append(gate)
                parts["modem"].append(modem_lateness(link.passed_at(), records.recorder.received_at(src_id)))
        return parts

    def counted(self, robot: int) -> dict[str, Any]:
        """``channel``: the packets it lost on purpose, by the setting that caused the loss."""
        return {"channel": dict(self.links[robot].counts().losses)}

    def counters(self) -> dict[str, Any]:
        """Nothing: the channels have nothing in common."""
        return {}

    @property
    def _throttled(self) -> bool:
        return self._scenario.time != "unthrottled"

    def _blocks(
        self, number: int, halves: Halves, start: EndpointSetup, *, sends: bool
    ) -> tuple[RosSource | None, RosSink | None]:
        """The blocks of a robot, which share one endpoint."""
        scenario, registry = self._scenario, self._registry
        source, sink = halves
        if scenario.robots:
            assert source is not None and sink is not None
            sink = replaced(sink, middleware=source.middleware, domain_id=source.domain_id)
        elif sink is not None and number > 1:
            sink = _apart(sink, registry, number)
        hears = bool(self._hearing[number])
        if source is not None and not sends:
            raise ConfigError(
                f"gains_db: nobody hears {source.namespace}, whose channel in real time would have no receiver; set "
                "duplex: half, or time to packets or samples"
            )
        rng = random.Random(scenario.seed)
        end = LiveEnd(lambda events: make_endpoint(registry, *halves, start=start, rng=rng, observer=events))
        src_id = robot_of(source, sink)
        bare: dict[str, Any] = {"version": scenario.version, "packet_len": scenario.packet_len, "robot_id": src_id}
        common: dict[str, Any] = {"end": end, "observer": self._records.of(number, src_id)}
        here, there = self._graphs(source, sink)
        sending = receiving = None
        if sends:
            mine = registry if source is not None else Registry.empty()
            half = own_settings(self._pulled(source) if source is not None else SourceConfig(**bare))
            sending = RosSource(mine, middleware=here, **common, **half)
            self._stack.callback(sending.close)
        if hears:
            mine = registry if sink is not None else Registry.empty()
            receiving = RosSink(mine, middleware=there, **common, **own_settings(sink or SinkConfig(**bare)))
            self._stack.callback(receiving.close)
        return sending, receiving

    def _pulled(self, source: SourceConfig) -> SourceConfig:
        """A bag that is read as fast as the link takes it needs a source that makes the reader wait instead of
        dropping."""
        pulled = self._scenario.bag_path is not None and self._scenario.bag_speed == 0
        return replace(source, backpressure=True) if pulled else source

    def _graphs(self, source: SourceConfig | None, sink: SinkConfig | None) -> tuple[Middleware, Middleware]:
        """The participants of a robot's two halves: one for both where they are on the same graph."""
        ends = [end for end in (source, sink) if end is not None]
        places = [(end.middleware, end.domain_id) for end in ends]
        if source is not None and (path := self._scenario.bag_path) is not None:
            recorded_names(self._scenario, self._registry)  # raises if the recording has nothing for this link
            graphs: list[Middleware] = [BagMiddleware(path=path, speed=self._scenario.bag_speed)]
        else:
            node = "sink" if source is None else "source"
            graphs = [open_graph(self._scenario, ends[0], node)]
            if places[-1] != places[0]:
                graphs.append(open_graph(self._scenario, ends[1], "sink"))
        for graph in graphs:
            self._stack.enter_context(graph)
        return graphs[0], graphs[-1]

    def _link(self, number: int, phy: Phy, around: Surroundings) -> SimulatedLink:
        """The channel of a robot to all who hear it."""
        scenario = self._scenario
        first, *others = [around.path(number, receiver) for receiver in around.reached(number)]
        return SimulatedLink(
            phy,
            self.blocks[number][0],
            self.blocks[first.receiver][1],
            channel=first.channel,
            throttled=self._throttled,
            rule=scenario.airtime.rule,
            delay_s=first.delay_s,
            instrumented=self._records.run_observers.instruments,
            further=[(path.channel, self.blocks[path.receiver][1]) for path in others],
            within=self._flowgraph,
            shared=self._hearing[first.receiver] > 1,
        )


def _apart(config: SinkConfig, registry: Registry, number: int) -> SinkConfig:
    """The settings of a further receiver's sink, which publishes on the same graph in a namespace of its own."""
    inside = f"/receiver_{number}/"
    options = {
        topic.name: replaced(
            options_of(topic.name, config.topic_options), publish_as=inside + topic.options.publish_as.lstrip("/")
        )
        for topic in registry.with_options(config.topic_options)
        if topic.options.publish_as != AUTO
    }
    return replaced(
        config,
        namespace_format=inside + config.namespace_format.lstrip("/"),
        topic_options={**config.topic_options, **options},
        merge_tf=inside + config.merge_tf.lstrip("/") if config.merge_tf else "",
    )
