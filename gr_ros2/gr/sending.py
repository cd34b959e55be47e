"""The half of a link's block that sends: ROS topics in, packets out on message port `pdus`.

With several radios, each has ports of its own, and a :class:`Bond` says over which of them a packet leaves.

Invariants: this block is a thin shell. All behaviour is in the link's engine, which one lock protects. One pump thread
composes each packet just before it leaves; where it drives the gate of its only radio, it also lets packets pass there.
A callback of the middleware blocks only with ``backpressure``. Every dropped message is counted by name.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from math import inf
from typing import Any, Protocol

from gr_ros2.core.errors import GrRos2Error
from gr_ros2.gr.half import HalfBlock
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.radio_ports import RadioPorts
from gr_ros2.gr.readable import describe
from gr_ros2.gr.subscriptions import Subscriptions, Takes, everything
from gr_ros2.link import Ended, Refused, SenderEvent, SentPacket
from gr_ros2.link.bond import Bond
from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.fates import Fate
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware import Middleware
from gr_ros2.phy.pdus import credited, take_messages
from gr_ros2.settings.config import replaced
from gr_ros2.settings.fields import Auto
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig

_COUNTED = ("unread", "held_back_at_close", "pump_failed", "tf_damaged", "tf_static_full")
_BATCH = 32
"""Number of packets composed before the lock is released, so that callbacks do not wait long. Where the sending thread
drives a gate, each is handed over at once: another one may leave only later."""


class Keeper(Protocol):
    """Keeps messages for later (:mod:`gr_ros2.gr.backfill`)."""

    def note(self, event: SenderEvent) -> None:
        """An event of the sending half, with the lock of the endpoint held; must be fast."""


class Ports(Protocol):
    """Where packets leave."""

    def find_readers(self) -> bool:
        """As :meth:`RadioPorts.find_readers`."""

    def send(self, packets: list[SentPacket], *, adaptive: bool) -> None:
        """As :meth:`RadioPorts.send`."""


class Gate(Protocol):
    """What sets the pace of packets, see :class:`gr_ros2.phy.airtime.AirtimeGate`."""

    looks_at: float
    looks: Callable[[], None] | None

    def step(self) -> None:
        """Do what is due."""


class Sharing(Protocol):
    """The endpoints that share the radios with the one of this block, see :mod:`gr_ros2.gr.bound`."""

    def start(self) -> None:
        """The block runs."""

    def stop(self) -> None:
        """It stops."""

    def granted(self, radio: int, packets: int, since: float | None) -> int:
        """A radio takes so many further packets; returns how many more this block may send."""


class SendingBlock(HalfBlock):
    """Subscribes to topics of a ROS graph and emits their messages as packets.

    Message ports: `pdus` out (PMT pair of metadata ``src_id, dst_id, seq, qos, t_src_wall`` and u8vector); `credit` in,
    optional; with several radios also `pdus_2`, `credit_2` and so on. From the first `credit` message on, packets wait
    for credits. A credit is a pair: an integer, so many packets may leave; and a real number, the time in s of this
    block's clock since when the air is free for them. Messages that wait all the same wait for the computer. Infinity
    says that the packets were held back until now, so that the time since the last one is not the pace of the PHY. An
    integer alone says nothing of the air, and any other message lets one packet leave.

    The block takes messages from its construction on. Packets leave while the flowgraph runs. ``close`` ends both.

    :param registry: the topics that it may send
    :param end, graph, clock, bond: see :class:`HalfBlock`
    :param observer: called with every SenderEvent, in order, while the block's lock is held. It must not call the
        block. An observer that raises is not called again
    :param backpressure: holds the middleware back instead of dropping when a queue is full (bags)
    :param ports: where packets leave; None: over its own message ports
    :param takes: which topics it sends, by their options
    """

    _subscribes: type[Subscriptions] = Subscriptions

    def __init__(
        self,
        config: RobotConfig,
        registry: Registry,
        end: LiveEnd[Endpoint],
        graph: Middleware,
        *,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        backpressure: bool = False,
        bond: Bond | None = None,
        ports: Ports | None = None,
        takes: Takes = everything,
    ) -> None:
        super().__init__(
            f"ros2_source {config.robot_id}", config, end, graph, observer=observer, clock=clock, bond=bond
        )
        self.src_id = config.robot_id
        """The source id on the wire."""
        end.observer = self._observe
        self._mcs = 0
        """MCS of the newest packet."""
        self._work = end.work
        self._unread = False
        self._counters: Counter[str] = Counter()
        self.composed = self.emitted = 0
        """Number of packets composed, and number of PDUs that have left."""
        self._said: set[tuple[int, str]] = set()
        self.keeper: Keeper | None = None
        """Keeps messages for later, where something does."""
        self.sharing: Sharing | None = None
        """What else sends over its radios."""
        self.gate: Gate | None = None
        """What sets the pace of its only radio, if its thread does that too."""
        self._pumping = 0
        """Number of that thread."""
        if ports is None:
            ports = RadioPorts(self, self.radios, bond, self._lock, lambda: self.subscriptions.registry)
        self.ports = ports
        """Where packets leave."""
        take_messages(self, "credit", "_credit", self.radios, called="grant")
        self._backpressure = backpressure
        self.subscriptions = self._subscribes(
            registry,
            config,
            graph,
            end,
            clock=clock,
            counters=self._counters,
            log=self._log,
            backpressure=backpressure,
            takes=takes,
        )
        """What it sends."""
        self._space = self.subscriptions.space
        try:
            self.subscriptions.open()
        except GrRos2Error:
            self.close()
            raise

    @property
    def idle(self) -> bool:
        """Whether no message is waiting or being sent."""
        with self._lock:
            return self._end.idle

    @property
    def matched(self) -> bool:
        """Whether every subscription has found a publisher."""
        return not self.unmatched()

    def unmatched(self) -> list[str]:
        """Names, on the ROS graph, of the topics without a publisher."""
        return self.subscriptions.unmatched()

    def stalled_s(self, now: float) -> float:
        """As :meth:`LiveEnd.stalled_s`; infinite if the sending thread has ended.

        :param now: s of this block's clock
        """
        if not self._running:
            return 0.0
        return self.live.stalled_s(now) if self._thread.alive else inf

    def due(self, now: float) -> bool:
        """Whether a packet has to be composed by now. For an end that knows when its packets leave."""
        with self._lock:
            at = self._end.next_departure()
            due = at is not None and at <= now
            if due:  # the clock of a medium has gone faster than the computer's, by which the sending thread sleeps
                self._work.notify()
            return due

    def rate(self) -> dict[str, str]:
        """With an adaptive rate, the name of the mcs of the newest packet as ``mcs``; otherwise nothing."""
        mcs_table = self._end.mcs_table
        return {"mcs": mcs_table[self._mcs].name} if mcs_table else {}

    def use_credit(self) -> None:
        """Let no packet leave before the first `credit` message."""
        with self._lock:
            self._end.pace.use_credit()

    def drive(self, gate: Gate) -> None:
        """Let what has passed this gate leave in the thread that composes packets. Call this before the flowgraph
        starts."""
        self.gate, gate.looks = gate, self._look

    def start(self) -> bool:
        self._unread = not self.ports.find_readers()
        if self._unread:
            self._log.error("ros2_source %d: nothing reads message port `pdus`; connect it", self.src_id)
        self.live.looked = self.clock()
        with self._lock:
            self._running = True
        self._thread.start(self._pump, f"gr-ros2-source-{self.src_id}")
        return True

    def stop(self) -> bool:
        with self._lock:
            self._running = False
            self.subscriptions.take_losses()
            self._work.notify_all()
        self._thread.stop()
        return True

    def close(self) -> None:
        """Take no further messages. A callback held back by ``backpressure`` returns without submitting. Idempotent."""
        self.subscriptions.close()

    def stats(self) -> dict[str, Any]:
        """A snapshot of the counters of packets and messages, per topic and in total."""
        with self._lock:
            stats, topics = self._end.sent, self.subscriptions.stats()
            return {
                "src_id": self.src_id,
                "packets": stats.packets,
                "entries": stats.entries,
                "payload_bytes": stats.payload_bytes,
                "repeats": stats.repeats,
                "air": dict(stats.air),
                **{name: self._counters[name] for name in _COUNTED},
                "observer_missed": self._guard.missed,
                "unmatched": self.unmatched(),
                "topics": topics,
                "middleware": dict(self.middleware.counters),
            }

    @property
    def live_settings(self) -> tuple[str, ...]:
        """Settings that may change while it runs, each by its setter."""
        return (*self._end.live_settings, "debug")

    def set_packet_rate(self, packet_rate: float | Auto) -> None:
        """Set the largest packet rate, packets/s. With auto, the credits set the pace; with 0 there is no limit.

        :raises ConfigError: out of range, as in all setters
        """
        self._reconfigure(packet_rate=packet_rate)

    def set_queue_depth(self, queue_depth: int) -> None:
        """Set how many messages may wait per topic; 0 is unlimited."""
        self._reconfigure(queue_depth=queue_depth)

    def set_repeat_s(self, repeat_s: float) -> None:
        """Set the time between repeats of a transient-local topic, s; 0 is off."""
        self._reconfigure(repeat_s=repeat_s)

    def _reconfigure(self, **changes: Any) -> None:
        with self._lock:
            config = replaced(self.config, **changes)
            self._end.reconfigure(**{name: getattr(config, name) for name in changes})  # as validated
            self.config = config
            self.live.rouse()
            self._space.notify_all()

    def _credit(self, message: Any, radio: int = 0) -> None:
        self.grant(*credited(message), radio)

    def grant(self, packets: int, since: float | None, radio: int = 0) -> None:
        """So many more packets may leave; see :func:`gr_ros2.phy.pdus.credit_of`."""
        packets = max(0, packets)
        if self._backpressure and since != inf:
            since = None  # whoever waits for room in a queue wants nothing dropped
        if self.sharing is not None:
            packets = self.sharing.granted(radio, packets, since)
        with self._lock:
            if self._bond is not None:
                packets = self._bond.ask(radio, packets)
            self._end.pace.credit(packets, since)
            self.live.wake(credited=True)

    def _look(self) -> None:
        """Wake the sending thread, where it is not that which has changed something at the gate."""
        if threading.get_ident() != self._pumping:
            with self._lock:
                self._work.notify()

    def wants(self, radio: int) -> bool:
        """Whether there is something to send over a radio."""
        with self._lock:
            at = self._end.next_departure(credited=True)
            waiting = at is not None and at <= self.clock()
            return waiting if self._bond is None else self._bond.wants(radio, waiting=waiting)

    def unused(self, radio: int) -> int:
        """How many credits of a radio nobody has used."""
        with self._lock:
            return (self._end.pace.credits or 0) if self._bond is None else self._bond.unused(radio)

    def used(self, radio: int, left: int) -> None:
        """Another endpoint has used a credit of a radio.

        :param left: how many there are now
        """
        with self._lock:
            if self._bond is None:
                self._end.pace.left_with(left)
            else:
                self._bond.spend(radio)

    def _pump(self) -> None:
        gate, self._pumping = self.gate, threading.get_ident()
        while self._running:
            self.live.looked = now = self.clock()
            try:
                if gate is not None and gate.looks_at <= now:
                    gate.step()
                if packets := self._compose():
                    self._emit(packets)
            except Exception as error:  # noqa: BLE001 - an exception would end all transmission
                with self._lock:
                    self._counters["pump_failed"] += 1
                    first = self._counters["pump_failed"] == 1
                if first:
                    self._log.exception("ros2_source %d: %s", self.src_id, error)

    def _compose(self) -> list[SentPacket]:
        """The packets that may leave now. If there are none, wait for a reason to look again and return none."""
        with self._lock:
            packets: list[SentPacket] = []
            most = _BATCH if self.gate is None else 1
            if self.live.due(self.clock()):
                while len(packets) < most and (sent := self._end.next_packet(self.clock())) is not None:
                    packets.append(sent)
                if not packets:
                    self.live.nothing()
            if packets:
                self.live.changed = True
                self.live.look()
                self.composed += len(packets)
                self._mcs = packets[-1].mcs
                self._space.notify_all()
            elif self._running:
                self.live.sleep(self.clock, inf if self.gate is None else self.gate.looks_at)
        return packets

    def _emit(self, packets: list[SentPacket]) -> None:
        if self.config.debug:
            for sent in packets:
                self._log.debug("tx %s", describe(sent, self.subscriptions.registry))
        self.ports.send(packets, adaptive=bool(self._end.mcs_table))
        self.emitted += len(packets)
        if self._unread:
            with self._lock:
                self._counters["unread"] += len(packets)

    def _observe(self, event: SenderEvent) -> None:
        if isinstance(event, Refused):
            level = logging.INFO if event.reason == Fate.SUPERSEDED else logging.WARNING  # as `latest` intends
            self._say(level, event.topic_id, event.reason, f"a message was dropped ({event.reason}): {event.detail}")
        elif isinstance(event, Ended) and not event.arrived:
            what = f"robot {event.dst_id} did not tell whether a message came, which is kept no longer (unconfirmed)"
            self._say(logging.WARNING, event.topic_id, "unconfirmed", what)
        if self.keeper is not None:
            self.keeper.note(event)
        if self._observer is not None:
            self._guard(self._observer.sender_event, self.src_id, event)

    def _say(self, level: int, topic_id: int, why: str, what: str) -> None:
        """Log what has become of a message of a topic, once for each reason."""
        if (topic_id, why) not in self._said:
            self._said.add((topic_id, why))
            registry = self.subscriptions.registry
            name = registry[topic_id].name if topic_id < len(registry) else "of calls"
            self._log.log(level, "topic %s: %s", name, what)
