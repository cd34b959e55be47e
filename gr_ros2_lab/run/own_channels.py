"""A channel for each robot that sends, in one flowgraph: full duplex in real time.

Packets pass at the pace of the air. Every robot has a
receiver for each channel that it hears. A robot that sends nothing but reports has a source without topics.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr import RosLink
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.link.air import Air
from gr_ros2.link.lateness import Lateness
from gr_ros2.middleware import Middleware, join
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.paper.factory import make_paper_endpoint
from gr_ros2.phy import Phy
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.loopback import SimulatedLink
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.medium.base import Surroundings
from gr_ros2_lab.record.lateness import modem_lateness
from gr_ros2_lab.run.load import recorded_names
from gr_ros2_lab.run.recorders import RunRecords
from gr_ros2_lab.run.robot_settings import RobotSettings, senders_of
from gr_ros2_lab.run.robots import air_of_run, start_of_run
from gr_ros2_lab.run.scenario import Scenario

_QUIET_S = 0.3
"""A PHY is empty if nothing waits for it and it has given no packet for this time."""


class OwnChannels:
    """See :class:`gr_ros2_lab.run.live.LiveMedium`, and :class:`gr_ros2_lab.run.live.LiveRobots` for the parameters."""

    def __init__(
        self,
        scenario: Scenario,
        robots: Sequence[RobotSettings],
        registry: Registry,
        phy: Phy,
        around: Surroundings,
        *,
        records: RunRecords,
        stack: ExitStack,
    ) -> None:
        self._scenario, self._registry, self._records, self._stack = scenario, registry, records, stack
        self._hearing = Counter(receiver for number in range(around.robots) for receiver in around.reached(number))
        air = air_of_run(scenario, phy)
        self.blocks = [
            self._blocks(number, robot, air, sends=bool(around.reached(number))) for number, robot in enumerate(robots)
        ]
        self._flowgraph = Flowgraph("gr_ros2_channels", scenario.name)
        self.links = [self._link(number, phy, around) for number in range(around.robots) if around.reached(number)]
        self._offering = [robot.robot_id for robot in senders_of(robots)]
        stack.callback(self.stop)
        self.clock: Callable[[], float] = time.monotonic
        self.channels = len(self._offering)

    def start(self) -> None:
        """Start the flowgraph."""
        self._flowgraph.start()
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
        """Whether nothing is left at a gate or in a PHY; see :class:`gr_ros2_lab.run.live.LiveMedium`."""
        before = [link.counts() for link in self.links]
        if any(counts.backlog or counts.transmitted < counts.passed for counts in before):
            return False
        time.sleep(_QUIET_S if unresolved else 0)
        return [link.counts() for link in self.links] == before

    def lateness(self, records: RunRecords) -> dict[str, list[Lateness]] | None:
        """How late packets were in each part."""
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

    def _blocks(
        self, number: int, robot: RobotSettings, air: Air, *, sends: bool
    ) -> tuple[SendingBlock | None, ReceivingBlock | None]:
        """The blocks of a robot, which share one endpoint."""
        scenario, config, registry = self._scenario, robot.config, self._registry
        hears = bool(self._hearing[number])
        if config.sends and not sends:
            raise ConfigError(
                f"gains_db: nobody hears {config.namespace}, whose channel in real time would have no receiver; set "
                "duplex: half, or time to packets or samples"
            )
        if not config.sends and not hears:
            raise ConfigError(
                f"gains_db: {config.namespace} hears nobody; set a higher gain, or time to packets or samples"
            )
        # A bag that is read as fast as the link takes it: the reader waits, so that nothing is dropped.
        waits = config.sends and scenario.bag_path is not None and not scenario.bag_speed
        common: dict[str, Any] = {"observer": self._records.of(number)}
        graph = self._graph(robot)
        if scenario.paper is None:
            start = start_of_run(scenario)
            link = RosLink(
                config, air=air, start=start, middleware=graph, backpressure=waits, registry=registry, **common
            )
            self._stack.callback(link.close)
            return link.source if sends else None, link.sink if hears else None
        make = partial(make_paper_endpoint, config, scenario.paper, registry, rng=random.Random(scenario.seed))
        end = LiveEnd(lambda events: make(observer=events))
        heard = registry.with_options(config.publish.topics)
        source = SendingBlock(config, registry, end, graph, backpressure=waits, **common) if config.sends else None
        sink = ReceivingBlock(config, heard, end, graph, **common) if robot.takes and hears else None
        for block in (source, sink):
            if block is not None:
                self._stack.callback(block.close)
        return source, sink

    def _graph(self, robot: RobotSettings) -> Middleware:
        """The participant of a robot."""
        graph: Middleware
        if robot.config.sends and (path := self._scenario.bag_path) is not None:
            recorded_names(self._scenario, self._registry)  # raises if the recording has nothing for this link
            graph = BagMiddleware(path=path, speed=self._scenario.bag_speed)
        else:
            graph = join(robot.config.graph, f"gr_ros2_robot_{robot.robot_id}")
        self._stack.enter_context(graph)
        return graph

    def _link(self, number: int, phy: Phy, around: Surroundings) -> SimulatedLink:
        """The channel of a robot to all who hear it."""
        scenario = self._scenario
        first, *others = [around.path(number, receiver) for receiver in around.reached(number)]
        return SimulatedLink(
            phy,
            self.blocks[number][0],
            self.blocks[first.receiver][1],
            channel=first.channel,
            rule=scenario.airtime.rule,
            delay_s=first.delay_s,
            instrumented=self._records.run_observers.instruments,
            further=[(path.channel, self.blocks[path.receiver][1]) for path in others],
            within=self._flowgraph,
            shared=self._hearing[first.receiver] > 1,
        )
