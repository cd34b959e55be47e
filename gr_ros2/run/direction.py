"""One direction of a run: input graph -> ROS Source -> PHY and channel -> ROS Sink -> output graph.

Invariants: the only path from the input graph to the output graph is the link; everything that is opened here is closed
by the exit stack it was entered on.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from gr_ros2.config import SinkConfig, SourceConfig
from gr_ros2.gr import RosSink, RosSource
from gr_ros2.gr.ends import LiveEnd, Start, make_endpoint, own_settings
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware import Middleware, join_graph
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.phy import Phy
from gr_ros2.phy.loopback import LoopbackLink
from gr_ros2.registry import Registry
from gr_ros2.run.load import recorded_names, source_names
from gr_ros2.run.scenario import Scenario

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


class Direction:
    """Both blocks and the link between them, ready to start.

    :param scenario: a one-way scenario, see :meth:`Scenario.directions`
    :param observer: receives the events of both blocks
    :param stack: closes what is opened here
    :param instrumented: see :class:`LoopbackLink`
    :ivar topics: topic id of every topic the source subscribes, by absolute name
    """

    def __init__(
        self,
        scenario: Scenario,
        registry: Registry,
        phy: Phy,
        *,
        observer: LinkObserver,
        stack: ExitStack,
        instrumented: bool = False,
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
        sends = self._end(scenario.ros_source, None, phy.any_length) if scenario.version else None
        hears = self._end(None, scenario.ros_sink, phy.any_length) if scenario.version else None
        self.source = RosSource(
            registry,
            middleware=self.input,
            observer=observer,
            seed=scenario.seed,
            end=sends,
            **own_settings(replace(scenario.ros_source, backpressure=backpressure)),
        )
        stack.callback(self.source.close)
        self.sink = RosSink(
            registry,
            middleware=self.output,
            observer=observer,
            end=hears,
            **own_settings(scenario.ros_sink),
        )
        stack.callback(self.sink.close)
        self.sink.announce(self.src_id, self.topics.values())
        self.link = LoopbackLink(
            phy,
            self.source,
            self.sink,
            channel=scenario.channel,
            throttled=scenario.time != "unthrottled",
            instrumented=instrumented,
        )
        stack.callback(self.link.stop)

    def _end(self, source: SourceConfig | None, sink: SinkConfig | None, any_length: bool) -> LiveEnd:
        """One end of a run. Its starts are not counted, because no end exists longer than the run."""
        start = Start(self.scenario.seed + 1, any_length=any_length)
        return LiveEnd(lambda observer: make_endpoint(self.registry, source, sink, start=start, observer=observer))

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

    def _input_graph(self) -> Middleware:
        path = self.scenario.bag_path
        if path is None:
            return open_graph(self.scenario, self.scenario.ros_source, "source")
        recorded_names(self.scenario, self.registry)  # raises if the recording has nothing for this link
        return BagMiddleware(path=path, speed=self.scenario.bag_speed)
