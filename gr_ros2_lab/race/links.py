"""The radio between two network namespaces. It carries ROS topics or IP packets through the same flowgraph.

Invariants: every frame occupies the air for the airtime of its length, one frame after another, for every sender. A
frame is logged when it leaves. No frame waits here, so a sender notices when the link is full. Each direction has its
own air.
"""

from __future__ import annotations

import threading
import time
from array import array
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from tempfile import TemporaryDirectory
from typing import Any

from gnuradio import gr

from gr_ros2.core.closing import Closing
from gr_ros2.gr import RosLink
from gr_ros2.gr.factory import Start
from gr_ros2.link import ReceiverEvent, SenderEvent
from gr_ros2.link.events import SentPacket
from gr_ros2.middleware import Middleware, Qos, join_graph
from gr_ros2.paper.settings import PaperConfig
from gr_ros2.phy import PHY, Phy
from gr_ros2.phy.channel import PacketLoss
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.pdus import PDUS, packets_of, pdu_of
from gr_ros2.phy.threads import KeepsThreadState, shorten_switch_interval
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.config import (
    DEFAULT_MIDDLEWARE,
    ChannelConfig,
    DiagnosticsConfig,
    PhyConfig,
    QueuePolicy,
    SendOptions,
)
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import NewTopic, Registry
from gr_ros2.settings.robot import Direction, GraphConfig, PublishConfig
from gr_ros2_lab.race.contenders import ADDRESSES, MTU, Contender
from gr_ros2_lab.race.namespaces import inside
from gr_ros2_lab.race.race_settings import PHY_NAME
from gr_ros2_lab.race.tun import QUEUE_BYTES, Tun, loopback_up, own_air
from gr_ros2_lab.run.paper_link import PaperLink

DOMAINS = (1, 2)
"""DDS domains at both ends of gr-ros2, the sending end first. One process cannot use one domain in two namespaces."""
SOURCE_ID = 1
DEPTH = 1000
"""Messages that the local graphs keep. The number is large, because no message may be lost there."""

_NEVER = ((9e8, 1e9),)
"""An outage in years: a channel that may lose packets, so that :meth:`_Air.set_loss` can act."""
_POLL_S = 0.05
_JOIN_S = 1.0
_SHORT_FRAME = 100


@dataclass(frozen=True)
class RaceRadio:
    """The radio of all contenders: their PHY at a sample rate, and the share of its frames that are lost.

    :param seed: seed of the losses; each direction has its own losses
    """

    sample_rate: float
    packet_loss: float
    seed: int

    def with_frames_of(self, length: int) -> Phy:
        """The PHY for frames of at most ``length`` bytes."""
        phy: Phy = PHY.load(PHY_NAME)(length, self.sample_rate)
        return phy

    @cached_property
    def _phy(self) -> Phy:
        return self.with_frames_of(MTU)

    def airtime_s(self, length: int) -> float:
        """Airtime of a frame of ``length`` bytes, s."""
        return self._phy.airtime(length)

    def channel(self, direction: int) -> ChannelConfig:
        """The channel of one direction, 0 or 1."""
        return ChannelConfig(packet_loss=self.packet_loss, seed=2 * self.seed + direction, outages=_NEVER)


@dataclass
class LinkLog:
    """The frames of one direction: the time at which each left (s, monotonic), its size in bytes, its airtime in s."""

    t: array[float] = field(default_factory=lambda: array("d"))
    size: array[float] = field(default_factory=lambda: array("d"))
    airtime: array[float] = field(default_factory=lambda: array("d"))

    def note(self, t: float, size: int, airtime: float) -> None:
        """Add one frame."""
        self.t.append(t)
        self.size.append(size)
        self.airtime.append(airtime)


@dataclass(frozen=True)
class LinkReport:
    """The traffic on the air: the frames in both directions, and the number of losses by reason."""

    forward: LinkLog
    reverse: LinkLog
    drops: dict[str, int]


