"""The receiving side for one robot: it turns packets into messages.

Which messages wait for an earlier one says ``order``, which for the table of topics says ``announced``, which are
delivered says ``delivery``, and when the sender is told what has arrived says ``reports``. Messages of topics without
reliable publishers are delivered as they arrive, but never after a later message of the same topic.

Invariants: no message is delivered twice, or after a later message of its topic; every message of which a part arrived
ends in one Delivered or Lost; memory is bounded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import inf
from typing import NamedTuple, Protocol

from gr_ros2.core.errors import CodecError, PadError, WireError
from gr_ros2.link.events import Announced, Delivered, Lost
from gr_ros2.link.fates import FATES, Fate
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.v1.announced import ARRIVING_S, AnnouncedTopics
from gr_ros2.link.v1.decoder import MOST_EQUATIONS, RepairDecoder
from gr_ros2.link.v1.delivery import UNKNOWN_S, DeliveryRules, for_all_in_order, passed_over
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.key import Key
from gr_ros2.link.v1.order import Order, Ready, nobody
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.link.v1.reassembly import PartialMessage, Reassembly
from gr_ros2.link.v1.reports import Reporter, SharedReporter
from gr_ros2.wire.control import MAP, Control, Waited
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import CARRIED_TOPIC, SPAN, TABLE_TOPIC, EntryV1, Part, read_body

_PACKET_COST, _EQUATION_COST = 250, 350
"""Bytes beside the body that a packet held and an equation take (``sys.getsizeof`` and their share of dictionaries and
of the list of gaps)."""
_INCOMPLETE_S = 60.0
"""s that an incomplete message waits for its next fragment, unless its sender repairs it until it is here."""


class Bounds(NamedTuple):
    """How the memory for one robot (``max_source_bytes``) is divided.

    :param span: packets remembered
    :param equations: equations held; together they take up to a half
    :param fragments: bytes of incomplete messages
    :param ordered: bytes of messages that may wait for an earlier one, whatever else is kept; above it, they wait no
        longer, unless what the others leave of the memory has room for them
    :param unknown: bytes of messages that may wait for the table of topics
    """

    span: int
    equations: int
    fragments: int
    ordered: int
    unknown: int

    @classmethod
    def of(cls, most: int, room: int) -> Bounds:
        """:param room: bytes of the longest body"""
        packets = most // 2
        equations = max(min(MOST_EQUATIONS, packets // 4 // (room + _EQUATION_COST)), MAP)
        rest = packets - equations * (room + _EQUATION_COST)
        span = max(min(SPAN, rest // (room + _PACKET_COST)), MAP)
        return cls(span, equations, most // 4, most // 8, most // 8)


def _waited(entries: Sequence[EntryV1]) -> Waited | None:
    """What a packet tells, behind its messages, of how long these have waited."""
    for entry in reversed(entries):
        if isinstance(entry, Part):
            return None
        if isinstance(entry, Waited):
            return entry
    return None


class Passing(Protocol):
    """What is told of messages that may be sent on."""

    def direct(self, src_id: int, boot: int, ready: Ready, now: float) -> None:
        """A message has come from the robot that made it."""

    def receive(self, via: int, ready: Ready, now: float, *, withheld: bool = False) -> None:
        """A message of another robot has come over one that is heard.

        :param withheld: the packet may have been held back too long for what has to be fresh
        """

    def in_order(self, inbox: Inbox, ready: Ready, late: int) -> None:
        """A message of a reliable topic for all has come out.

        :param late: how many messages of its topic robots get that come later
        """


class Inbox:
    """What arrives from one start of one robot.

    :param first: number of the first packet that may be needed
    :param room: bytes of its longest body
    :param decoder_for: makes the decoder for its messages from its table of topics
    :param marks: CRC-32 of the newest messages of each latched topic, in the form in which they were transmitted: as
        many as its depth
    :param outcomes: takes what comes of its packets, shared with other inboxes
    :param control: called with entries that are not messages
    :param relaying: is told of messages that came, where they are relayed
    :param give_up_s: s of silence after which the robot is regarded as gone
    :param quiet_s: s of silence after which others are believed about its messages
    :param patience_s, brings: see :class:`gr_ros2.link.v1.order.Order`
    :ivar first: see above
    :ivar reports: what the robot is told of its packets
    :ivar announced: its topics
    :ivar order: which of its messages wait for an earlier one
    :ivar deliveries: which of them are delivered
    :ivar began: when the packet that is processed began to arrive, s
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
        relaying: Passing | None = None,
        give_up_s: float = inf,
        quiet_s: float = inf,
        patience_s: float = inf,
        brings: Callable[[float], bool] = nobody,
    ) -> None:
        self.src_id, self.boot = src_id, boot
        self.deliveries = DeliveryRules(settings, marks)
        self._room, self._settings = room, settings
        self._control, self._relaying = control, relaying
        self._outcomes, self._stats = outcomes, outcomes.stats
        bounds = Bounds.of(settings.max_source_bytes, room)
        self.decoder = RepairDecoder(room, self._plausible, bounds.span, bounds.equations)
        self.decoder.begin(first)
        self.decoder.newest = first - 1
        self.first, self._give_up_s, self._heard = first, give_up_s, inf
        self._most = settings.max_source_bytes
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
        )
        of = src_id, boot
        self.reports: Reporter = (
            SharedReporter(of, self.decoder, self.order, self._reassembly, settings)
            if settings.shares
            else Reporter(of, self.decoder, self.order, settings)
        )
        self.announced = AnnouncedTopics(decoder_for, bounds.unknown)
        self._now = 0.0
        self._takes = False
        """Whether packets are taken that are known at once. The decoder has all of them from the first one on: whoever
        settled before the last one, as for a message of this robot that it hands on, would pass over the others'."""
        self.began = inf

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

    def source(self, number: int, body: bytes, entries: Sequence[EntryV1], qos: int, now: float) -> None:
        """Take a source packet.

        :param body: as it stood in the packet, padding included
        :param entries: the entries of the packet
        """
        decoder = self.decoder
        if number in decoder.bodies:
            self._stats.dropped["duplicate"] += 1
            return
        if number < decoder.floor:
            self._stats.dropped["late"] += 1
            return
        late = number < decoder.newest
        self._advance(number, now, here=True)
        self.reports.arrived(late=late)
        self._takes = True
        try:
            for found in decoder.source(number, body[: self._room]):
                if found[0] == number:
                    self._take(number, entries, qos, repaired=late)
                else:
                    self._recovered(found)
        finally:
            self._takes = False
        self._settle()

    def repair(
        self, number: int, mask: int, repair_id: int, combined: bytes, *, oldest: bool, now: float, new: bool = True
    ) -> None:
        """Take a repair; only one that was not here before calls for a report.

        :raises PadError: it is longer than bodies of this start are
        """
        if len(combined) > self._room and combined.count(0, self._room) < len(combined) - self._room:
            raise PadError(f"a combination of {len(combined)} bytes, where bodies have {self._room}")
        self.reports.unreported += new
        self.reports.confirms = True
        self._advance(number, now, here=False, late=True)
        window = mask.bit_length()
        if oldest:
            self.order.repaired_from(number - window + 1)
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

    def heard(self, number: int, now: float, *, over: bool = False) -> None:
        """Note the number at which a packet stands that is neither a source packet nor a repair.

        :param over: the sender repairs no packet up to that number
        """
        self._advance(number, now, here=False)
        self.decoder.advance(number)
        if over:
            self.order.repaired_from(number + 1)
        self._settle()

    def handle_timeout(self, now: float) -> None:
        """Go on without packets that have been waited for long enough."""
        self._now = now
        self._settle()
        for partial in self._reassembly.expired(now, self._incomplete_s, self._repaired_until_here):
            self._lose(partial, Fate.EXPIRED)

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do."""
        ordered, waiting = self.order.next_timeout(), self._reassembly.next_timeout()
        if waiting is None:
            return ordered
        waiting += self._incomplete_s
        return waiting if ordered is None else min(ordered, waiting)

    @property
    def _incomplete_s(self) -> float:
        return _INCOMPLETE_S * self._settings.slower

    def _repaired_until_here(self, partial: PartialMessage) -> bool:
        if partial.topic_id > TABLE_TOPIC:  # of another robot
            return self.order.told and self.order.wanted <= partial.newest[0]
        topic = self.announced.topics.get(partial.topic_id)
        return self.order.told and topic is not None and topic.reliable

    def ended(self, now: float) -> None:
        """The sender has started again: no packet of this start comes any more, so nothing waits for one."""
        self._now = now
        self._release(self.order.without(()))
        self.close(Fate.SENDER_RESTARTED)

    def close(self, reason: Fate) -> None:
        """Give up everything that is not delivered."""
        for partial in self._reassembly.clear():
            self._lose(partial, reason)
        self._give_up(self.order.without(()), reason)
        for ready in self.announced.waiting():
            self._give_up([ready], self.announced.unknown(ready))

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
        if not self._takes and (due := self.order.settle(self._now)):
            self._release(due)

    def _release(self, due: Iterable[Ready]) -> None:
        for ready in due:
            if ready.topic_id == CARRIED_TOPIC:
                self._of_another(ready)
            else:
                self._deliver(ready, self.announced.topics[ready.topic_id])

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
        self.order.heard = now
        newest = self.decoder.newest
        if not late:
            silence, self._heard = now - self._heard, now
            if silence >= self._give_up_s:
                self.deliveries.silent_before(number + (not here))
        if number <= newest:
            return
        self.deliveries.reached(number, self.began, late=late)
        gone = number - newest - here
        if gone:
            met = newest >= self.first  # what came before the first packet that was heard is not lost
            self._stats.missed[self.src_id] += gone * met
            self.reports.missed(gone, counts=met)
            self.order.missing(now, newest + 1, newest + gone)

    def _recovered(self, found: tuple[int, bytes]) -> None:
        number, body = found
        self._take(number, read_body(body, self._room), -1, repaired=True)

    def _take(self, number: int, entries: Sequence[EntryV1], qos: int, *, repaired: bool) -> None:
        """Process the entries of a packet that is known now."""
        self.order.contents.learn(number)
        repaired_s = self._repaired_s(entries) if repaired else inf
        waited = _waited(entries)
        for place, entry in enumerate(entries):
            if not isinstance(entry, Part):
                self._control(entry)
                continue
            waited_s = 0.0 if waited is None else min(waited.age_s(place), UNKNOWN_S)
            topic = self.announced.topics.get(entry.topic_id)
            if topic is None or topic.reliable or topic.latched:
                self.reports.confirms = True
            if entry.whole:
                ready = Ready(entry.topic_id, (number, place), entry.payload, qos, entry.coded, repaired)
                self._arrived(ready, repaired_s, waited_s)
            else:
                self._fragment(entry, number, place, qos, repaired=repaired, waited_s=waited_s)

    def _fragment(self, part: Part, number: int, place: int, qos: int, *, repaired: bool, waited_s: float) -> None:
        if (number, place) < self.deliveries.newest.get(part.topic_id, (0, 0)) or number < part.back:
            self._stats.dropped["overtaken"] += 1
            return
        made = self.deliveries.made(number, self.began, repaired=repaired) - waited_s if waited_s else inf
        whole = self._reassembly.add(part, number, place, repaired=repaired, now=self._now, made=made)
        for partial in self._reassembly.overflowing():
            self._lose(partial, Fate.MEMORY)
        if whole is None:
            return
        payload = whole.payload()
        if payload is None:
            self._lose(whole, Fate.DAMAGED)
            return
        ready = Ready(whole.topic_id, whole.order, payload, qos, whole.coded, whole.repaired)
        ready.made = whole.made
        self._arrived(ready)

    def _repaired_s(self, entries: Iterable[EntryV1]) -> float:
        """s for which the sender repairs a packet: as long as one of its messages is of use."""
        rows = (self.announced.topics.get(entry.topic_id) for entry in entries if isinstance(entry, Part))
        return max((inf if row is None else row.deadline_s or inf for row in rows), default=inf)

    def _arrived(self, ready: Ready, repaired_s: float = inf, waited_s: float = 0.0) -> None:
        """A message is complete.

        :param repaired_s: s for which its sender repairs the packet that brought it
        :param waited_s: s for which it had waited at its sender when that packet left
        """
        topic = self.announced.topics.get(ready.topic_id)
        if repaired_s < inf and topic is not None and repaired_s > self.deliveries.deadline_s(topic):
            repaired_s = inf
        left = self.deliveries.made(ready.order[0], self.began, repaired_s, repaired=ready.repaired)
        ready.made = min(ready.made, left - waited_s)
        if ready.topic_id > TABLE_TOPIC:
            if ready.topic_id == CARRIED_TOPIC and ready.order[0] > self.order.low:
                self.order.wait(ready, self._now)
            else:
                self._of_another(ready)
            return
        if ready.topic_id == TABLE_TOPIC:
            self.announced.newest = max(ready.order[0], self.announced.newest[0]), self._now
            self._table(ready.payload, ready.order)
        if self._relaying is not None:
            if ready.topic_id == TABLE_TOPIC:
                ready.payload = self.announced.table
            self._relaying.direct(self.src_id, self.boot, ready, self._now)
        if ready.topic_id != TABLE_TOPIC:
            self._known(ready)

    def _known(self, ready: Ready) -> None:
        """Deliver a message as soon as its topic is known. One of a reliable topic waits for those before it, unless
        robots that kept all of them have handed it on."""
        topic = self.announced.topic_of(ready)
        if topic is None:
            self._await_table(ready)
        elif not topic.reliable or ready.carried or self.order.passes(ready):
            self._deliver(ready, topic)
        else:
            self.order.wait(ready, self._now)

    def _await_table(self, ready: Ready) -> None:
        for lost in self.announced.wait(ready):
            self._give_up([lost], self.announced.unknown(lost))

    def _of_another(self, ready: Ready) -> None:
        """A message of another robot."""
        if self._relaying is None:
            self._stats.dropped["relayed"] += 1
            return
        ready.sealed = self.deliveries.sealed(ready)
        withheld = self._now - ready.sealed > self.deliveries.withheld_s
        self._relaying.receive(self.src_id, ready, self._now, withheld=withheld)

    def relayed(self, ready: Ready, now: float) -> None:
        """Take a message of this robot that has come over another one."""
        self._now = now
        if ready.topic_id == TABLE_TOPIC:
            self._table(ready.payload, ready.order, direct=False)
        else:
            if not self.deliveries.came_over(ready) and not self.order.told_again(ready):
                self._stats.repeats += 1
                return
            topic = self.announced.topics.get(ready.topic_id)
            begins = topic is not None and topic.latched and ready.topic_id not in self.deliveries.newest
            if begins or (topic is not None and not for_all_in_order(topic)):
                ready.after = (0, 0)  # it follows whatever is here
            self._known(ready)
        self._settle()

    def up_to(self, topic: AnnouncedTopic) -> tuple[int, int] | None:
        """All messages of a topic up to this one are here; None for one that is kept, and of which none has come."""
        if topic.latched and topic.topic_id not in self.deliveries.newest:
            return None
        return self.order.up_to(topic.topic_id)

    def overrule(self, number: int) -> bool:
        """The robot itself has reached this number: what came over others before with a greater one was false.

        :return: whether none of that is left
        """
        self._give_up(self.order.beyond(number), Fate.DAMAGED)
        return self.deliveries.overrule(number, self.began)

    def adopt(self, far: Inbox) -> None:
        """Go on from what has come of this start over other robots."""
        self.deliveries.adopt(far.deliveries)
        self.order.reached.update(far.order.reached)
        self.order.passed_on.update(far.order.passed_on)
        for ready in far.order.without(()):
            self.order.wait(ready, self._now)
        if not self.announced.topics:
            self.announced = far.announced
        for ready in far.announced.waiting():
            self._known(ready)

    def _deliver(self, ready: Ready, topic: AnnouncedTopic) -> None:
        refusal = self.deliveries.refusal(ready, topic, self._now)
        if refusal is not None:
            self._give_up([ready], refusal)
            return
        new = self.deliveries.takes(ready, topic, self._now)
        for partial in self._reassembly.overtaken(ready.topic_id, ready.order[0]):
            self._lose(partial, passed_over(topic))
        if not new:
            self._stats.repeats += 1
            return
        if self._relaying is not None and for_all_in_order(topic) and not ready.carried:
            self.order.reached[ready.topic_id] = ready.order
            self._relaying.in_order(self, ready, max(topic.depth, 1) * topic.latched)
        try:
            payload = self.announced.decode(ready) if ready.coded else ready.payload
        except CodecError as error:
            self._give_up([ready], FATES[error.fate])
            return
        qos = ready.qos if ready.qos >= 0 else topic.qos
        key = Key(self.boot, ready.order[0], ready.order[1])
        self._outcomes.delivered(
            Delivered(
                self.src_id,
                ready.topic_id,
                payload,
                qos,
                key,
                ready.repaired,
                ready.hops,
                ready.over,
                self._now - ready.made,
            )
        )

    def _table(self, payload: bytes, order: tuple[int, int], *, direct: bool = True) -> None:
        try:
            topics = self.announced.take(payload, order, direct=direct)
        except WireError:
            self._stats.dropped["bad_table"] += 1
            return
        if topics is None:
            return
        for ready in self.order.without({*self.announced.topics, CARRIED_TOPIC}):
            self._await_table(ready)  # its topic is not offered any more
        self._outcomes.events.append(Announced(self.src_id, topics))
        for ready in self.announced.waiting():
            self._known(ready)

    def _lose(self, partial: PartialMessage, reason: Fate) -> None:
        key = Key(self.boot, partial.begin, partial.place)
        self._outcomes.lost(Lost(self.src_id, partial.topic_id, reason, key))

    def _give_up(self, messages: Iterable[Ready], reason: Fate) -> None:
        for ready in messages:
            self._outcomes.lost(Lost(self.src_id, ready.topic_id, reason, Key(self.boot, *ready.order)))
