"""One direction of a run: input graph -> ROS Source -> PHY and channel -> ROS Sink -> output graph; and the ways
back for reports. The first direction may have further receivers.

Invariants: the only path from the input graph to the output graph is the link; everything that is opened here is closed
by the exit stack it was entered on.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any

from gr_ros2.gr import RosSink, RosSource
from gr_ros2.gr.ends import EndpointSetup, LiveEnd, make_endpoint, own_settings
from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.events import SenderEvent
from gr_ros2.link.lateness import Lateness
from gr_ros2.link.observe import LinkObserver
from gr_ros2.link.rate import Mcs
from gr_ros2.middleware import Middleware, join_graph
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.phy import Phy
from gr_ros2.phy.loopback import LoopbackLink
from gr_ros2.record.lateness import modem_lateness
from gr_ros2.run.load import recorded_names, source_names
from gr_ros2.run.recorders import RunRecords
from gr_ros2.run.robots import Halves, halves_of_robots, start_of_run
from gr_ros2.run.scenario import Scenario
from gr_ros2.settings.config import ChannelConfig, SinkConfig, SourceConfig, replaced, robot_of
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry

_QUIET_S = 0.3
"""A PHY is empty if nothing waits for it and it has given no packet for this time."""


def open_graph(scenario: Scenario, end: SourceConfig | SinkConfig, node: str) -> Middleware:
    """Join the graph of one end of the link with a participant of its own.

    :param node: name of the node on the graph, after ``gr_ros2_``
    """
    return join_graph(
        end.middleware,
        domain_id=end.domain_id,
        node_name=f"gr_ros2_{node}",
        localhost_only=scenario.localhost_only,
    )


def live_ends(
    ways: Sequence[Scenario], registry: Registry, *, any_length: bool, mcs_table: Sequence[Mcs] = ()
) -> list[LiveEnd]:
    """The ends of a link that speaks version 1, see :func:`gr_ros2.run.robots.halves_of_robots`.

    :param any_length: whether the PHY carries shorter packets in less time
    :param mcs_table: the rates of an adaptive rate; () for a fixed rate
    """
    start = start_of_run(ways, any_length=any_length, mcs_table=mcs_table)
    return [
        LiveEnd(partial(_endpoint, registry, halves, start, random.Random(ways[0].seed)))
        for halves in halves_of_robots(ways)
    ]


def _endpoint(
    registry: Registry,
    halves: Halves,
    start: EndpointSetup,
    rng: random.Random,
    observer: Callable[[SenderEvent], None],
) -> Endpoint:
    return make_endpoint(registry, *halves, start=start, rng=rng, observer=observer)


class Direction:
    """Both blocks and the link between them, ready to start.

    :param scenario: a one-way scenario, see :meth:`Scenario.directions`
    :param ends: the end that sends and those that receive; None: the blocks make their own (version 0)
    :param observer: receives the events of the sender and of the first receiver
    :param stack: closes what is opened here
    :param instrumented: see :class:`LoopbackLink`
    :param further: receive the events of one further receiver each
    :ivar topics: topic id of every topic the source subscribes, by absolute name
    """

    def __init__(
        self,
        scenario: Scenario,
        registry: Registry,
        phy: Phy,
        ends: Sequence[LiveEnd | None],
        *,
        observer: LinkObserver,
        stack: ExitStack,
        instrumented: bool = False,
        further: Sequence[LinkObserver] = (),
    ) -> None:
        self.scenario = scenario
        self.registry = registry
        self.src_id = scenario.ros_source.src_id()
        self.topics = source_names(scenario, registry)
        self.input = stack.enter_context(self._input_graph())
        self.output = stack.enter_context(open_graph(scenario, scenario.ros_sink, "sink"))
        # A bag that is read as fast as the link takes it needs a source that makes the reader wait instead of dropping.
        pulled = scenario.bag_path is not None and scenario.bag_speed == 0
        backpressure = scenario.ros_source.backpressure or pulled
        self.source = RosSource(
            registry,
            middleware=self.input,
            observer=observer,
            seed=scenario.seed,
            end=ends[0],
            **own_settings(replace(scenario.ros_source, backpressure=backpressure)),
        )
        stack.callback(self.source.close)
        self.sink = self._sink(scenario.ros_sink, ends[1], observer, stack)
        sinks = [
            self._sink(_apart(scenario.ros_sink, registry, number), end, receiver, stack)
            for number, (end, receiver) in enumerate(zip(ends[2:], further, strict=True), 2)
        ]
        self.link = LoopbackLink(
            phy,
            self.source,
            self.sink,
            channel=scenario.channel,
            throttled=scenario.time != "unthrottled",
            rule=scenario.airtime.rule,
            instrumented=instrumented,
            further=list(zip(scenario.receivers, sinks, strict=True)),
        )
        stack.callback(self.link.stop)

    def output_topics(self) -> dict[str, str]:
        """Name and type of every topic at the sink, in the order of ``topics``."""
        format_ = self.scenario.ros_sink.namespace_format
        rows = [self.sink.registry[topic_id] for topic_id in self.topics.values()]
        return {topic.republished(format_, self.src_id): topic.type_name for topic in rows}

    def empty(self, unresolved: bool) -> bool:
        """Whether nothing is left at the source, at the gate or in the PHY.

        :param unresolved: whether the result of some messages is open; then it is useful to wait briefly for the PHY
        """
        counts = self.link.counts()
        if not self.source.idle or counts.backlog or counts.transmitted < counts.passed:
            return False
        time.sleep(_QUIET_S if unresolved else 0)
        return self.link.counts() == counts

    def counters(self) -> dict[str, Any]:
        """What each part counted. ``channel``: the packets it lost on purpose, by the setting that caused the loss."""
        return {
            "source": self.source.stats(),
            "sink": self.sink.stats(),
            "channel": dict(self.link.counts().losses),
        }

    def _sink(self, config: SinkConfig, end: LiveEnd | None, observer: LinkObserver, stack: ExitStack) -> RosSink:
        sink = RosSink(self.registry, middleware=self.output, observer=observer, end=end, **own_settings(config))
        stack.callback(sink.close)
        sink.outputs.announce(self.src_id, self.topics.values())
        return sink

    def _input_graph(self) -> Middleware:
        path = self.scenario.bag_path
        if path is None:
            return open_graph(self.scenario, self.scenario.ros_source, "source")
        recorded_names(self.scenario, self.registry)  # raises if the recording has nothing for this link
        return BagMiddleware(path=path, speed=self.scenario.bag_speed)


def _apart(config: SinkConfig, registry: Registry, number: int) -> SinkConfig:
    """The settings of a further receiver's sink, which publishes on the same graph in a namespace of its own."""
    inside = f"/receiver_{number}/"
    options = {
        topic.name: replaced(topic.options, publish_as=inside + topic.options.publish_as.lstrip("/"))
        for topic in registry.with_options(config.topic_options)
        if topic.options.publish_as != AUTO
    }
    return replaced(
        config,
        namespace_format=inside + config.namespace_format.lstrip("/"),
        topic_options={**config.topic_options, **options},
        merge_tf=inside + config.merge_tf.lstrip("/") if config.merge_tf else "",
    )