class RaceRosLink(Closing):
    """gr-ros2 between two namespaces: a ROS graph and a robot's end of the link at each end, the radio between them.

    Version 1 uses both directions: messages there, reports back. Version 0 sends nothing back.

    :param namespaces: paths of the namespaces of the sending and the receiving end
    :param topics: name, type, and QoS where it is not that of the contender
    :param packet_len: bytes of the longest packet
    :param contender: the contender whose settings are used

    Nothing is sent before :meth:`enter`.

    :raises GrRos2Error: when a part does not start
    """

    def __init__(
        self,
        radio: RaceRadio,
        namespaces: tuple[str, str],
        topics: Sequence[tuple[str, str, Qos | None]],
        packet_len: int,
        contender: Contender,
    ) -> None:
        settings, self._logs = dict(contender.settings), (LinkLog(), LinkLog())
        registry = _registry(topics, settings.pop("queue", AUTO))
        paper = settings.pop("paper", None)
        self._phy, self._namespaces = radio.with_frames_of(packet_len), namespaces
        self._block = partial(RosLink, start=Start(), registry=registry)
        ways: tuple[Direction, Direction] = ("both", "both")
        if paper is not None:
            ways = ("send", "receive")
            self._block = partial(PaperLink, paper=PaperConfig(**paper), registry=registry, seed=radio.seed)
        publish = PublishConfig(depth=DEPTH)
        self.outputs = [topic.republished(publish.as_, SOURCE_ID) for topic in registry]
        """The topics on which the receiving end publishes the messages."""
        self._links: dict[int, RobotLink] = {}
        with ExitStack() as stack:
            places = [f"ipc://{stack.enter_context(TemporaryDirectory(prefix='gr-ros2-'))}/air" for _ in DOMAINS]
            self._configs = [
                LinkConfig(
                    robot=SOURCE_ID + end,
                    direction=ways[end],
                    packet_len=packet_len,
                    graph=GraphConfig(namespace="", depth=DEPTH),
                    publish=publish,
                    phy=PhyConfig(name=PHY_NAME, sample_rate=radio.sample_rate),
                    front_end={"name": "zmq", "bind": places[end], "connect": [places[1 - end]]},
                    channel=radio.channel(1 - end),
                    diagnostics=DiagnosticsConfig(period_s=0),
                    **settings,
                )
                for end in range(len(DOMAINS))
            ]
            for namespace in namespaces:
                loopback_up(namespace)
            self._stack = stack.pop_all()

    def enter(self, end: int) -> None:
        """Make and start the link of an end, 0 or 1."""
        graph = self._stack.enter_context(inside(self._namespaces[end], lambda: _graph(DOMAINS[end])))
        observer = _FrameLog(self._phy, self._logs[end])
        link = RobotLink(self._configs[end], middleware=graph, observer=observer, block=self._block)
        self._stack.callback(link.stop)
        self._links[end] = link
        if end:
            link.sink.outputs.announce(SOURCE_ID, [0])
        link.start()

    def set_loss(self, probability: float) -> None:
        """Lose this share of all packets from now on, both ways."""
        for link in self._links.values():
            link.radio.set_packet_loss(probability)

    def matched(self) -> bool:
        """Whether both blocks have found the programs at their ends: each side of a match is told of it by itself."""
        return len(self._links) == len(DOMAINS) and self._links[0].source.matched and self._links[1].sink.matched

    def report(self) -> LinkReport:
        """The traffic on the air so far."""
        topics = self._links[0].source.stats()["topics"].values()
        drops = {reason: count for topic in topics for reason, count in topic["refused"].items()}
        on_air = sum(link.radio.counts().dropped for link in self._links.values())
        return LinkReport(*self._logs, {**drops, "on_air": on_air})

    def close(self) -> None:
        """Stop the radio and leave both graphs."""
        self._stack.close()


