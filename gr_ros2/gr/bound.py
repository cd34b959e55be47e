"""Topics that are bound to one of a robot's radios: an endpoint of their own for each such radio.

Packets that may leave over any radio have one set of numbers. One that was on a slow radio for a second would come long
after those that a fast one has carried since: reliable messages would wait for it, and it would be repaired before it
came. So what goes over one radio alone has numbers, seals, reports and repairs of its own, as a second link would.

*On the air.* Each packet of such an endpoint stands behind the byte ``BOUND``, with which no other packet begins, and
is sealed with keys of its own. A radio on whose channel other robots send too (slots, ALOHA) carries nothing else of
this robot, and its packets are those of robots that have it as their only radio.

*Who has one.* A radio that some topic of this robot names, or that shares its channel, from the start on; another one
from the first such packet on that comes over it, so that a robot takes what others have bound. That one sends nothing
before it has heard a robot.

*Observers* are told what comes out. So that topic ids of several endpoints are not mixed up, those of a radio's own are
greater by ``APART`` times the number of the radio, counted from 1.

*Services* that are bound are announced and called there, and what fills gaps (:mod:`gr_ros2.gr.backfill`) crosses
there. What is offered and bound is asked for over all radios, and sent over its own; over a radio that shares its
channel, it is asked for there, and what it carries is measured there (:mod:`gr_ros2.gr.throughput`).

*Airtime.* The credits of the radio are for both endpoints, see :mod:`gr_ros2.link.shared_credits`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from gr_ros2.core.errors import GrRos2Error
from gr_ros2.gr.backfill import LiveBackfill
from gr_ros2.gr.calls import LiveCalls, has_room_for_calls
from gr_ros2.gr.factory import make_endpoint, start_of
from gr_ros2.gr.link_parts import LinkParts
from gr_ros2.gr.link_sending import LinkSendingBlock
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.radio_ports import RadioPorts
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.starts import bound_state_file
from gr_ros2.gr.throughput import LiveThroughput
from gr_ros2.gr.wishes import LiveWishes
from gr_ros2.link import AirPacket, SentPacket
from gr_ros2.link.air import Air
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.endpoint import OpenEndpoint
from gr_ros2.link.events import (
    APART,
    Announced,
    BoundPacket,
    Delivered,
    Lost,
    Received,
    ReceiverEvent,
    Rejected,
    SenderEvent,
)
from gr_ros2.link.observe import LinkObserver
from gr_ros2.link.shared_credits import ALL, ALONE, SharedCredits
from gr_ros2.middleware import Middleware
from gr_ros2.settings.config import BOUND_TO_NONE, SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.wire import BOUND

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class OwnWay:
    """A radio over which topics may go alone.

    :param name: by which they name it
    :param packet_len: bytes of its longest packet, with the byte before it
    :param sends: whether it may send
    :param air: what an endpoint has to know of it
    :param shares: whether other robots send on its channel, so that it carries nothing else of this robot
    """

    name: str
    packet_len: int
    sends: bool
    air: Air
    shares: bool = False

    @property
    def mark(self) -> bytes:
        """What stands before each packet."""
        return b"" if self.shares else BOUND


def bound_to_none(options: SendOptions) -> bool:
    """Whether a topic goes over whichever radio is best."""
    return options.via in BOUND_TO_NONE


class _Told:
    """Tells an observer what comes out over one radio alone, and the packets.

    :param apart: by how much topic ids are greater there
    :param mark: what stands before each packet
    """

    def __init__(self, observer: LinkObserver, apart: int, mark: bytes) -> None:
        self._observer, self._apart, self._mark = observer, apart, mark

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        """Packets that leave; topic ids of what is sent are not known there."""
        if isinstance(event, SentPacket):
            self._observer.sender_event(src_id, BoundPacket(self._mark + event.data, event.now))

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Packets; messages that come out, or do not, and what they are."""
        apart = self._apart
        if isinstance(event, Received | Rejected):
            self._observer.receiver_event(BoundPacket(self._mark + event.data, now), now)
        elif isinstance(event, Delivered | Lost):
            self._observer.receiver_event(event._replace(topic_id=event.topic_id + apart), now)
        elif isinstance(event, Announced):
            topics = tuple(row._replace(topic_id=row.topic_id + apart) for row in event.topics)
            self._observer.receiver_event(event._replace(topics=topics), now)


