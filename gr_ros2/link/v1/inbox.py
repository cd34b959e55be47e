"""The receiving side for one robot: it turns packets into the contents of packets, those that repairs recover too.

What becomes of their messages says ``arriving``, and when the sender is told what has arrived says ``reports``.

Invariants: no packet is taken twice; memory is bounded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import inf
from typing import NamedTuple

from gr_ros2.core.errors import PadError, WireError
from gr_ros2.link.fates import Fate
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.v1.announced import ARRIVING_S, AnnouncedTopics
from gr_ros2.link.v1.arriving import ArrivingMessages, Passing
from gr_ros2.link.v1.decoder import MOST_EQUATIONS, RepairDecoder
from gr_ros2.link.v1.delivery import DeliveryRules
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.order import Order, Ready, nobody
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.link.v1.overtaking import Overtaken, Overtaking
from gr_ros2.link.v1.reassembly import Reassembly
from gr_ros2.link.v1.reports import Reporter, SharedReporter
from gr_ros2.wire.control import MAP, Control, LeftOut
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import SPAN, TABLE_TOPIC, EntryV1, read_body

_PACKET_COST, _EQUATION_COST = 350, 430
"""Bytes beside the body that a packet held and an equation take (``sys.getsizeof`` and their share of dictionaries that
have just grown, and of what is noted of missing packets)."""
_NAMED = 64
"""Newest repairs of which it is remembered that all packets that they name were of use when they left."""
_ROBOT_COST = 1_200_000
"""Bytes that a robot takes beside its packets and messages, at most: numbers of its packets and repairs, messages that
may come again, packets that cannot be opened yet. A share of a small memory."""


class Bounds(NamedTuple):
    """How the memory for one robot (``max_source_bytes``) is divided.

    :param most: bytes of packets and messages
    :param span: packets remembered
    :param equations: equations held; together they take up to a half
    :param fragments: bytes of incomplete messages
    :param ordered: bytes of messages that may wait for an earlier one, whatever else is kept; above it, they wait no
        longer, unless what the others leave of the memory has room for them
    :param unknown: bytes of the table of topics, and of messages that may wait for it
    """

    most: int
    span: int
    equations: int
    fragments: int
    ordered: int
    unknown: int

    @classmethod
    def of(cls, most: int, room: int) -> Bounds:
        """:param most: bytes in all, what is noted of the robot included
        :param room: bytes of the longest body"""
        most -= min(_ROBOT_COST, most // 8)
        packets = most // 2
        equations = max(min(MOST_EQUATIONS, packets // 4 // (room + _EQUATION_COST)), MAP)
        rest = packets - equations * (room + _EQUATION_COST)
        span = max(min(SPAN, rest // (room + _PACKET_COST)), MAP)
        return cls(most, span, equations, most // 4, most // 8, most // 8)


class Inbox:
    """What arrives from one start of one robot.

    :param first: number of the first packet that may be needed
    :param room: bytes of its longest body
    :param decoder_for: makes the decoder for its messages from its table of topics
    :param marks: CRC-32 of the newest messages of each latched topic, in the form in which they were transmitted: as
        many as its depth
    :param outcomes: takes what comes of its packets, shared with other inboxes
    :param control: called with entries that are not messages
    :param learned: of the packets of its earlier starts over several radios
    :param relaying: is told of messages that came, where they are relayed
    :param give_up_s: s of silence after which the robot is regarded as gone
    :param quiet_s: s of silence after which others are believed about its messages
    :param patience_s, brings: see :class:`gr_ros2.link.v1.order.Order`
    :param tells_snr: see :class:`gr_ros2.link.v1.reports.Reporter`
    :param sealed_after: see :class:`gr_ros2.link.v1.delivery.DeliveryRules`
    :ivar first: see above
    :ivar reports: what the robot is told of its packets
    :ivar messages: what becomes of its messages
    :ivar order: which of its messages wait for an earlier one
    :ivar deliveries: which of them are delivered
    """

    def __init__(
        self,
        src_id: int,
        boot: int,
        first: int,
        room: int,
        settings: Settings,
        *,
        decoder_for: Callable[[tuple[AnnouncedTopic, ...]], MessageCodec] | None,
        marks: dict[int, tuple[int, ...]],
        outcomes: Outcomes,
        control: Callable[[Control], None],
        learned: Overtaken | None = None,
        relaying: Passing | None = None,
        give_up_s: float = inf,
        quiet_s: float = inf,
        patience_s: float = inf,
        brings: Callable[[float], bool] = nobody,
        tells_snr: bool = True,
        sealed_after: Callable[[int], float] | None = None,
    ) -> None:
        self.src_id, self.boot = src_id, boot
        self.deliveries = DeliveryRules(settings, marks, sealed_after)
        self._room, self._settings = room, settings
        self._stats = outcomes.stats
        bounds = Bounds.of(settings.max_source_bytes, room)
        self.decoder = RepairDecoder(room, self._plausible, bounds.span, bounds.equations)
        self.decoder.begin(first)
        self.decoder.newest = first - 1
        self.first, self._give_up_s, self._heard = first, give_up_s, inf
        self._most = bounds.most
        self._reassembly = Reassembly(bounds.fragments)
        self.order = Order(
            self.decoder,
            first,
            settings.hold_s,
            sure=bounds.ordered,
            fits=lambda held: held + self._others() <= self._most,
            room=room,
            quiet_s=quiet_s,
            patience_s=patience_s,
            incomplete=self._reassembly.oldest,
            brings=brings,
            tuning=settings.tuning,
        )
        several = settings.radios > 1
        self._overtaking = (
            Overtaking(self.decoder, self.order.contents, learned or Overtaken(settings.tuning)) if several else None
        )
        of = src_id, boot
        self.reports: Reporter = (
            SharedReporter(of, self.decoder, self.order, settings, self._reassembly, tells_snr=tells_snr)
            if settings.shares
            else Reporter(of, self.decoder, self.order, settings, tells_snr=tells_snr)
        )
        self.messages = ArrivingMessages(
            of,
            settings,
            order=self.order,
            overtaking=self._overtaking,
            announced=AnnouncedTopics(decoder_for, bounds.unknown),
            deliveries=self.deliveries,
            reassembly=self._reassembly,
            reports=self.reports,
            outcomes=outcomes,
            control=control,
            relaying=relaying,
        )
        self._named: deque[tuple[int, int]] = deque(maxlen=_NAMED)
        """Number and mask of these."""
        self._now = 0.0
        self._takes = False
        """Whether packets are taken that are known at once. The decoder has all of them from the first one on: whoever
        settled before the last one, as for a message of this robot that it hands on, would pass over the others'."""
        self._began = inf
        """When the packet that is processed began to arrive, s."""

    @property
    def announced(self) -> AnnouncedTopics:
        """Its topics."""
        return self.messages.announced

    @property
    def newest(self) -> int:
        """The newest packet number seen."""
        return self.decoder.newest

    @property
    def held(self) -> int:
        """Bytes of incomplete messages, bookkeeping included."""
        return self._reassembly.held

    def _others(self) -> int:
        """Bytes of all that is kept beside the messages that wait for an earlier one, at most."""
        packets, equations = len(self.decoder.bodies), self.decoder.equations
        coded = packets * (self._room + _PACKET_COST) + equations * (self._room + _EQUATION_COST)
        return coded + self._reassembly.held + self.announced.held

    def source(
        self, number: int, body: bytes, entries: Sequence[EntryV1], qos: int, now: float, *, began: float = inf
    ) -> None:
        """Take a source packet.

        :param body: as it stood in the packet, padding included
        :param entries: the entries of the packet
        :param began: when it began to arrive, s
        """
        decoder, self._began = self.decoder, began
        if number in decoder.bodies:
            self._stats.dropped["duplicate"] += 1
            return
        if number < decoder.floor:
            self._stats.dropped["late"] += 1
            return
        late = number < decoder.newest
        self._advance(number, now, here=True)
        if self._overtaking is not None:
            self._overtaking.came(number, now, late=late)
        self.reports.arrived(late=late)
        self._takes = True
        try:
            for found in decoder.source(number, body[: self._room]):
                if found[0] == number:
                    self.messages.take(number, entries, qos, now, began, repaired=late)
                else:
                    self._recovered(found)
        finally:
            self._takes = False
        self._settle()

    def repair(
        self,
        number: int,
        mask: int,
        repair_id: int,
        combined: bytes,
        *,
        oldest: bool,
        now: float,
        began: float = inf,
        new: bool = True,
    ) -> None:
        """Take a repair; only one that was not here before calls for a report.

        :raises PadError: it is longer than bodies of this start are
        """
        if len(combined) > self._room and combined.count(0, self._room) < len(combined) - self._room:
            raise PadError(f"a combination of {len(combined)} bytes, where bodies have {self._room}")
        self._began = began
        self.reports.repair(new=new)
        self._advance(number, now, here=False, late=True)
        window = mask.bit_length()
        if oldest:
            self.order.repaired_from(number - window + 1)
        if mask + 1 != 1 << window or window == 1 or len(combined) + (window + 7) // 8 <= self._room:
            self._named.append((number, mask))
        redundant = self.decoder.counts["redundant"]
        self._takes = True
        try:
            for found in self.decoder.repair(number, mask, repair_id, combined):
                self._recovered(found)
        finally:
            self._takes = False
        if self.decoder.counts["redundant"] > redundant:
            self.reports.repaired_in_vain()
        if mask + 1 != 1 << window:
            self.order.left_out(number, mask)
        self._settle()

    def _of_use(self, number: int) -> bool:
        """Whether a packet was of use when a repair of it left, as one shows whose mask leaves nothing out but what is
        not. Where a mask does not fit beside the bodies, a repair has all packets of its span, however old."""
        return any(newest >= number and mask >> newest - number & 1 for newest, mask in self._named)

    def heard(self, number: int, now: float, began: float = inf, *, over: bool = False) -> None:
        """Note the number at which a packet stands that is neither a source packet nor a repair.

        :param began: when it began to arrive, s
        :param over: the sender repairs no packet up to that number
        """
        self._began = began
        self._advance(number, now, here=False)
        if number >= self.decoder.newest:
            self.deliveries.stands(number, began)
        self.decoder.advance(number)
        if over:
            self.order.repaired_from(number + 1)
        self._settle()

    def left_out(self, told: LeftOut) -> None:
        """No message waits for these packets."""
        number = self.newest - ((self.newest - told.number) & 0xFFFF)
        self.order.left_out(number, 1 << MAP | ~told.packets & (1 << MAP) - 1)
        if told.settled:
            self.order.repaired_from(number - MAP + 1)
        self._settle()
        if self.order.held:
            self.reports.repair(new=True)  # its sender goes on to what is waited for now

    def handle_timeout(self, now: float) -> None:
        """Go on without packets that have been waited for long enough."""
        self._now = now
        self._settle()
        self.messages.expire(now)

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do."""
        overtaken = None if self._overtaking is None else self._overtaking.next_timeout()
        times = self.order.next_timeout(), self.messages.next_expiry(), overtaken
        return min((at for at in times if at is not None), default=None)

    def ended(self, now: float) -> None:
        """The sender has started again: no packet of this start comes any more, so nothing waits for one."""
        self._now = now
        self.messages.release(self.order.without(()), now)
        if self._overtaking is not None:
            self.messages.release(self._overtaking.clear(), now)
        self.close(Fate.SENDER_RESTARTED)

    def close(self, reason: Fate) -> None:
        """Give up everything that is not delivered."""
        self.messages.close(reason)

    def lacks(self, mark: tuple[int, int], number: int, now: float) -> bool:
        """Whether a latched message or the table, named in a hello at a packet number, is neither here, nor a newer one
        of its topic, nor arriving."""
        since = now - ARRIVING_S * self._settings.slower
        growing = self._reassembly.growing(mark[0], since)
        if mark[0] == TABLE_TOPIC:
            return self.announced.lacks(mark[1], number, since) and not growing
        topic = self.announced.topics.get(mark[0])
        if topic is not None and not self.deliveries.is_for_us(topic):
            return False
        return self.deliveries.lacks(mark, number) and not growing

    def _settle(self) -> None:
        """Deliver the messages that waited for what is here or given up now."""
        if self._takes:
            return
        if due := self.order.settle(self._now):
            self.messages.release(due, self._now)
        if self._overtaking is not None:
            if lost := self._overtaking.lost(self._now):
                self._missed(lost, counts=True)
            self.messages.release(self._overtaking.due(self._now), self._now)

    def _plausible(self, body: bytes) -> bool:
        try:
            read_body(body, self._room)
        except WireError:
            return False
        return True

    def _advance(self, number: int, now: float, *, here: bool, late: bool = False) -> None:
        """The sender has reached this number, of which the decoder is told next. Packets between the newest one and it
        are missing for now.

        :param late: it may have reached it long ago
        """
        self._now = now
        self.order.hear(now)
        newest = self.decoder.newest
        if not late:
            silence, self._heard = now - self._heard, now
            if silence >= self._give_up_s:
                self.deliveries.silent_before(number + (not here))
        if number <= newest:
            return
        self.deliveries.reached(number, self._began, late=late)
        gone = number - newest - here
        if gone:
            met = newest >= self.first  # what came before the first packet that was heard is not lost
            self.order.missing(now, newest + 1, newest + gone)
            if self._overtaking is None or not met or gone > MAP:
                self._missed(gone, counts=met)
            else:
                self._overtaking.missing(now, newest + 1, newest + gone)

    def _missed(self, packets: int, *, counts: bool) -> None:
        """Packets are missing.

        :param counts: whether they were lost; otherwise nobody listened
        """
        self._stats.missed[self.src_id] += packets * counts
        self.reports.missed(packets, counts=counts)

    def _recovered(self, found: tuple[int, bytes]) -> None:
        number, body = found
        entries = read_body(body, self._room)
        self.messages.take(number, entries, -1, self._now, self._began, repaired=True, of_use=self._of_use(number))

    def relayed(self, ready: Ready, now: float) -> None:
        """Take a message of this robot that has come over another one."""
        self._now = now
        self.messages.over_another(ready, now)
        self._settle()

    def up_to(self, topic: AnnouncedTopic) -> tuple[int, int] | None:
        """All messages of a topic up to this one are here; None for one that is kept, and of which none has come. Of
        what was kept before this robot came, each follows the one before."""
        if topic.latched:
            newest = self.deliveries.newest.get(topic.topic_id)
            if newest is None or newest[0] < self.first:
                return newest
        return self.order.up_to(topic.topic_id)

    def overrule(self, number: int, began: float) -> bool:
        """The robot itself has reached this number, in a packet that began to arrive at a time, s: what came over
        others before with a greater one was false.

        :return: whether none of that is left
        """
        self.messages.give_up(self.order.beyond(number), Fate.DAMAGED)
        return self.deliveries.overrule(number, began)

    def adopt(self, far: Inbox) -> None:
        """Go on from what has come of this start over other robots."""
        self.messages.adopt(far.messages, self._now)