class _FrameLog:
    """Logs the packets that one end sends."""

    def __init__(self, phy: Phy, log: LinkLog) -> None:
        self._phy, self._log = phy, log

    def sender_event(self, src_id: int, event: SenderEvent) -> None:  # noqa: ARG002 - a LinkObserver's signature
        if isinstance(event, SentPacket):
            self._log.note(event.now, len(event.data), self._phy.airtime(len(event.data)))

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Do nothing: what arrives was logged when it was sent."""


class RaceIpLink(Closing):
    """IP between two namespaces, in both directions: a TUN device at each end, one frame of the same length per packet.

    :param namespaces: paths of the namespaces of the sending and the receiving end
    :param queue_bytes: most bytes that wait before each interface
    :raises GrRos2Error: when a part does not start
    """

    def __init__(self, radio: RaceRadio, namespaces: tuple[str, str], queue_bytes: int = QUEUE_BYTES) -> None:
        byte_airtime = (radio.airtime_s(MTU) - radio.airtime_s(_SHORT_FRAME)) / (MTU - _SHORT_FRAME)
        overhead = radio.airtime_s(_SHORT_FRAME) / byte_airtime - _SHORT_FRAME
        self._logs = (LinkLog(), LinkLog())
        with ExitStack() as stack:
            self._tuns: list[Tun] = []
            for namespace, own, other in zip(namespaces, ADDRESSES, reversed(ADDRESSES), strict=True):
                setup = own_air(
                    own, other, mtu=MTU, byte_rate=1 / byte_airtime, overhead=overhead, queue_bytes=queue_bytes
                )
                tun = Tun(namespace, setup)
                stack.callback(tun.close)
                self._tuns.append(tun)
            self._losses, self._sinks = list[PacketLoss](), list[TunSink]()
            for direction, log in enumerate(self._logs):
                phy = radio.with_frames_of(MTU)
                transmitter, receiver = phy.transmitter(), phy.receiver()
                source = TunSource(self._tuns[direction], radio, log)  # delays each frame by its airtime
                loss, sink = PacketLoss(radio.channel(direction)), TunSink(self._tuns[1 - direction])
                graph = Flowgraph("gr_ros2_race_ip", f"phy {phy.name}")
                graph.connect(transmitter, receiver)
                for block, after in ((source, transmitter), (receiver, loss), (loss, sink)):
                    graph.msg_connect(block, PDUS, after, PDUS)
                for release in (transmitter.release, receiver.release, graph.stop):  # the last of them first
                    stack.callback(release)
                graph.start()
                phy.prefer_latency()
                self._losses.append(loss)
                self._sinks.append(sink)
            self._stack = stack.pop_all()

    def enter(self, end: int) -> None:
        """Do nothing: IP is there from the beginning."""

    def set_loss(self, probability: float) -> None:
        """Lose this share of all frames from now on, both ways."""
        for loss in self._losses:
            loss.set_packet_loss(probability)

    def matched(self) -> bool:
        """True: IP has no ends that must find each other."""
        return True

    def report(self) -> LinkReport:
        """The traffic on the air so far."""
        drops = {
            "queue_full": sum(tun.dropped() for tun in self._tuns),
            "on_air": sum(loss.dropped.total() for loss in self._losses),
            "not_taken": sum(sink.refused for sink in self._sinks),
        }
        return LinkReport(*self._logs, drops)

    def close(self) -> None:
        """Stop the radio and remove the interfaces."""
        self._stack.close()


class TunSource(gr.basic_block):  # type: ignore[misc]
    """Sends the IP packets of a TUN device to message port `pdus`, each at the end of its airtime.

    :param log: takes the frames that have left
    """

    def __init__(self, tun: Tun, radio: RaceRadio, log: LinkLog) -> None:
        super().__init__("gr_ros2_tun_source", None, None)
        self._tun, self._log = tun, log
        self._airtimes = [radio.airtime_s(length) for length in range(MTU + 1)]
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.message_port_register_out(PDUS)

    def start(self) -> bool:
        shorten_switch_interval()
        self._thread = threading.Thread(target=self._run, name="gr-ros2-tun", daemon=True)
        self._thread.start()
        return True

    def stop(self) -> bool:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        return True

    def _run(self) -> None:
        free = time.monotonic()
        while not self._stop.is_set():
            packet = self._tun.read(0)  # a packet that is already here has waited until the air is free
            if packet is None:
                packet = self._tun.read(_POLL_S)
                free = max(free, time.monotonic())
                if packet is None:
                    continue
            airtime = self._airtimes[len(packet)]
            free += airtime
            if self._stop.wait(max(0.0, free - time.monotonic())):
                return
            self._log.note(free, len(packet), airtime)
            self.message_port_pub(PDUS, pdu_of(packet))


class TunSink(KeepsThreadState, gr.basic_block):  # type: ignore[misc]
    """Writes the PDUs of message port `pdus` to a TUN device."""

    def __init__(self, tun: Tun) -> None:
        super().__init__("gr_ros2_tun_sink", None, None)
        self._tun = tun
        self.refused = 0
        """PDUs that were not an IP packet, or that the kernel refused."""
        self.message_port_register_in(PDUS)
        self.set_msg_handler(PDUS, self._write)

    def _write(self, pdu: Any) -> None:
        packets, reason = packets_of(pdu)
        try:
            if reason:
                self.refused += 1
            for packet in packets:
                self._tun.write(packet.data)
        except OSError:
            self.refused += 1


def _registry(topics: Sequence[tuple[str, str, Qos | None]], queue: QueuePolicy | Auto) -> Registry:
    """The topics with the options that a robot would have found on its graph; the first one waits in this queue."""
    rows: list[NewTopic] = []
    for name, type_name, qos in topics:
        options = SendOptions(queue=queue if not rows else AUTO)
        if qos is not None:
            options = replace(options, reliability=qos.reliability or AUTO, durability=qos.durability or AUTO)
        rows.append((name, type_name, options))
    return Registry.empty().extended(rows)


def _graph(domain_id: int) -> Middleware:
    return join_graph(DEFAULT_MIDDLEWARE, domain_id=domain_id, node_name="gr_ros2_race", localhost_only=True)
