"""One robot's end of a link that speaks version 1.

``Outbox`` is its message side. ``SendingSide`` chooses what leaves next, ``PacketWriter`` writes it, and
``ReceivingSide`` takes what arrives. Here they are joined.

Invariants: every submitted message is accepted once; it then leaves whole or is refused with a named reason;
``receive`` never raises, whatever the bytes; packets leave only when the pace (rate or credit) allows; each number is
sent once, and each repair id once per number; there is no clock, randomness or IO here: the caller passes in the time,
the boot number and the stored state.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import inf
from typing import Any

from gr_ros2.link.access import Access
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.endpoint import LIVE_OPTIONS, HeardRobot, check_live
from gr_ros2.link.events import AirPacket, Delivered, Lost, ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.link.instances import InstancesOf, no_instances
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.pace import Pace
from gr_ros2.link.rate import Mcs, RateController
from gr_ros2.link.v1.custody import Custody
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.facts import Early
from gr_ros2.link.v1.frames import SentFrames
from gr_ros2.link.v1.hellos import Hellos
from gr_ros2.link.v1.hold import Hold
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.outbox import Outbox
from gr_ros2.link.v1.receipts import Receipts
from gr_ros2.link.v1.receiving import ReceivingSide
from gr_ros2.link.v1.repair import RepairWindow
from gr_ros2.link.v1.replays import Save
from gr_ros2.link.v1.sealing import Keys
from gr_ros2.link.v1.sending import SendingSide
from gr_ros2.link.v1.used_air import UsedAir
from gr_ros2.link.v1.writer import PacketWriter, SendSlot, room_of
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import TAG_LEN

_EARLY_S = 1e-6
"""s before its time at which a packet may begin: times are not exact to the last bit."""


class EndpointV1:
    """Both directions of one robot.

    :param topics: topics that it sends; None if it only receives
    :param boot: number of this start; it is greater than all earlier ones
    :param keys: keys that seal its packets
    :param codec: codes the messages sent
    :param decoder_for: makes the decoder for a robot's messages from its table of topics
    :param heard: what ``save`` stored before this start
    :param save: stores up to which packet a robot was heard; needed if ``keys`` must keep replays out after a restart
    :param observer: called with every SenderEvent, in order
    :param mcs_table: the rates of an adaptive rate, see :mod:`gr_ros2.link.rate`; () for a fixed rate
    :param instances: tells the instances of a topic that it sends
    :ivar answers: whether what it receives can change what it sends
    :ivar pace: when packets may leave
    :ivar window: the packets that are worth repairing
    :ivar frames: its coded topics
    :ivar used_air: how much of the air it uses
    :ivar neighbours: the robots that are heard
    :ivar pings: its questions to other robots, and its answers
    """

    live_settings = ("packet_rate", "repeat_s", "queue_depth")
    live_options = LIVE_OPTIONS

    def __init__(
        self,
        topics: Registry | None,
        settings: Settings,
        *,
        boot: int,
        keys: Keys | None = None,
        codec: MessageCodec | None = None,
        decoder_for: Callable[[tuple[AnnouncedTopic, ...]], MessageCodec] | None = None,
        heard: Mapping[int, tuple[int, int]] | None = None,
        save: Save | None = None,
        observer: Callable[[SenderEvent], None] | None = None,
        mcs_table: Sequence[Mcs] = (),
        instances: InstancesOf = no_instances,
    ) -> None:
        self._access = access = settings.access
        self.settings = settings
        self.boot = boot
        self.keys = keys = keys if keys is not None else Keys()
        self.mcs_table = tuple(mcs_table)
        self.answers = bool(topics) or settings.hears
        self._now = -inf
        rate = RateController(mcs_table, settings.tuning) if mcs_table else None
        self.pace = pace = Pace(settings.packet_rate)
        self._hold = hold = Hold(settings.tuning)
        room = room_of(settings, keys, block=access is not None)
        self.window = window = RepairWindow(
            settings.repair,
            room,
            settings.expected_loss,
            shares=settings.shares,
            proves=keys.sealed and settings.hears and settings.idle_is_free,
            slower=settings.slower,
            pace=pace,
            tuning=settings.tuning,
        )
        self.messages = messages = Outbox(
            topics,
            settings,
            self,
            window.peers,
            boot=boot,
            room=room,
            codec=codec,
            observer=observer,
            instances=instances,
        )
        self.sent = messages.stats
        self._receiving = ReceivingSide(
            settings,
            boot,
            keys,
            window.packets,
            decoder_for=decoder_for,
            custody=partial(
                Custody,
                (settings.src_id, boot),
                messages.sent,
                window.packets,
                window.peers,
                room=room,
                most=settings.max_source_bytes,
                drop=messages.drop,
                ended=messages.ledger.ended,
            ),
            access=access,
            tells_snr=rate is not None,
            heard=heard or {},
            save=save,
        )
        self.received = self._receiving.stats
        self.neighbours = neighbours = self._receiving.neighbours
        self._writer = writer = PacketWriter(
            settings,
            boot,
            keys,
            window,
            rate=rate,
            stats=self.sent,
            hold=hold,
            observer=observer,
            shares=access is not None,
        )
        hellos = Hellos(settings, boot, messages, window, neighbours, encrypts=keys.encrypts)
        self._sending = SendingSide(
            settings,
            messages,
            window,
            neighbours,
            hellos=hellos,
            writer=writer,
            hold=hold,
            pace=pace,
            rate=rate,
            relaying=self._receiving.relaying,
        )
        self.pings = self._sending.pings
        self.used_air = UsedAir(
            pace,
            room=room,
            turn_s=settings.turn_s,
            packet_len=settings.packet_len * settings.any_length,
            share=settings.airtime_share,
        )
        self.frames = SentFrames(
            messages.sent,
            messages,
            window.packets,
            window.peers,
            self.used_air,
            neighbours=neighbours.all,
            relayed=settings.relay,
        )

    def submitted(self, topic_id: int, now: float) -> None:
        self._now = now if now > self._now else self._now
        self._hold.submitted(topic_id, now)

    def behind(self, now: float) -> bool:
        return self._access is None and self._sending.behind(now)  # with medium access, messages wait for their slot

    @property
    def slow(self) -> bool:
        return self._access is None and self._sending.slow

    def topics_changed(self) -> None:
        self.answers = True
        self._sending.topics_changed(self._now)

    @property
    def idle(self) -> bool:
        """Whether no message waits, and no packet that has left is worth repairing."""
        mending = self.window.mode != "off" and self.window.wanted(self._now)
        return self.messages.idle and not mending

    @property
    def urgent(self) -> bool:
        return self._sending.urgent

    def receipts_of(self, robots: Collection[int]) -> Receipts:
        receipts = self.window.peers.receipts = Receipts(robots)
        return receipts

    @property
    def held_bytes(self) -> int:
        return sum(neighbour.inbox.held for neighbour in self.neighbours.all.values())

    def reconfigure(self, **changes: Any) -> None:
        check_live(changes, self.live_settings)
        self.settings = settings = replace(self.settings, **changes)
        self._sending.reconfigure(settings, self._now)
        self.messages.reconfigure(settings)

    def peers(self, now: float) -> list[HeardRobot]:
        relaying = self._receiving.relaying
        far = [] if relaying is None else relaying.far.reached(now, sealed=self.keys.sealed)
        over = {robot.robot for robot in far}
        return far + [
            HeardRobot(
                neighbour.src_id,
                now - neighbour.heard,
                neighbour.gone,
                neighbour.boot,
                neighbour.trailer.size == TAG_LEN,
                neighbour.inbox.reports.snr.snr_db,
                neighbour.inbox.reports.loss,
                self.received.missed[neighbour.src_id],
                sum("/msg/" in row.type_name for row in neighbour.inbox.announced.topics.values()),
                doubled=self.neighbours.doubled(neighbour.src_id, now),
                no_table=self.neighbours.lacks_table(neighbour, now),
            )
            for neighbour in self.neighbours.all.values()
            if neighbour.src_id not in over and (neighbour.proven or self.neighbours.doubled(neighbour.src_id, now))
        ]

    def knows(self, src_id: int) -> bool:
        return self._inbox(src_id) is not None

    def clock_of(self, src_id: int, now: float) -> ClockOffset | None:
        return self.pings.clock_of(src_id, now)

    def topics_of(self, src_id: int) -> Mapping[int, AnnouncedTopic]:
        inbox = self._inbox(src_id)
        return {} if inbox is None else inbox.announced.topics

    def _inbox(self, src_id: int) -> Inbox | None:
        """What has come of a robot, directly or over others."""
        neighbour, relaying = self.neighbours.all.get(src_id), self._receiving.relaying
        if relaying is not None:
            return relaying.far.present(src_id)
        return neighbour.inbox if neighbour is not None and neighbour.proven else None

    def unpublished(self, event: Delivered) -> Lost:
        return self._receiving.unpublished(event)

    def next_packet(self, now: float) -> SentPacket | None:
        self._now = now if now > self._now else self._now
        if not self.answers or not self.pace.may_leave(now):
            return None
        slot = SendSlot(now) if self._access is None else self._slot(self._access, now)
        if slot is None:
            return None
        sent = self._sending.packet(slot)
        if sent is None and slot.block:
            sent = self._writer.control(self._sending.tells(now), "report", slot)  # who sends nothing in one loses it
        if sent is None:
            return None
        self.pace.left(now, waiting=True)
        if self.used_air.on:
            self.used_air.left(sent, now)
        return sent

    def _slot(self, access: Access, now: float) -> SendSlot | None:
        """The slot for which a packet is to be composed now; None where it is too early for one."""
        begins = access.departure(now)
        if now < begins - access.lead_s - _EARLY_S:
            return None
        relaying = self._receiving.relaying
        block = access.block(1 if relaying is None else relaying.gains.weight, fills=self.frames.fill(now))
        return None if block is None else SendSlot(now, max(begins, now), block)

    def next_departure(self, *, credited: bool = False) -> float | None:
        if (self.pace.out_of_credit and not credited) or not self.answers:
            return None
        if self._access is not None:
            if self._now == -inf:  # a medium may ask before the sending thread has looked for the first time
                return -inf
            return max(self._access.departure(self._now) - self._access.lead_s, self.pace.slot)
        return self._sending.next_departure(self._now)

    def receive(self, arrival: AirPacket, now: float) -> list[ReceiverEvent]:
        self._now = now if now > self._now else self._now
        events, facts = self._receiving.receive(arrival, now)
        for fact in facts:  # grows where packets that came before can be opened now
            if isinstance(fact, Early):
                for at, data in fact.packets:
                    further, of_it = self._receiving.receive(AirPacket(data), now, at)
                    events += further
                    facts += of_it
            else:
                self._sending.learn(fact, now)
        return events

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        self._now = max(self._now, now)
        events, facts = self._receiving.handle_timeout(now)
        for fact in facts:
            self._sending.learn(fact, now)
        return events

    def next_timeout(self) -> float | None:
        return self._receiving.next_timeout()