class BoundEnd(LinkParts):
    """The endpoint of what goes over one radio alone.

    :param config: of the robot
    :param radio: number of the radio
    :param known: the topics that the robots know beforehand
    :param graph: the robot's participant on its ROS graph, which the caller closes
    :param main: what sends over all radios
    :param ports: of that block
    :param observer: is told what comes out
    :param clock: s, monotonic
    :raises GrRos2Error: when it cannot be made
    :ivar named: whether a topic of this robot is bound to the radio
    :ivar sends: whether it sends now
    """

    source: LinkSendingBlock

    def __init__(
        self,
        config: RobotConfig,
        way: OwnWay,
        radio: int,
        *,
        known: Registry,
        graph: Middleware,
        main: LinkSendingBlock,
        ports: RadioPorts,
        observer: LinkObserver | None,
        clock: Callable[[], float],
    ) -> None:
        self.way, self._radio, self._main, self._ports, self._clock = way, radio, main, ports, clock
        self.named = way.name in names_of(config)
        own = replace(
            config,
            topics=config.topics if self.named else {},
            offer={word: how for word, how in config.offer.items() if way.shares and how.via == way.name},
            packet_len=way.packet_len - len(way.mark),
            state=str(bound_state_file(config.state, config.robot_id, radio)),
        )
        topics = known if own.sends else Registry.empty()
        calls = way.air.hears and has_room_for_calls(topics)
        self._lock = threading.Lock()
        """Guards the credits, and whether it sends. While it is held, that of an endpoint may be taken, not the other
        way round."""
        self._paced = way.air.airtime_s > 0
        self._credits = SharedCredits(main.unused(radio))
        self._running = self.sends = False
        counted = start_of(own)
        if counted.keys is not None and not way.shares:
            counted = replace(counted, keys=counted.keys.bound())
        self._start = counted
        try:
            self.end: LiveEnd[OpenEndpoint] = LiveEnd(
                lambda events: make_endpoint(own, topics, air=way.air, start=self._start, observer=events, calls=calls)
            )
            told = None if observer is None else _Told(observer, self.apart, way.mark)
            self.source = LinkSendingBlock(
                own,
                topics,
                self.end,
                graph,
                observer=told,
                clock=clock,
                ports=self,
                takes=lambda options: options.via == way.name,
            )
            published = known.with_options(config.publish.topics, announced=True)
            self.sink = ReceivingBlock(own, published, self.end, graph, observer=told, clock=clock)
            self.sink.outputs.other_clocks = self._clock_of
            if calls:
                self.calls = LiveCalls(self.end, self.source, self.sink, self.source.found)
                if way.shares:
                    self.wishes = LiveWishes(own, self.calls, self.source, graph, clock=clock)
                    self.throughput = LiveThroughput(
                        own,
                        self.end,
                        self.calls,
                        self.sink,
                        share=way.air.airtime_share,
                        sends=way.air.hears,
                        clock=clock,
                    )
                if self.named and config.backfill.topics:
                    self.backfill = LiveBackfill(config, self.end, self.source, share=way.air.airtime_share)
        except GrRos2Error:
            self.close()
            raise
        if self._paced:
            self.source.use_credit()
            self.source.grant(self._credits.of(ALONE), None)

    @property
    def apart(self) -> int:
        """By how much its topic ids are greater for observers."""
        return APART * (self._radio + 1)

    def announced(self) -> list[tuple[int, str, Topic]]:
        """What others announce over this radio alone, as observers see it."""
        rows = self.sink.outputs.heard.announced()
        return [(src_id, name, replace(topic, topic_id=topic.topic_id + self.apart)) for src_id, name, topic in rows]

    def start(self) -> None:
        """Take packets, and send them where something is to be sent."""
        self._running = True
        self.sink.start()
        self._begin()

    def stop(self) -> None:
        """Do neither. It may start again."""
        with self._lock:
            sends, self.sends, self._running = self.sends, False, False
        if sends:
            self.source.stop()
        self.sink.stop()

    def close(self) -> None:
        super().close()
        self._start.close()

    def take(self, packets: Sequence[AirPacket]) -> None:
        """Packets have come."""
        self.sink.take(packets)
        if not self.sends:
            self._begin()

    def granted(self, packets: int, since: float | None) -> int:
        """The radio takes so many further packets; returns how many of them the endpoint with all radios may send."""
        if self.way.shares:
            self.source.grant(packets, since)
            return 0
        wanted_by = {ALL} if self._main.wants(self._radio) else set()
        if self.sends and self.source.wants(self._radio):
            wanted_by.add(ALONE)
        with self._lock:
            more = self._credits.grant(packets, wanted_by=wanted_by)
            self.source.grant(more[ALONE], since)
        return more[ALL]

    def others_left(self, packets: Sequence[SentPacket]) -> None:
        """The endpoint with all radios has sent packets over this one."""
        with self.end.lock:
            self.end.endpoint.used_air.others_left(packets, self._clock())
        if not self._paced:
            return
        with self._lock:
            for _ in packets:
                self._credits.left(ALL)
            self._follow()

    def find_readers(self) -> bool:
        """Its packets leave by ports whose readers are found already."""
        return True

    def send(self, packets: list[SentPacket], *, adaptive: bool) -> None:
        """Packets of this endpoint leave."""
        self._ports.send_bound(self._radio, packets, self.way.mark, adaptive=adaptive)
        if not self._paced or self.way.shares:
            return
        with self._lock:
            for _ in packets:
                if self._credits.left(ALONE):
                    self._main.used(self._radio, self._credits.of(ALL))
            self._follow()

    def opened_again(self) -> None:
        """The device was opened again, and gives all credits anew."""
        if self._paced:
            with self._lock:
                self._credits.forget()
                self._follow()  # a radio that shares its channel has not been told of any

    def stats(self) -> dict[str, Any]:
        """A snapshot of all parts."""
        now = self._clock()
        with self.end.lock:
            heard = [peer.robot for peer in self.end.endpoint.peers(now) if not peer.silent]
        return {**super().stats(), "heard": heard, "rate": self.source.rate()}

    def _clock_of(self, robot: int) -> ClockOffset | None:
        """What the endpoint with all radios knows of a robot's clock."""
        live = self._main.live
        with live.lock:
            return live.endpoint.clock_of(robot, self._clock())

    def _begin(self) -> None:
        with self._lock:
            if self.sends or not self.way.sends or not self._running:
                return
            with self.end.lock:
                heard = self.end.endpoint.received.packets > 0  # none counts that was not opened
            if self.named or self.way.shares or heard:
                self.sends = True
                self.source.start()

    def _follow(self) -> None:
        """Tell the endpoint how many credits it has."""
        self.source.used(self._radio, self._credits.of(ALONE))


