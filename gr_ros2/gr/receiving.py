"""The half of a link's block that receives: packets in on message port `pdus`, ROS topics out (the paper, sections 4.2,
4.4).

Invariants: this block is a thin shell. All behaviour is in the link's engine, which one lock protects. Only the bytes
of a PDU are trusted. The message handler and the timeout thread never raise, because an exception would end them while
the flowgraph seems to run. Messages are published in the order in which they become complete. A message counts as
delivered only after it was published. Everything else is counted by name.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from math import inf
from typing import Any, Protocol

from gr_ros2.core.errors import GrRos2Error
from gr_ros2.gr.early import CHECK_S
from gr_ros2.gr.failures import Failures
from gr_ros2.gr.half import HalfBlock
from gr_ros2.gr.latency import RECENT
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.loops import LOOP_GUARD
from gr_ros2.gr.outputs import Outputs
from gr_ros2.gr.readable import describe
from gr_ros2.link import AirPacket, Delivered, Received, ReceiverEvent, Rejected
from gr_ros2.link.bond import Bond
from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.events import Announced
from gr_ros2.link.fates import Fate
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware import Middleware
from gr_ros2.middleware.services import ServiceGraph
from gr_ros2.middleware.type_search import TypeSearch
from gr_ros2.phy.pdus import packets_of, take_messages
from gr_ros2.phy.threads import wait_until_s
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.settings.robot import RobotConfig

_SHORTEST_WAIT_S = 1e-3
_MOST_JOINED = 65535
"""Bytes of the longest PDU that is cut into packets; this bounds the work for one."""
_COUNTED = (
    *("not_a_pair", "not_u8", "joined", Fate.PUBLISH_FAILED.value, "handler_failed", "bad_announcement"),
    *("frame_unknown_type", "frame_damaged", "tf_damaged", "tf_static_full", "tf_failed"),
    *("stamp_unknown_type", "stamp_damaged", "stamps_not_moved"),
)


class Services(Protocol):
    """What handles the services of other robots, and the requests and replies that arrive."""

    def takes(self, event: ReceiverEvent) -> bool:
        """Handle what an event means for services; returns whether it was a request or a reply."""

    def learn(self, src_id: int, topics: Sequence[Topic]) -> None:
        """Take over the topics and services that a robot announces now."""


class Apart(Protocol):
    """The endpoints that have one radio alone, see :mod:`gr_ros2.gr.bound`."""

    def take(self, radio: int, packets: Sequence[AirPacket]) -> list[AirPacket]:
        """Take what is for them of the packets that have come over a radio; returns the others."""


class ReceivingBlock(HalfBlock):
    """Reassembles packets into messages and publishes them on a ROS graph.

    Message port: `pdus` in (PMT pair of anything and a u8vector), with several radios also `pdus_2` and so on. The
    first message of each sender and topic creates a publisher.

    :param registry: the topics of other robots that announce none, with configured options
    :param end, graph, clock, bond: see :class:`HalfBlock`
    :param observer: called with every ReceiverEvent, in order; with Delivered after the message was published. An
        observer that raises is not called again
    :raises ConfigError: when it would publish what a robot of this process sends
    """

    live_settings = ("debug",)
    """Settings that may change while it runs, each by its setter."""

    def __init__(
        self,
        config: RobotConfig,
        registry: Registry,
        end: LiveEnd[Endpoint],
        graph: Middleware,
        *,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        bond: Bond | None = None,
    ) -> None:
        super().__init__("ros2_sink", config, end, graph, observer=observer, clock=clock, bond=bond)
        self.registry = registry
        self._calls: Services | None = None
        self.apart: Apart | None = None
        """What takes packets that are not for the endpoint of this block."""
        self._looks_at = -inf
        """Time in s at which the thread of timeouts looks again by itself; -inf while it is awake."""
        self._failures = Failures(self._log, self._lock)
        self._types: TypeSearch | None = None
        self._said: set[str] = set()
        self._heard: dict[int, float] = {}
        """When a packet of each robot was taken last, s."""
        self._packets: Counter[int] = Counter()
        """Packets of each robot that were taken."""
        self._events: deque[ReceiverEvent] = deque()
        """What has happened and is not handled yet, in order."""
        self._settling = threading.RLock()
        """Held by the one thread that handles them: those of several radios and of timeouts bring some."""
        self.handled = 0
        """Number of PDUs that this block has finished with, whatever the result."""
        take_messages(self, "pdus", "_handle", self.radios, called="take")
        try:
            LOOP_GUARD.add_sink(self, graph, config.publish, registry)
            self.outputs = Outputs(
                self,
                registry,
                config,
                graph,
                end,
                tell=self._tell,
                clock=clock,
                failures=self._failures,
                log=self._log,
            )
            """What it publishes."""
        except GrRos2Error:
            LOOP_GUARD.remove(self)
            raise

    def share(self, calls: Services) -> None:
        """Hand over what concerns services."""
        self._calls = calls

    @property
    def matched(self) -> bool:
        """Whether every publisher has found a subscription."""
        return all(publisher.matched() for publisher in self.outputs.publishers())

    def start(self) -> bool:
        with self._lock:
            self._running = self.outputs.running = True
        self._thread.start(self._watch_timeouts, "gr-ros2-sink")
        if isinstance(self.middleware, ServiceGraph):
            self._types = TypeSearch(self.middleware, self.outputs.types, self.outputs.define)
        return True

    def stop(self) -> bool:
        self._stop_search()
        with self._lock:
            self._running = self.outputs.running = False
            self.outputs.due.notify_all()
        self._thread.stop()
        self.outputs.release(self.outputs.opening)
        return True

    def close(self) -> None:
        """Publish nothing any more. Idempotent."""
        self._stop_search()
        self.outputs.close()
        LOOP_GUARD.remove(self)

    def stats(self) -> dict[str, Any]:
        """A snapshot. ``packet_loss_est`` and ``message_loss_est`` are estimates from gaps in numbers."""
        with self._lock:
            stats, topics, windows = self._end.received, self.outputs.stats(), self.outputs.windows()
            counted = {
                "packets": stats.packets,
                "packets_of": dict(self._packets),
                "handled": self.handled,
                "rejected": dict(stats.rejected),
                "dropped": dict(stats.dropped),
                **{name: self._failures.counters[name] for name in _COUNTED},
                "observer_missed": self._guard.missed,
                "repeats": stats.repeats,
                "repaired": stats.repaired.total(),
                "packet_loss_est": stats.packet_loss_est,
                "unknown_gaps": stats.unknown_gaps,
                "message_loss_est": stats.message_loss_est,
                "silence_s": {src_id: self.clock() - at for src_id, at in self._heard.items()},
                "held_bytes": self._end.held_bytes,
                "no_table": [peer.robot for peer in self._end.peers(self.clock()) if peer.no_table],
                "latency_clock": "stamp_sim" if self.config.graph.use_sim_time else "stamp_wall",
                "middleware": dict(self.middleware.counters),
            }
        # There may be thousands of latencies. They are sorted without the lock, because the next packet waits for it.
        for key in topics.keys() & windows.keys():
            window = windows[key]
            summaries = {"latency_s": window.summary(), "recent_latency_s": window.summary(RECENT)}
            topics[key] |= {name: summary._asdict() for name, summary in summaries.items()}
        named: dict[str, dict[str, Any]] = {}
        for key, topic in topics.items():  # of a topic that has changed its type, the newest has the figures
            name = self.outputs.heard.name(key)
            if name in named:
                topic["delivered"] += named[name]["delivered"]
            named[name] = topic
        return {**counted, "topics": named}

    def _stop_search(self) -> None:
        if self._types is not None:
            self._types.close()
            self._types = None

    def _handle(self, message: Any, radio: int = 0) -> None:
        packets, problem = packets_of(message)
        if problem:
            self._failures.note(problem, f"ros2_sink: a message that is no PDU of bytes ({problem}) was dropped")
            self.handled += 1
        else:
            self.take(packets, radio)

    def take(self, packets: Sequence[AirPacket], radio: int = 0) -> None:
        """Packets have come from a radio."""
        try:
            own = packets if self.apart is None else self.apart.take(radio, packets)
            self._take([piece for packet in own for piece in self._cut(packet)], radio)
        except Exception as error:  # noqa: BLE001 - an exception would end the block's thread and all reception
            self._failures.note("handler_failed", "ros2_sink", error, level=logging.ERROR)
        self.handled += len(packets)

    def _cut(self, packet: AirPacket) -> list[AirPacket]:
        """The packets in one PDU: a TCP socket joins them. The trailer of each then says whether it is one."""
        most, data = self.config.packet_len, packet.data
        if not most < len(data) <= _MOST_JOINED:
            return [packet]
        what = f"ros2_sink: a PDU of {len(data)} bytes is cut into packets of packet_len = {most}"
        self._failures.note("joined", f"{what}; a TCP socket joins packets, a UDP socket does not")
        return [packet._replace(data=data[start : start + most]) for start in range(0, len(data), most)]

    def _take(self, packets: Iterable[AirPacket], radio: int) -> None:
        events: list[ReceiverEvent] = []
        with self._lock:
            for packet in packets:
                if self._bond is None:
                    events += self._end.receive(packet, self.clock())
                elif self._bond.arrive(radio, packet.data):
                    caused = self._end.receive(packet, self.clock())
                    self._bond.note(caused)
                    events += caused
            if self._bond is not None and (asks := self._bond.asks()):
                self._end.pace.credit(asks)
            if self._looks_at > -inf and (at := self._end.next_timeout()) is not None and at < self._looks_at:
                self.outputs.due.notify_all()
            if self._end.answers:
                self.live.look()
                self.live.wake()
            self._events += events
        self._settle()

    def _settle(self) -> None:
        """Handle all events, in the order in which the endpoint has told them, whichever thread it told."""
        with self._settling:
            while self._events:
                event = self._events.popleft()
                try:
                    self._handle_event(event)
                except Exception as error:  # noqa: BLE001 - an exception would lose the next events and the thread
                    self._failures.note("handler_failed", "ros2_sink", error, level=logging.ERROR)

    def _handle_event(self, event: ReceiverEvent) -> None:
        calls = self._calls
        if self.config.debug and isinstance(event, Received | Rejected):
            self._log.debug("rx %s", describe(event, self.registry))
        if isinstance(event, Received):
            self._heard[event.packet.src_id] = self.clock()
            self._packets[event.packet.src_id] += 1
        elif isinstance(event, Announced):
            topics = self.outputs.take(event)
            if calls is not None:
                calls.learn(event.src_id, topics)
        elif isinstance(event, Rejected):
            self._warn(event)
        taken = calls is not None and calls.takes(event)
        if isinstance(event, Delivered) and not taken:
            self.outputs.deliver(event)
        else:
            self._tell(event)

    def _tell(self, event: ReceiverEvent) -> None:
        if self._observer is not None:
            self._guard(self._observer.receiver_event, event, self.clock())

    def _warn(self, event: Rejected) -> None:
        """Log the first refusal of each reason."""
        if event.error.kind not in self._said:
            self._said.add(event.error.kind)
            self._log.warning("ros2_sink: a packet was refused (%s): %s", event.error.kind, event.error)

    def _watch_timeouts(self) -> None:
        outputs = self.outputs
        while True:
            opening = list(outputs.opening)
            outputs.release([o for o in opening if o.early is None or o.early.ended(self.clock())])
            with self._lock:
                if not self._running:
                    return
                events = self._end.handle_timeout(self.clock())
                if self._bond is not None:
                    self._bond.note(events)
                if self._end.answers:
                    self.live.wake()  # what was missed is reported
                if not events:
                    at = self._end.next_timeout()
                    if outputs.opening:
                        at = min(self.clock() + CHECK_S, inf if at is None else at)
                    self._looks_at = inf if at is None else at
                    outputs.due.wait(wait_until_s(at, self.clock(), _SHORTEST_WAIT_S))
                    self._looks_at = -inf
                self._events += events
            self._settle()
