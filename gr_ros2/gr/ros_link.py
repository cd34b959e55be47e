"""ROS Link: both directions of one robot in one block; ROS topics in and out, packets in and out.

With version 1, services cross the link too.

Invariant: the block contains a RosSource and a RosSink that share one endpoint. So received packets can change what is
sent.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

from gnuradio import gr

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.block_settings import read_registry
from gr_ros2.gr.calls import LiveCalls
from gr_ros2.gr.factory import EndpointSetup
from gr_ros2.gr.robot_blocks import RobotBlocks
from gr_ros2.gr.starts import start_of
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.link.airtime_limit import sustained
from gr_ros2.link.observe import LinkObserver
from gr_ros2.mac import GUARD_S, access_of
from gr_ros2.middleware import Middleware
from gr_ros2.settings.config import SinkConfig, SourceConfig, TopicOptions, airtime_from, build
from gr_ros2.settings.fields import AUTO, settings_of
from gr_ros2.settings.registry import MAX_TOPICS, Registry

_HEARD = EndpointSetup(reports=True)
"""Of a robot whose others hear it, on a channel of its own."""


class RosLink(gr.hier_block2):  # type: ignore[misc]
    """One robot's end of a link.

    Message ports: `pdus` in and out, `credit` in, as in :class:`RosSource` and :class:`RosSink`.

    :param registry: CSV path or Registry
    :param source: settings of the sending half
    :param sink: settings of the receiving half
    :param middleware: an open Middleware for the source and one for the sink; None: opened as the settings say
    :param setup: what is known of the radio; the start of the robot is counted here
    :param observer, clock, seed: see :class:`RosSource`
    :raises ConfigError: for settings that contradict each other
    """

    def __init__(
        self,
        registry: str | Registry,
        source: SourceConfig,
        sink: SinkConfig,
        *,
        setup: EndpointSetup = _HEARD,
        middleware: tuple[Middleware, Middleware] | None = None,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        seed: int | None = None,
    ) -> None:
        super().__init__("ros2_link", gr.io_signature(0, 0, 0), gr.io_signature(0, 0, 0))
        topics = read_registry(registry, needed=not source.version)
        start = self._start = start_of(source, source.src_id(), setup)
        calls = source.version != 0 and (len(topics) < MAX_TOPICS or bool(topics.services))
        graphs = middleware or (source.middleware, sink.middleware)
        common: dict[str, Any] = {"observer": observer, "clock": clock, "seed": seed, "calls": calls}
        blocks = RobotBlocks(topics, source, sink, start=start, **common)
        self.end, self.source, self.sink = blocks.end, blocks.source(graphs[0]), blocks.sink(graphs[1])
        self.calls: LiveCalls | None = None
        """The services that cross the link; None with version 0, and where topics leave no room for calls."""
        if calls:
            self.calls = LiveCalls(self.end, self.source, self.sink)
        for port in ("pdus", "credit"):
            self.message_port_register_hier_in(port)
        self.message_port_register_hier_out("pdus")
        self.msg_connect(self, "pdus", self.sink, "pdus")
        self.msg_connect(self, "credit", self.source, "credit")
        self.msg_connect(self.source, "pdus", self, "pdus")

    def close(self) -> None:
        """Leave the ROS graphs, and let another process use the state file. Idempotent."""
        if self.calls is not None:
            self.calls.close()
        self.source.close()
        self.sink.close()
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
    """Make a link from the settings of both halves in one list, as GRC does.

    :param half_duplex: whether sending and receiving share the airtime
    :param any_length: see :class:`RosSource`
    :param airtime_limit: how much the radio may send, as its block says: what the robot says about itself becomes rarer
    :param medium: see :class:`gr_ros2.settings.config.AnyLink`
    :param airtime_s: of the longest packet, s; needed unless ``medium`` is exclusive
    :param slot_guard_s: silence between the packets of two robots, s: the timing error of the radio
    :param values: fields of SourceConfig and of SinkConfig; a field that both have applies to both halves, and of
        ``topic_options`` to each half what it has
    :raises ConfigError: for an unknown setting, a value out of range, or settings that contradict each other
    """
    halves: list[Any] = []
    known: set[str] = set()
    for cls in (SourceConfig, SinkConfig):
        names = {field.name for field in fields(cls)}
        known |= names
        own = {name: value for name, value in values.items() if name in names}
        halves.append(build(cls, own | {"topic_options": _of_half(cls.end, own.get("topic_options", {}))}))
    unknown = sorted(values.keys() - known)
    if unknown:
        raise ConfigError(f"unknown key {unknown[0]}; known are {', '.join(sorted(known))}")
    source, sink = halves
    if sink.robot_id == AUTO:  # by it the sink knows the robot's own packets
        sink = replace(sink, robot_id=source.src_id())
    limits = airtime_from(airtime_limit)
    limits.check_seal(encrypts=bool(source.key) and source.seal == "encrypt")
    shares = medium != "exclusive"
    if shares and not (source.version and airtime_s > 0):
        raise ConfigError(f"medium = {medium!r}: needs version 1, and airtime_s above 0: that of the longest packet")
    setup = EndpointSetup(
        reports=True,
        half_duplex=half_duplex or shares,
        any_length=any_length,
        access=access_of(medium, airtime_s, secrets.randbits(32), guard_s=slot_guard_s, lead_s=LEAD_S),
        airtime_share=sustained(limits.rule),
        airtime_s=airtime_s,
    )
    return RosLink(source.registry, source, sink, setup=setup)


def _of_half(end: str, topic_options: Any) -> Any:
    """Options of topics without those that the other half alone has."""
    if not isinstance(topic_options, Mapping):
        return topic_options  # build() says what is wrong with it
    others = {setting.name for setting in settings_of(TopicOptions) if setting.end not in (None, end)}
    return {
        topic: {name: value for name, value in given.items() if name not in others}
        if isinstance(given, Mapping)
        else given
        for topic, given in topic_options.items()
    }