class BoundEnds:
    """The endpoints of one robot that have one radio alone, by the number of that radio.

    :param config: of the robot
    :param ways: its radios, by their numbers
    :param arguments: see :class:`BoundEnd`
    :raises GrRos2Error: when one cannot be made that a topic needs
    """

    def __init__(self, config: RobotConfig, ways: Mapping[int, OwnWay], **arguments: Any) -> None:
        self._config, self._ways, self._arguments = config, ways, arguments
        self._lock = threading.Lock()
        """Held while one is made, started or stopped."""
        self._running = False
        self._failed: set[int] = set()
        self._introduce: Callable[[int, BoundEnd], None] = lambda _radio, _end: None
        self._ends: dict[int, BoundEnd] = {}
        named = names_of(config)
        try:
            for radio, way in ways.items():
                if way.name in named or way.shares:
                    self._ends[radio] = self._make(radio)
        except GrRos2Error:
            self.close()
            raise

    def __iter__(self) -> Iterator[BoundEnd]:
        return iter(self._ends.values())

    def start(self) -> None:
        """Packets may leave and come."""
        with self._lock:
            self._running = True
            for end in self._ends.values():
                end.start()

    def stop(self) -> None:
        """None may."""
        with self._lock:
            self._running = False
            for end in self._ends.values():
                end.stop()

    def close(self) -> None:
        """Leave the ROS graph. Idempotent."""
        for end in self._ends.values():
            end.close()

    def introduce_with(self, introduce: Callable[[int, BoundEnd], None]) -> None:
        """Introduce each, with the number of its radio, also those that are made later."""
        with self._lock:
            self._introduce = introduce
            for radio, end in self._ends.items():
                introduce(radio, end)

    def take(self, radio: int, packets: Sequence[AirPacket]) -> list[AirPacket]:
        """Take what is for one of these of the packets that have come over a radio; returns the others."""
        if radio in self._ways and self._ways[radio].shares:
            if (end := self._of(radio)) is not None:
                end.take(packets)
            return []
        mine = [packet for packet in packets if packet.data.startswith(BOUND)]
        end = self._of(radio) if mine else None
        if end is None:
            return list(packets)
        end.take([packet._replace(data=packet.data.removeprefix(BOUND)) for packet in mine])
        return [packet for packet in packets if not packet.data.startswith(BOUND)]

    def granted(self, radio: int, packets: int, since: float | None) -> int:
        """A radio takes so many further packets; returns how many the endpoint with all radios may send."""
        end = self._ends.get(radio)
        return packets if end is None else end.granted(packets, since)

    def left(self, radio: int, packets: Sequence[SentPacket]) -> None:
        """The endpoint with all radios has sent packets over one."""
        end = self._ends.get(radio)
        if end is not None and packets:
            end.others_left(packets)

    def opened_again(self, radio: int) -> None:
        """The device of a radio was opened again."""
        if radio in self._ends:
            self._ends[radio].opened_again()

    @property
    def sources(self) -> list[LinkSendingBlock]:
        """What sends topics of this robot."""
        return [end.source for end in self._ends.values() if end.named]

    def source_of(self, via: str) -> LinkSendingBlock | None:
        """What sends over a radio alone, by its name."""
        return next((end.source for end in self._ends.values() if end.way.name == via), None)

    @property
    def calls(self) -> list[LiveCalls]:
        """The services of each."""
        return [end.calls for end in self._ends.values() if end.calls is not None]

    def set_topics(self, topics: Any) -> None:
        """Use other options of single topics from now on."""
        for source in self.sources:
            source.set_topics(topics)

    def end_of(self, topic_id: int) -> BoundEnd | None:
        """The endpoint of a topic, by its id as observers see it; None for what has no radio alone."""
        return self._ends.get(topic_id // APART - 1)

    def stats(self) -> dict[int, dict[str, Any]]:
        """What each counts, by the number of its radio."""
        return {radio: end.stats() for radio, end in self._ends.items()}

    def _of(self, radio: int) -> BoundEnd | None:
        """The endpoint of a radio, which is made if it is not there yet; None where it cannot be."""
        end = self._ends.get(radio)
        if end is not None or radio not in self._ways or radio in self._failed:
            return end
        with self._lock:
            if radio not in self._ends and self._running:
                try:
                    end = self._make(radio)
                except GrRos2Error as error:
                    self._failed.add(radio)
                    _log.warning("topics that others have bound to one radio do not come out: %s", error)
                    return None
                self._introduce(radio, end)
                end.start()
                self._ends = {**self._ends, radio: end}
            return self._ends.get(radio)

    def _make(self, radio: int) -> BoundEnd:
        return BoundEnd(self._config, self._ways[radio], radio, **self._arguments)


def names_of(config: RobotConfig) -> set[str]:
    """The radios that topics of a robot name, and what it offers."""
    return {options.via for options in (*config.options.values(), *config.offer.values())} - BOUND_TO_NONE