class ReportDirection:
    """The reverse direction for one receiver's reports alone, ready to start. It carries no topics.

    :param forward: the direction of the messages
    :param ends: the sender, which hears the reports, and the receiver, which sends them
    :param src_id: of the receiver
    :param channel: between the receiver and the sender
    :param delay_s: s that a report takes beside its airtime
    :param observer, stack, instrumented: see :class:`Direction`
    """

    def __init__(
        self,
        forward: Direction,
        phy: Phy,
        ends: tuple[LiveEnd, LiveEnd],
        src_id: int,
        *,
        channel: ChannelConfig,
        delay_s: float,
        observer: LinkObserver,
        stack: ExitStack,
        instrumented: bool = False,
    ) -> None:
        common: dict[str, Any] = {"version": 1, "packet_len": forward.scenario.packet_len, "observer": observer}
        source = RosSource(Registry.empty(), middleware=forward.output, end=ends[1], robot_id=src_id, **common)
        stack.callback(source.close)
        sink = RosSink(Registry.empty(), middleware=forward.input, end=ends[0], **common)
        stack.callback(sink.close)
        self.link = LoopbackLink(
            phy,
            source,
            sink,
            channel=channel,
            throttled=forward.scenario.time != "unthrottled",
            rule=forward.scenario.airtime.rule,
            delay_s=delay_s,
            instrumented=instrumented,
        )
        stack.callback(self.link.stop)


