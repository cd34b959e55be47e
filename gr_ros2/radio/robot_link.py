"""One robot's end of a link as a flowgraph: from its ROS graph to the air and back, until it is stopped.

Invariants: neither direction waits for the other. Packets leave at the pace of the air, and each is composed just
before it leaves. A robot ignores its own packets, except from a front end that loops back. `stop` releases everything
that was opened. If opening fails half-way, everything is released too.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import ExitStack
from functools import cached_property, partial
from math import inf
from typing import Any

from gr_ros2.core.errors import RadioError
from gr_ros2.core.watch import Watch
from gr_ros2.gr.ros_link import LinkBlock, RosLink
from gr_ros2.link.airtime_limit import AirtimeLimit
from gr_ros2.link.endpoint import without_table
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.middleware import Middleware
from gr_ros2.middleware.services import ServiceGraph
from gr_ros2.phy import configured
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.diagnostics import Diagnostics
from gr_ros2.radio.findings import about, doubled, introduce, outrun, peers, ping, same_id, unheard
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.limits import open_limit
from gr_ros2.radio.mismatch import Mismatch
from gr_ros2.radio.permission import permitted
from gr_ros2.radio.radio import Radio
from gr_ros2.radio.ros_side import RosSide
from gr_ros2.radio.switch import TransmitSwitch
from gr_ros2.radio.waiting import foreign, shortcut
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry

_STOP_S, _RETRY_S = 10.0, 1.0
"""s that a flowgraph may take to stop when its device has vanished, and s between two attempts to open it."""
STALLED_S = 10.0
"""s after which a thread that sends counts as stuck: longer than a busy computer makes it wait."""
_log = logging.getLogger(__name__)


class RobotLink(Flowgraph):
    """A robot's end of a link.

    :param config: see :class:`LinkConfig`
    :param middleware: an open Middleware, which the caller closes; None: opened as the configuration
        says
    :param observer: called with everything that is sent and received. If it raises, it is not called again, and the
        link continues
    :param instrumented: see :class:`gr_ros2.radio.radio.Radio`
    :param front_end: opens the front end, given the PHY and ``transmits``; it has no radio. None: the one that the
        configuration names
    :param block: makes the block between the ROS graph and the radio, as :class:`RosLink` does
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
        instrumented: bool = False,
        front_end: Callable[..., FrontEnd] | None = None,
        block: Callable[..., LinkBlock] = RosLink,
    ) -> None:
        super().__init__(f"gr_ros2_link_{config.name}", config.name)
        self.config = config
        self._started: float | None = None
        self._instrumented = instrumented
        self._made_front_end, self._block = front_end, block
        self._retry_at = inf
        """When a device that has vanished is tried again, s; infinite while there is one."""
        self._interruptions = self._passed_before = 0
        self._worked = False
        """Whether the front end has worked once; if not, nothing has vanished."""
        self._outrun: dict[str, int] = {}
        self._watches = Watch(), Watch()
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
        self.sends = config.direction != "receive"
        """Whether it may send at all."""
        if self._made_front_end is None:
            kind: type[FrontEnd] = FRONT_ENDS.load(config.front_end_name)
            guarded = bool(config.key) or config.open
            self.sends = self.sends and permitted(config.transmit, kind, config.front_end_options, guarded=guarded)
            self._made_front_end = partial(kind, **config.front_end_options)
        self._open_radio()
        self._stack.callback(self._close_radio)
        self._clock = self.front_end.clock
        self._ros = RosSide(
            config,
            self.phy,
            self.front_end,
            sends=self.sends,
            middleware=middleware,
            observer=observer,
            clock=self._clock,
            block=self._block,
            stack=self._stack,
        )
        self.node_name, graph = self._ros.node_name, self._ros.graph
        link = self._ros.link
        self.source, self.sink, self.end, self.calls = link.source, link.sink, link.end, link.calls
        self._connect_radio()
        if self.phy.has_airtime:  # without, nothing sets a pace
            self.source.use_credit()
        told = about(config, self.phy)
        if hasattr(self.end.endpoint, "questions"):  # the paper's robots ask nothing
            introduce(self.end, told, lambda: self.radio.snr_db, self._clock())
        self._mismatch = Mismatch(told, self.ping)
        if isinstance(graph, ServiceGraph):
            switch = TransmitSwitch(graph, self.node_name, lambda on: self.transmit(on=on))
            self._stack.callback(switch.close)
        self._diagnostics: Diagnostics | None = None
        if config.diagnostics.period_s:
            self._diagnostics = Diagnostics(config.diagnostics, graph, self.node_name, self.stats, clock=self._clock)
            self._stack.callback(self._diagnostics.stop)

    def _open_radio(self) -> None:
        """Open the front end, and make the radio around it.

        :raises RadioError: when it cannot be opened
        """
        assert self._made_front_end is not None
        self.front_end = self._made_front_end(self.phy, transmits=self.sends)
        try:
            self.radio = Radio(
                self.phy,
                self.front_end,
                channel=self.config.channel,
                record=self.config.record,
                limit=self._limit,
                listens=self.config.airtime.listen_before_send and self.sends,
                instrumented=self._instrumented,
            )
        except BaseException:
            self.front_end.close()
            raise

    def _close_radio(self) -> None:
        self.radio.close()

    def _connect_radio(self) -> None:
        """Connect the radio with the blocks of ROS."""
        link = self._ros.link
        if self.sends:
            self.msg_connect(link, "pdus", self.radio, "pdus")
            if self.phy.has_airtime:
                self.msg_connect(self.radio, "credit", link, "credit")
            self.front_end.follow(self._at_rest)
        if self.config.receives:
            self.msg_connect(self.radio, "pdus", link, "pdus")

    def _lose(self, error: RadioError) -> None:
        """The device has vanished: close it, and wait for it. The rest of the link keeps its state."""
        _log.warning("%s; waiting for it", error)
        self._interruptions += 1
        stopping = threading.Thread(target=super().stop, daemon=True)
        stopping.start()
        stopping.join(_STOP_S)
        if stopping.is_alive():  # the driver does not return; a new process is needed
            raise error
        self._passed_before += self.radio.counts().passed
        self.disconnect_messages()
        self.disconnect_all()
        self.radio.close()
        self._retry_at = self._clock() + _RETRY_S

    def _retry(self) -> None:
        """Open the device again, if it is there."""
        if self._clock() < self._retry_at:
            return
        transmits = self.radio.gate.account()["transmits"]
        try:
            self._open_radio()
        except RadioError as error:
            _log.debug("link %s: %s", self.config.name, error)
            self._retry_at = self._clock() + _RETRY_S
            return
        self._retry_at = inf
        if not transmits:
            self.radio.transmit(on=False)
        self._connect_radio()
        super().start()
        _log.warning("link %s: front end %s is back", self.config.name, self.front_end.name)

    @cached_property
    def _limit(self) -> AirtimeLimit | None:
        """What limits the airtime, with what earlier starts of this robot have sent."""
        if not self.sends:
            return None
        config, longest, now = self.config, self.front_end.airtime(), self.front_end.clock()
        return open_limit(
            config.airtime, longest, now, robot_id=config.robot_id, state=config.state, closing=self._stack
        )

    def transmit(self, *, on: bool) -> None:
        """Switch sending off, at once for all packets that have not reached the device, or on again.

        :raises ConfigError: where it only receives
        """
        self.radio.transmit(on=on)
        _log.warning("link %s: sending is %s", self.config.name, "on" if on else "off")

    def _at_rest(self) -> int | None:
        """As :meth:`Radio.at_rest`; None also while a packet is composed or has to be."""
        if self.source.composed != self.radio.gate.arrived or self.source.due(self._clock()):
            return None
        return self.radio.at_rest()

    @property
    def registry(self) -> Registry:
        """The topics that are sent; it grows if they are looked for on the ROS graph."""
        return self.source.subscriptions.registry

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
        if self._running:
            self.radio.drain()
        self._retry_at = inf
        super().stop()
        # A device is released with its blocks. The flowgraph would keep them as long as it exists itself.
        self.disconnect_all()
        self._stack.close()

    def check(self) -> None:
        """Check the device and the threads that send. Call this from time to time while the link runs.

        A device that has vanished is waited for, and opened again.

        :raises RadioError: when a device that cannot come back gives or takes no more samples, which GNU Radio does not
            report; when its driver does not stop; when a thread that sends does not go on
        """
        if self._retry_at < inf:
            self._retry()
        if not self._running:
            return
        now, pacing, sending = self._clock(), *self._watches
        for thread, watch, told_s in (
            ("sending thread", sending, self.source.stalled_s(now)),
            ("thread that paces packets", pacing, self.radio.gate.stalled_s()),
        ):
            stalled_s = inf if told_s == inf else watch.age(told_s, now)  # infinite: it has ended
            if stalled_s > STALLED_S:
                raise RadioError(
                    f"link {self.config.name}: the {thread} has not gone on for {stalled_s:.0f} s; start the link "
                    "again, and report what it was doing (py-spy dump)"
                )
        try:
            self.front_end.check(now)
            self._worked = True
        except RadioError as error:
            if not (self.front_end.may_return and self._worked):
                raise
            self._lose(error)

    def ping(self, robot: int, *, anew: bool = False) -> dict[str, Any]:
        """Ask another robot, which answers at once; returns what has come of all questions to it so far.

        :param anew: forget the earlier ones
        :raises ConfigError: for a number that no robot has
        """
        return {**ping(self.end, robot, self._clock(), anew=anew), **self.source.rate()}

    @property
    def remark(self) -> str:
        """A remark for the person who starts the link; often empty."""
        if self.config.key:
            return ""
        return "no key, so anybody can read, forge and replay its packets (gr-ros2 key new FILE)"

    def findings(self) -> list[str]:
        """What a person should know about this link and its surroundings: one line each, mostly none."""
        now, own = self._clock(), self.config.robot_id
        stats = self.stats()
        heard = stats["peers"]
        robots = [peer["robot"] for peer in heard]
        graph = self._ros.graph
        names = {info.topic for info in graph.discover() if info.publishers}
        services = graph.discover_services() if isinstance(graph, ServiceGraph) else ()
        full, self._outrun = outrun(self._outrun, stats["source"]["topics"])
        lines = [
            shortcut([*names, *services], own, robots),
            foreign(names, stats["sink"]["topics"]),
            *self._same_numbers(heard),
            *without_table(peer["robot"] for peer in heard if peer["no_table"]),
            full if self._ros.shares else None,
            *self._mismatch.lines(stats, robots, now),
        ]
        with self.end.lock:
            if self._ros.slots is not None and self._ros.slots.unheard(now):
                lines.append(unheard(own, robots))
        return [line for line in lines if line is not None]

    def same_numbers(self) -> list[str]:
        """One line for each number under which two robots send."""
        return self._same_numbers(peers(self.end, self._clock()))

    def _same_numbers(self, heard: list[dict[str, Any]]) -> list[str]:
        with self.end.lock:
            own = same_id(self.config.robot_id, self.end.endpoint.received.rejected)
        return [*([own] if own else []), *doubled(heard)]

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
        vanished = {"interruptions": self._interruptions} if self._interruptions else {}
        return {
            "name": self.config.name,
            "uptime_s": 0.0 if self._started is None else self._clock() - self._started,
            "source": self.source.stats(),
            "sink": self.sink.stats(),
            "peers": peers(self.end, self._clock()),
            "calls": {} if self.calls is None else self.calls.stats(),
            "packets": {
                "out": self._passed_before + counts.passed,
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
                "rssi_dbm": self.front_end.rssi_dbm,
                **self.source.rate(),
            },
            "front_end": {
                "name": self.front_end.name,
                "passed": front_end.passed,
                "lost": {**front_end.lost, **vanished, **self.radio.recorded()},
            },
            "airtime": self.radio.gate.account(),
            "incomplete": self.incomplete(),
        }
