"""The ROS side of a robot's end of a link: its participant on its graph, and the block between it and the radio.

Invariant: everything that is opened here is closed by the stack it was entered on.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.names import link_node
from gr_ros2.gr.bound import OwnWay, names_of
from gr_ros2.gr.ros_link import LinkBlock, RosLink
from gr_ros2.link.access import Access
from gr_ros2.link.air import Air
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.link.airtime_limit import sustained
from gr_ros2.link.bond import Bond
from gr_ros2.link.observe import LinkObserver
from gr_ros2.mac import Slots, access_of
from gr_ros2.middleware import Middleware, join
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.one_radio import OneRadio


class RosSide:
    """A robot's participant on its ROS graph, and its block.

    :param radios: its radios
    :param bond: see :class:`gr_ros2.gr.ros_link.RosLink`
    :param middleware: an open Middleware for both directions, which the caller closes; None: opened here
    :param observer, clock: see :class:`gr_ros2.gr.ros_link.RosLink`
    :param block: makes the block between the graph and the radio, as :class:`RosLink` does
    :param stack: closes what is opened here
    :raises ConfigError: when the parts do not fit together
    :raises MiddlewareError: when the ROS graph cannot be joined
    :ivar link: the block
    :ivar slots: when it sends, with ``medium: slots``
    """

    def __init__(
        self,
        config: LinkConfig,
        radios: Sequence[OneRadio],
        *,
        bond: Bond | None,
        middleware: Middleware | None,
        observer: LinkObserver | None,
        clock: Callable[[], float],
        block: Callable[..., LinkBlock],
        stack: ExitStack,
    ) -> None:
        sends = any(radio.sends for radio in radios)
        apart = [radio for radio in radios if radio.own.shares] if len(radios) > 1 else []
        main = [radio for radio in radios if radio not in apart]
        front_ends = [radio.front_end for radio in main]
        front_end = min(front_ends, key=lambda each: each.airtime(config.packet_len))
        loops_back = any(radio.front_end.loops_back for radio in radios)
        self.node_name = link_node(config.robot_id)
        """The node name that ``ros2 node list`` shows."""
        self.shares = main[0].own.shares
        """Whether other robots send on its channel."""
        for radio in radios:
            if radio.own.shares and loops_back:
                raise ConfigError(
                    f"medium = {radio.own.medium!r}: front_end {radio.front_end.name} reaches no other robot; leave it "
                    "out, or set another front_end"
                )
        if loops_back and (names := names_of(config)):
            raise ConfigError(f"via = {min(names)!r}: front_end {front_end.name} reaches no other robot; leave it out")
        self.slots: Slots | None = None
        self.graph = middleware or stack.enter_context(join(config.graph, self.node_name))
        air = Air(
            hears=sends and config.receives and not loops_back,
            half_duplex=self.shares or all(getattr(each.options, "half_duplex", False) for each in front_ends),
            any_length=all(radio.phy.any_length for radio in main),
            radios=len(main),
            # What any of several may carry is sent as robustly as each can: reports tell one SNR of them all.
            mcs_table=main[0].phy.mcs_table if len(radios) == 1 else (),
            airtime_s=front_end.airtime(config.packet_len),
            airtime_share=max(sustained(radio.own.airtime.rule) for radio in main),
            access=self._access(main[0]) if sends else lambda _: None,
            relay=self.shares and config.relay == "gain",
        )
        self.link = block(
            config if sends else replace(config, topics={}, offer={}),
            air=air,
            loops_back=loops_back,
            middleware=self.graph,
            observer=observer,
            clock=clock,
            **({} if bond is None else {"bond": bond}),
            **({} if self.shares or loops_back or block is not RosLink else {"ways": self._ways(config, radios)}),
        )
        stack.callback(self.link.close)

    def _access(self, radio: OneRadio) -> Callable[[int], Access | None]:
        """What decides when it sends over a radio. The guard between robots is what the front end may be late by."""
        front_end, medium = radio.front_end, radio.own.medium
        guard_s, lead_s = front_end.timing_error_s, LEAD_S + (front_end.ahead() or 0.0)
        make = access_of(medium, front_end.airtime(), secrets.randbits(32), guard_s=guard_s, lead_s=lead_s)

        def access(src_id: int) -> Access | None:
            made = make(src_id)
            self.slots = made if isinstance(made, Slots) else self.slots
            return made

        return access

    def _ways(self, config: LinkConfig, radios: Sequence[OneRadio]) -> dict[int, OwnWay]:
        """What an endpoint that has one radio alone has to know of it, by its number."""
        return {
            number: OwnWay(
                name=radio.name,
                packet_len=radio.own.packet_len,
                sends=radio.sends,
                shares=radio.own.shares,
                air=Air(
                    hears=radio.sends and config.receives,
                    half_duplex=radio.own.shares or getattr(radio.front_end.options, "half_duplex", False),
                    any_length=radio.phy.any_length,
                    mcs_table=radio.phy.mcs_table,
                    airtime_s=radio.front_end.airtime() if radio.phy.has_airtime else 0.0,
                    airtime_share=sustained(radio.own.airtime.rule),
                    access=self._access(radio) if radio.sends else lambda _: None,
                    relay=radio.own.medium == "slots" and config.relay == "gain",
                ),
            )
            for number, radio in enumerate(radios)
        }