class Directions:
    """The links of a run whose robots have a channel each, ready to start: a direction for each robot that offers
    messages, and the ways back for reports.

    :param records: observe them
    :param stack: closes what is opened here
    """

    def __init__(
        self, scenario: Scenario, registry: Registry, phys: Sequence[Phy], *, records: RunRecords, stack: ExitStack
    ) -> None:
        ways = scenario.directions()
        common: dict[str, Any] = {
            "observer": records.all,
            "stack": stack,
            "instrumented": records.run_observers.instruments,
        }
        live: list[LiveEnd] = []
        if scenario.version:
            any_length = all(phy.any_length for phy in phys)
            live = live_ends(ways, registry, any_length=any_length, mcs_table=phys[0].mcs_table)
        ends: Sequence[LiveEnd | None] = live or [None] * (2 + len(scenario.receivers))
        further = [records.further.at(number) for number in range(1, 1 + len(scenario.receivers))]
        forward = Direction(ways[0], registry, phys[0], ends, further=further, **common)
        self.ways = [forward]
        if len(ways) > 1:
            self.ways.append(Direction(ways[1], registry, phys[1], ends[1::-1], **common))
        self.links = [direction.link for direction in self.ways]
        if scenario.reports is not None:
            common["delay_s"] = scenario.reports.delay_s
            receivers = zip(live[1:], halves_of_robots(ways)[1:], scenario.report_channels(), strict=True)
            for end, halves, channel in receivers:
                pair, src_id = (live[0], end), robot_of(*halves)
                reporting = ReportDirection(forward, phys[0], pair, src_id, channel=channel, **common)
                self.links.append(reporting.link)
        self._timed = scenario.time != "unthrottled"
        self.clock: Callable[[], float] = time.monotonic
        self.listened = self.channels = len(self.ways)

    @property
    def graphs(self) -> tuple[tuple[str, int | None], ...]:
        """Where other programs can join in: what is there, and the ROS domain."""
        forward = self.ways[0]
        return (
            ("the graph on which messages are sent", forward.input.domain_id),
            ("the graph on which they come out", forward.output.domain_id),
        )

    def start(self) -> None:
        """Start all links."""
        for link in self.links:
            link.start()

    def run_began(self, now: float) -> None:
        """Messages come from now on, s, monotonic."""
        for link in self.links:
            link.run_began(now)

    def check(self) -> None:
        """Nothing here can break."""

    def stop(self) -> None:
        """Stop all links."""
        for link in self.links:
            link.stop()

    def lateness(self, records: RunRecords) -> dict[str, list[Lateness]] | None:
        """How late packets were in each part; None where the links wait for the computer."""
        if not self._timed:
            return None
        parts: dict[str, list[Lateness]] = {"gate": [], "modem": []}
        for way in self.ways:
            gate = way.link.gate_lateness()
            if gate is not None:
                parts["gate"].append(gate)
                parts["modem"].append(modem_lateness(way.link.passed_at(), records.recorder.received_at(way.src_id)))
        return parts

    def counters(self) -> dict[str, Any]:
        """What each part of the first direction counted, and of the second as ``back``."""
        forward, *back = (way.counters() for way in self.ways)
        return {**forward, **({"back": back[0]} if back else {})}
