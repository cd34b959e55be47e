"""ROS Link: one robot's end of a link in one block; ROS topics in and out, packets in and out.

Services cross the link too.

Invariant: the block that sends and the one that receives share one endpoint, so that received packets can change what
is sent. A robot that receives its own packets has an endpoint for each instead.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from gnuradio import gr

from gr_ros2.core.errors import ConfigError, GrRos2Error
from gr_ros2.core.names import link_node
from gr_ros2.gr.backfill import LiveBackfill
from gr_ros2.gr.bound import BoundEnds, OwnWay, bound_to_none
from gr_ros2.gr.calls import LiveCalls, has_room_for_calls
from gr_ros2.gr.factory import Start, make_endpoint, start_of
from gr_ros2.gr.link_parts import LinkParts
from gr_ros2.gr.link_sending import LinkSendingBlock
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.radio_ports import RadioPorts
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.throughput import LiveThroughput
from gr_ros2.gr.wishes import LiveWishes
from gr_ros2.link.air import Air
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.link.airtime_limit import sustained
from gr_ros2.link.bond import Bond
from gr_ros2.link.observe import LinkObserver
from gr_ros2.mac import GUARD_S, access_of
from gr_ros2.middleware import Middleware, joined
from gr_ros2.phy.pdus import port_of
from gr_ros2.settings.config import airtime_from
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry, check_outputs
from gr_ros2.settings.robot import ONE_RADIO, RobotConfig, robot_from


class LinkBlock(gr.hier_block2, LinkParts):  # type: ignore[misc]
    """A block that sends and one that receives, as one. Message ports: `pdus` in and out, `credit` in, as in
    :class:`SendingBlock` and :class:`ReceivingBlock`.

    :param radios: over how many radios it sends and receives
    :ivar end: its endpoint; of a robot that receives its own packets, the one that receives
    :ivar bound: what goes over one radio alone; None where nothing can
    """

    end: LiveEnd[Any]
    bound: BoundEnds | None = None

    def __init__(self, config: RobotConfig, radios: int = 1) -> None:
        super().__init__("ros2_link", gr.io_signature(0, 0, 0), gr.io_signature(0, 0, 0))
        self.config, self._radios = config, range(radios)

    def _connect(self) -> None:
        for pdus, credit in [(port_of("pdus", radio), port_of("credit", radio)) for radio in self._radios]:
            for port in (pdus, credit):
                self.message_port_register_hier_in(port)
            self.message_port_register_hier_out(pdus)
            if self.config.receives:
                self.msg_connect(self, pdus, self.sink, pdus)
            self.msg_connect(self, credit, self.source, credit)
            if self.config.direction != "receive":
                self.msg_connect(self.source, pdus, self, pdus)

    def close(self) -> None:
        if self.bound is not None:
            self.bound.close()
        LinkParts.close(self)


class RosLink(LinkBlock):
    """One robot's end of a link.

    :param config: settings of the robot
    :param air: what is known of the radio
    :param start: of the robot; None: it is counted here
    :param loops_back: whether it receives its own packets
    :param middleware: an open Middleware for both directions; None: opened as the settings say
    :param observer, clock, backpressure: see :class:`SendingBlock`
    :param registry: the topics that the robots know beforehand; None: as the settings say
    :param bond: its radios, where there are several
    :param ways: those of its radios over which topics may go alone, by their numbers
    :raises ConfigError: for settings that contradict each other
    """

    source: LinkSendingBlock

    def __init__(
        self,
        config: RobotConfig,
        *,
        air: Air | None = None,
        start: Start | None = None,
        loops_back: bool = False,
        middleware: Middleware | None = None,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        backpressure: bool = False,
        registry: Registry | None = None,
        bond: Bond | None = None,
        ways: Mapping[int, OwnWay] | None = None,
    ) -> None:
        super().__init__(config, 1 if bond is None else len(bond.carries))
        own = config
        if apart := {way.name for way in (ways or {}).values() if way.shares}:
            own = replace(config, offer={word: how for word, how in config.offer.items() if how.via not in apart})
        known = registry
        if known is None:
            known = Registry.from_csv(config.registry) if config.registry else Registry.empty()
        topics = known if config.sends else Registry.empty()
        calls = config.direction == "both" and not loops_back and has_room_for_calls(topics)
        if config.offer and not calls:
            raise ConfigError(
                "offer: nobody can ask over this link, which has no room or no way for calls; leave it out"
            )
        if config.backfill.topics and not calls:
            raise ConfigError("backfill: nobody is heard over this link, or it has no room for it; leave it out")
        air = air or Air(hears=config.direction == "both")
        self._start = start or start_of(config)
        heard = topics if registry is None else known
        check_outputs(heard, config.publish)

        make = partial(make_endpoint, config, topics, air=air, start=self._start)

        common: dict[str, Any] = {"observer": observer, "clock": clock, "bond": bond}
        sending = self.end = LiveEnd(lambda events: make(observer=events, calls=calls))
        if loops_back:
            self.end = LiveEnd(lambda events: make(observer=events, loops_back=True))
        graph, self._leave = joined(self, middleware, config.graph, link_node(config.robot_id))
        published = heard.with_options(config.publish.topics, announced=True)
        try:
            self.source = LinkSendingBlock(
                own, topics, sending, graph, backpressure=backpressure, takes=bound_to_none, **common
            )
            self.sink = ReceivingBlock(config, published, self.end, graph, **common)
            if ways and isinstance(self.source.ports, RadioPorts):
                self.bound = BoundEnds(
                    config,
                    ways,
                    known=heard,
                    graph=graph,
                    main=self.source,
                    ports=self.source.ports,
                    observer=observer,
                    clock=clock,
                )
                self.source.sharing = self.sink.apart = self.bound
                self.source.ports.left = self.bound.left
            if calls:
                self.calls = LiveCalls(self.end, self.source, self.sink, self.source.found)
                self.wishes = LiveWishes(
                    own,
                    self.calls,
                    self.source,
                    graph,
                    clock=clock,
                    alone=None if self.bound is None else self.bound.source_of,
                )
                self.throughput = LiveThroughput(
                    config, self.end, self.calls, self.sink, share=air.airtime_share, sends=air.hears, clock=clock
                )
                if config.backfill.topics:
                    self.backfill = LiveBackfill(config, self.end, self.source, share=air.airtime_share)
        except GrRos2Error:
            self.close()
            raise
        self._connect()

    def set_topics(self, topics: Any) -> None:
        """Use other options of single topics from now on."""
        self.source.set_topics(topics)
        self.config = self.source.config

    def close(self) -> None:
        """Leave the ROS graph, and let another process use the state file. Idempotent."""
        super().close()
        self._leave()
        self._start.close()


def make_link(
    *,
    half_duplex: bool = False,
    any_length: bool = False,
    medium: str = "exclusive",
    airtime_s: float = 0.0,
    slot_guard_s: float = GUARD_S,
    airtime_limit: str | Mapping[str, Any] = "",
    **values: Any,
) -> RosLink:
    """Make a link from settings in one list, as GRC does.

    :param half_duplex: whether sending and receiving share the airtime
    :param any_length: whether the PHY carries shorter packets in less time (:attr:`gr_ros2.phy.Phy.any_length`)
    :param airtime_limit: how much the radio may send, as its block says: what the robot says about itself becomes rarer
    :param medium: see :class:`gr_ros2.settings.config.AirConfig`
    :param airtime_s: of the longest packet, s; needed unless ``medium`` is exclusive
    :param slot_guard_s: silence between the packets of two robots, s: the timing error of the radio
    :param values: see :func:`gr_ros2.settings.robot.robot_from`
    :raises ConfigError: for an unknown setting, a value out of range, or settings that contradict each other
    """
    config = robot_from(**values)
    for name, options in config.options.items():
        if options.via != AUTO:
            raise ConfigError(f"topics.{name}.via = {options.via!r}: {ONE_RADIO}; leave it out")
    limits = airtime_from(airtime_limit)
    limits.check_seal(encrypts=bool(config.key) and config.seal == "encrypt")
    shares = medium != "exclusive"
    if shares and not airtime_s > 0:
        raise ConfigError(f"medium = {medium!r}: needs airtime_s above 0: that of the longest packet")
    air = Air(
        hears=config.direction == "both",
        half_duplex=half_duplex or shares,
        any_length=any_length,
        access=access_of(medium, airtime_s, secrets.randbits(32), guard_s=slot_guard_s, lead_s=LEAD_S),
        airtime_share=sustained(limits.rule),
        airtime_s=airtime_s,
    )
    return RosLink(config, air=air)
