"""The ROS side of a robot's end of a link: its participants on the graphs, and the blocks between them and the radio.

Invariants: both directions share one block and one endpoint, so that received packets can change what is sent; a robot
that receives its own packets has a block and an endpoint for each instead; everything that is opened here is closed by
the stack it was entered on.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr import RosLink, RosSink, RosSource
from gr_ros2.gr.block_settings import own_settings
from gr_ros2.gr.calls import LiveCalls
from gr_ros2.gr.factory import EndpointSetup
from gr_ros2.link.access import Access
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.link.airtime_limit import sustained
from gr_ros2.link.observe import LinkObserver
from gr_ros2.mac import Slots, access_of
from gr_ros2.middleware import Middleware, join
from gr_ros2.phy import Phy
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import halves


class RosSide:
    """See the module.

    :param sends: whether the robot may send
    :param middleware: an open Middleware for all blocks, which the caller closes; None: opened here
    :param observer, clock: see :class:`gr_ros2.gr.ros_link.RosLink`
    :param stack: closes what is opened here
    :raises ConfigError: when the parts do not fit together
    :raises MiddlewareError: when a ROS graph cannot be joined
    :ivar blocks: the block that sends, and the one that receives
    :ivar end: what sends and receives; where the front end loops back, what receives
    :ivar calls: the services that cross the link; None with version 0 and where the front end loops back
    :ivar slots: when it sends, with ``medium: slots``
    """

    def __init__(
        self,
        config: LinkConfig,
        phy: Phy,
        front_end: FrontEnd,
        *,
        sends: bool,
        middleware: Middleware | None,
        observer: LinkObserver | None,
        clock: Callable[[], float],
        stack: ExitStack,
    ) -> None:
        self.config, self._phy, self._front_end, self._sends, self._stack = config, phy, front_end, sends, stack
        self.node_name = f"gr_ros2_link_{config.robot_id}"
        """The node name that ``ros2 node list`` shows."""
        self.shares = config.medium != "exclusive"
        """Whether other robots send on its channel."""
        self.slots: Slots | None = None
        self.calls: LiveCalls | None = None
        self.graph = self._join() if middleware is None else middleware
        common = {"observer": observer, "clock": clock}
        if front_end.loops_back:
            self._two_blocks(config.load_registry(), common)
        else:
            self._one_block(common)

    def _one_block(self, common: dict[str, Any]) -> None:
        config = self.config
        setup = EndpointSetup(
            reports=self._sends and config.receives,
            half_duplex=self.shares or getattr(self._front_end.options, "half_duplex", False),
            any_length=self._phy.any_length,
            mcs_table=self._phy.mcs_table,
            airtime_s=self._front_end.airtime(),
            airtime_share=sustained(config.airtime.rule),
            access=self._access if self._sends else lambda _: None,
            relay=config.relay == "gain",
        )
        robot = config if self._sends else replace(config, topics={})
        both = RosLink(robot, setup=setup, middleware=self.graph, **common)
        self._stack.callback(both.close)
        self.source, self.sink, self.end, self.calls = both.source, both.sink, both.end, both.calls
        self.blocks: tuple[Any, Any] = both, both

    def _two_blocks(self, registry: Registry, common: dict[str, Any]) -> None:
        if self.shares:
            raise ConfigError(
                f"medium = {self.config.medium!r}: front_end {self._front_end.name} reaches no other robot; leave it "
                "out, or set another front_end"
            )
        source, sink = (own_settings(half) for half in halves(self.config))
        sink["robot_id"] = AUTO  # it takes the robot's own packets
        carried: dict[str, Any] = {"any_length": self._phy.any_length, "mcs_table": self._phy.mcs_table}
        self.source = RosSource(registry, middleware=self.graph, **carried, **common, **source)
        self._stack.callback(self.source.close)
        self.sink = RosSink(registry, middleware=self.graph, **common, **sink)
        self._stack.callback(self.sink.close)
        self.end = self.sink.live
        self.blocks = self.source, self.sink

    def _access(self, src_id: int) -> Access | None:
        """What decides when it sends. The guard between two robots is what its front end may be late by."""
        front_end, medium = self._front_end, self.config.medium
        guard_s, lead_s = front_end.timing_error_s, LEAD_S + (front_end.ahead() or 0.0)
        make = access_of(medium, front_end.airtime(), secrets.randbits(32), guard_s=guard_s, lead_s=lead_s)
        access = make(src_id)
        self.slots = access if isinstance(access, Slots) else None
        return access

    def _join(self) -> Middleware:
        """The robot's participant on its graph."""
        joined = join(self.config.graph, self.node_name)
        self._stack.callback(joined.close)
        return joined
