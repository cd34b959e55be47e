"""The blocks of one robot: what it sends and what it receives, in any flowgraph.

Invariant: both blocks share one endpoint. So received packets can change what is sent.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

from gr_ros2.gr.block_settings import own_settings
from gr_ros2.gr.factory import EndpointSetup, make_endpoint
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.sink import RosSink
from gr_ros2.gr.source import RosSource
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware import Middleware
from gr_ros2.settings.config import EndConfig, SinkConfig, SourceConfig, robot_of
from gr_ros2.settings.registry import Registry


class RobotBlocks:
    """Makes the blocks of a robot, each of which is asked for once at most.

    :param source, sink: settings of its halves, one of them at least; None: it offers nothing, or takes nothing
    :param observer, clock, seed: see :class:`RosSource`
    :param calls: see :func:`make_endpoint`
    :ivar end: its endpoint
    :raises ConfigError: for settings that contradict each other
    """

    def __init__(
        self,
        registry: Registry,
        source: SourceConfig | None,
        sink: SinkConfig | None,
        *,
        start: EndpointSetup,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        seed: int | None = None,
        calls: bool = False,
    ) -> None:
        self._registry, self._halves = registry, (source, sink)
        rng = random.Random(seed)
        self.end = LiveEnd(
            lambda events: make_endpoint(registry, source, sink, start=start, rng=rng, observer=events, calls=calls)
        )
        self._common: dict[str, Any] = {"end": self.end, "observer": observer, "clock": clock}

    def source(self, middleware: str | Middleware) -> RosSource:
        """The block that sends: only reports where the robot offers nothing."""
        source, sink = self._halves
        if source is not None:
            return RosSource(self._registry, middleware=middleware, **self._common, **own_settings(source))
        return RosSource(Registry.empty(), middleware=middleware, **self._common, **self._bare(sink))

    def sink(self, middleware: str | Middleware) -> RosSink:
        """The block that receives: only reports where the robot takes nothing."""
        source, sink = self._halves
        if sink is not None:
            return RosSink(self._registry, middleware=middleware, **self._common, **own_settings(sink))
        return RosSink(Registry.empty(), middleware=middleware, **self._common, **self._bare(source))

    def _bare(self, other: EndConfig | None) -> dict[str, Any]:
        """Settings of a block for reports alone: what it shares with the robot's other block."""
        assert other is not None, "a robot has a half"
        return {"version": other.version, "packet_len": other.packet_len, "robot_id": robot_of(*self._halves)}
