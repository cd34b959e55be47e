"""One robot's end of a link as a flowgraph: from its ROS graph to the air and back, until it is stopped.

Invariants: neither direction waits for the other. Packets leave at the pace of the air, and each is composed just
before it leaves. A robot ignores its own packets, except from a front end that loops back. `stop` releases everything
that was opened. If opening fails half-way, everything is released too.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from gr_ros2.gr import RosLink, RosSink, RosSource
from gr_ros2.gr.calls import LiveCalls
from gr_ros2.gr.ends import own_settings
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.middleware import Middleware, join_graph
from gr_ros2.phy import configured
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.diagnostics import Diagnostics
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.radio import Radio
from gr_ros2.settings.config import SinkConfig
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import Registry

_log = logging.getLogger(__name__)


class RobotLink(Flowgraph):
    """A robot's end of a link.

    :param config: see :class:`LinkConfig`
    :param middleware: an open Middleware for both blocks, which the caller closes; None: opened as the configuration
        says
    :param observer: called with everything that is sent and received. If it raises, it is not called again, and the
        link continues
    :param clock: clock of events and blocks, s, monotonic
    :param instrumented: see :class:`gr_ros2.radio.radio.Radio`
    :raises ConfigError: when the parts do not fit together
    :raises MiddlewareError: when the ROS graph cannot be joined
    :raises RadioError: when the front end cannot be opened
    """

    def __init__(
        self,
        config: LinkConfig,
        *,
        middleware: Middleware | None = None,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        instrumented: bool = False,
    ) -> None:
        super().__init__(f"gr_ros2_link_{config.name}", config.name)
        self.config = config
        self._registry = config.load_registry()
        self._clock = clock
        self._started: float | None = None
        self._instrumented = instrumented
        self._stack = ExitStack()
        self._observers = Observers[LinkObserver](() if observer is None else (observer,))
        try:
            self._open(middleware, self._observers if observer is not None else None)
        except BaseException:
            self._stack.close()
            raise

    def _open(self, middleware: Middleware | None, observer: LinkObserver | None) -> None:
        config = self.config
        rate = config.phy.sample_rate
        self.phy = configured(config.phy, config.packet_len, 0.0 if rate == AUTO else rate)
        self.front_end: FrontEnd = FRONT_ENDS.load(config.front_end_name)(self.phy, **config.front_end_options)
        self._stack.callback(self.front_end.close)
        self.radio = Radio(
            self.phy, self.front_end, channel=config.channel, record=config.record, instrumented=self._instrumented
        )
        self._stack.callback(self.radio.close)
        self.calls: LiveCalls | None = None
        """The services that cross the link; None with version 0 and where the front end loops back."""
        graphs = self._graphs(middleware)
        if self.front_end.loops_back:
            self._two_blocks(graphs, observer)
        else:
            self._one_block(graphs, observer)
        self.source.use_credit()
        self._diagnostics: Diagnostics | None = None
        if config.diagnostics.period_s:
            self._diagnostics = Diagnostics(
                config.diagnostics, graphs[1], self.node_name, self.stats, clock=self._clock
            )
            self._stack.callback(self._diagnostics.stop)

    def _one_block(self, graphs: tuple[Middleware, Middleware], observer: LinkObserver | None) -> None:
        """Both directions share one endpoint, so that received packets can change what is sent."""
        both = RosLink(
            self._registry,
            self.config.ros_source,
            self._sink_config(),
            middleware=graphs,
            half_duplex=getattr(self.front_end.options, "half_duplex", False),
            any_length=self.phy.any_length,
            ladder=self.phy.ladder,
            observer=observer,
            clock=self._clock,
        )
        self._stack.callback(both.close)
        self.source, self.sink, self.calls = both.source, both.sink, both.calls
        self.msg_connect(both, "pdus", self.radio, "pdus")
        self.msg_connect(self.radio, "credit", both, "credit")
        self.msg_connect(self.radio, "pdus", both, "pdus")

    def _two_blocks(self, graphs: tuple[Middleware, Middleware], observer: LinkObserver | None) -> None:
        """A robot that receives its own packets has two endpoints: one sends and one receives."""
        common: dict[str, Any] = {"observer": observer, "clock": self._clock}
        source, sink = own_settings(self.config.ros_source), own_settings(self.config.ros_sink)
        carried: dict[str, Any] = {"any_length": self.phy.any_length, "ladder": self.phy.ladder}
        self.source = RosSource(self._registry, middleware=graphs[0], **carried, **common, **source)
        self._stack.callback(self.source.close)
        self.sink = RosSink(self._registry, middleware=graphs[1], **common, **sink)
        self._stack.callback(self.sink.close)
        self.msg_connect(self.source, "pdus", self.radio, "pdus")
        self.msg_connect(self.radio, "credit", self.source, "credit")
        self.msg_connect(self.radio, "pdus", self.sink, "pdus")

    @property
    def node_name(self) -> str:
        """The node name that ``ros2 node list`` shows."""
        return f"gr_ros2_link_{self.config.ros_source.src_id()}"

    @property
    def registry(self) -> Registry:
        """The topics that are sent; it grows if they are looked for on the ROS graph."""
        return self.source.registry

    def _graphs(self, middleware: Middleware | None) -> tuple[Middleware, Middleware]:
        """The participants of source and sink: one for both if they are on the same graph."""
        if middleware is not None:
            return middleware, middleware
        source, sink = self.config.ros_source, self.config.ros_sink
        places = [(source.middleware, source.domain_id), (sink.middleware, sink.domain_id)]
        opened = {place: self._graph(*place) for place in dict.fromkeys(places)}
        return opened[places[0]], opened[places[1]]

    def _graph(self, name: str, domain_id: int | Auto) -> Middleware:
        graph = join_graph(
            name, domain_id=domain_id, node_name=self.node_name, localhost_only=self.config.localhost_only
        )
        self._stack.callback(graph.close)
        return graph

    def _sink_config(self) -> SinkConfig:
        """The settings of the sink. Its robot id lets it recognise the robot's own packets on a shared medium."""
        sink = self.config.ros_sink
        if sink.robot_id == AUTO:
            return replace(sink, robot_id=self.config.ros_source.src_id())
        return sink

    def start(self, max_noutput_items: int = 10_000_000) -> None:
        """Begin sending and receiving.

        :raises PhyError: when GNU Radio refuses the flowgraph
        """
        super().start(max_noutput_items)
        self._started = self._clock()
        if self.remark:
            _log.info("link %s: %s", self.config.name, self.remark)
        self.phy.prefer_latency()
        if self._diagnostics is not None:
            self._diagnostics.start()

    def stop(self) -> None:
        """Stop, leave the ROS graph and close the front end. Idempotent. A stopped link cannot start again."""
        super().stop()
        # A device is released with its blocks. The flowgraph would keep them as long as it exists itself.
        self.disconnect_all()
        self._stack.close()

    def check(self) -> None:
        """Check the device. Call this from time to time while the link runs, for instance with each call of `stats`.

        :raises RadioError: when the device gives or takes no more samples; GNU Radio does not report this
        """
        if self._running:
            self.front_end.check(self._clock())

    @property
    def remark(self) -> str:
        """A remark for the person who starts the link; often empty."""
        open_to_all = self.config.version and not self.config.key
        return "no key, so anybody can read, forge and replay its packets (gr-ros2 key new FILE)" if open_to_all else ""

    @property
    def finished(self) -> bool:
        """Whether nothing more will be received, as at the end of a replayed recording."""
        return self.front_end.finished

    def incomplete(self) -> list[str]:
        """What observers missed and what the recording lacks: one line each, with reason and number; often none."""
        return [*self._observers.incomplete(), *self.radio.incomplete()]

    def stats(self) -> dict[str, Any]:
        """A snapshot: both blocks, calls of services, packets to and from the air, the PHY, the counters of the front
        end, and :meth:`incomplete`."""
        phy, counts, front_end = self.phy, self.radio.counts(), self.front_end.counters()
        return {
            "name": self.config.name,
            "uptime_s": 0.0 if self._started is None else self._clock() - self._started,
            "source": self.source.stats(),
            "sink": self.sink.stats(),
            "calls": {} if self.calls is None else self.calls.stats(),
            "packets": {
                "out": counts.passed,
                "backlog": counts.backlog,
                "refused": self.radio.refused,
                "in": self.sink.handled,
                "damaged": self.radio.damaged,
                "foreign": self.radio.foreign,
                "dropped": dict(counts.losses),
            },
            "phy": {
                "name": phy.name,
                "sample_rate": phy.sample_rate if phy.has_samples else None,
                "airtime_s": self.front_end.airtime(),
                "snr_db": self.radio.snr_db,
                **self.source.rate(),
            },
            "front_end": {
                "name": self.front_end.name,
                "passed": front_end.passed,
                "lost": {**front_end.lost, **self.radio.recorded()},
            },
            "incomplete": self.incomplete(),
        }
