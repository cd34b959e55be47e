"""ROS Link: both directions of one robot in one block; ROS topics in and out, packets in and out.

Services cross the link too.

Invariant: the block contains a RosSource and a RosSink that share one endpoint. So received packets can change what is
sent.
"""

from __future__ import annotations

import secrets
import time
import weakref
from collections.abc import Callable, Mapping
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
from gr_ros2.middleware import Middleware, join
from gr_ros2.settings.config import airtime_from, build, replaced
from gr_ros2.settings.registry import MAX_TOPICS
from gr_ros2.settings.robot import RobotConfig, halves

_HEARD = EndpointSetup(reports=True)
"""Of a robot whose others hear it, on a channel of its own."""


class RosLink(gr.hier_block2):  # type: ignore[misc]
    """One robot's end of a link.

    Message ports: `pdus` in and out, `credit` in, as in :class:`RosSource` and :class:`RosSink`.

    :param config: settings of the robot
    :param setup: what is known of the radio; the start of the robot is counted here
    :param middleware: an open Middleware for both directions; None: opened as the settings say
    :param observer, clock, seed: see :class:`RosSource`
    :raises ConfigError: for settings that contradict each other
    """

    def __init__(
        self,
        config: RobotConfig,
        *,
        setup: EndpointSetup = _HEARD,
        middleware: Middleware | None = None,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        seed: int | None = None,
    ) -> None:
        super().__init__("ros2_link", gr.io_signature(0, 0, 0), gr.io_signature(0, 0, 0))
        self.config = config
        source, sink = halves(config)
        topics = read_registry(config.registry if config.sends else "", needed=False)
        start = self._start = start_of(source, config.robot_id, setup)
        calls = config.direction == "both" and (len(topics) < MAX_TOPICS or bool(topics.services))
        common: dict[str, Any] = {"observer": observer, "clock": clock, "seed": seed, "calls": calls}
        blocks = RobotBlocks(topics, source, sink, start=start, **common)
        self._graph = middleware or join(config.graph, f"gr_ros2_link_{config.robot_id}")
        self._leave = weakref.finalize(self, self._graph.close if middleware is None else lambda: None)
        self.end, self.source, self.sink = blocks.end, blocks.source(self._graph), blocks.sink(self._graph)
        self.calls: LiveCalls | None = None
        """The services that cross the link; None where topics leave no room for calls."""
        if calls:
            self.calls = LiveCalls(self.end, self.source, self.sink)
        for port in ("pdus", "credit"):
            self.message_port_register_hier_in(port)
        self.message_port_register_hier_out("pdus")
        if config.receives:
            self.msg_connect(self, "pdus", self.sink, "pdus")
        self.msg_connect(self, "credit", self.source, "credit")
        if config.direction != "receive":
            self.msg_connect(self.source, "pdus", self, "pdus")

    def set_topics(self, topics: Any) -> None:
        """Use other options of single topics, of which ``to``, ``queue`` and others may change; see
        :meth:`RosSource.set_topic_options`."""
        config = replaced(self.config, topics=topics)
        self.source.set_topic_options(halves(config)[0].topic_options)
        self.config = config

    def close(self) -> None:
        """Leave the ROS graph, and let another process use the state file. Idempotent."""
        if self.calls is not None:
            self.calls.close()
        self.source.close()
        self.sink.close()
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
    :param any_length: see :class:`RosSource`
    :param airtime_limit: how much the radio may send, as its block says: what the robot says about itself becomes rarer
    :param medium: see :class:`gr_ros2.settings.config.AirConfig`
    :param airtime_s: of the longest packet, s; needed unless ``medium`` is exclusive
    :param slot_guard_s: silence between the packets of two robots, s: the timing error of the radio
    :param values: fields of RobotConfig; those of its ``graph`` and ``publish`` as ``graph_domain_id``, ``publish_as``
    :raises ConfigError: for an unknown setting, a value out of range, or settings that contradict each other
    """
    parts: dict[str, dict[str, Any]] = {"graph": {}, "publish": {}}
    for name in list(values):
        part, _, setting = name.partition("_")
        if part in parts and setting:
            parts[part][setting] = values.pop(name)
    config = build(RobotConfig, {**parts, **values})
    limits = airtime_from(airtime_limit)
    limits.check_seal(encrypts=bool(config.key) and config.seal == "encrypt")
    shares = medium != "exclusive"
    if shares and not airtime_s > 0:
        raise ConfigError(f"medium = {medium!r}: needs airtime_s above 0: that of the longest packet")
    setup = EndpointSetup(
        reports=config.direction == "both",
        half_duplex=half_duplex or shares,
        any_length=any_length,
        access=access_of(medium, airtime_s, secrets.randbits(32), guard_s=slot_guard_s, lead_s=LEAD_S),
        airtime_share=sustained(limits.rule),
        airtime_s=airtime_s,
    )
    return RosLink(config, setup=setup)
