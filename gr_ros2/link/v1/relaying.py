"""Messages of other robots at one robot: what it holds of them, what it sends on, and what it delivers.

A robot that is not heard directly is *far*: its table of topics and its messages come over others. The table travels
like a message, as topic 240 of its origin behind the full boot number; whoever hears the origin itself sends it on
under the number that the origin has reached, again every ``relay_table_s``, one of several packets more seldom.

Messages of reliable topics for one robot, and calls, are carried to it (``custody``). Of reliable topics for all, all
messages are relayed to those who do not hear their origin, in their order, once they have come out here
(``relay.in_order``); of all others the newest of each topic.

A message has an age, which grows at every robot. Where its table is known, a robot sends nothing on that is older than
its topic allows. For how long what a robot has said counts says ``relay.robots``.

What is known of far robots holds ``far``, and what is sent on ``sent_on``. Repairs tell nothing of how far a robot is,
since they may be sent long after what is in them.

Invariant: a message is delivered once, whether it comes directly or over others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf

from gr_ros2.core.errors import WireError
from gr_ros2.core.tuning import Tuning
from gr_ros2.link.message_codec import FRAME
from gr_ros2.link.v1.arriving import ArrivingMessages
from gr_ros2.link.v1.custody import Custody
from gr_ros2.link.v1.delivery import UNKNOWN_S, for_all_in_order
from gr_ros2.link.v1.facts import Reached
from gr_ros2.link.v1.far import FarRobots
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.neighbours import Neighbour, Neighbours
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.link.v1.sent_on import REPAIRED_S, SentOn, ToPass
from gr_ros2.link.v1.sent_topics import LONG_CARRIED, RELAYED
from gr_ros2.link.v1.sequences import Sequences
from gr_ros2.relay.gain import Gains, Stream
from gr_ros2.relay.in_order import Kept, Name
from gr_ros2.relay.memory import Memory
from gr_ros2.relay.robots import QUIET_S, OtherRobots
from gr_ros2.relay.routes import Routes
from gr_ros2.settings.registry import CALLS_TYPE
from gr_ros2.wire.ages import age_of
from gr_ros2.wire.control import Newest
from gr_ros2.wire.mac_block import NOBODY, Block
from gr_ros2.wire.relayed import (
    RECEIPT_TOPIC,
    Receipt,
    Relayed,
    read_carried,
    read_receipts,
    read_relayed,
)
from gr_ros2.wire.table import write_table
from gr_ros2.wire.v1 import BROADCAST, CARRIED_TOPIC, TABLE_TOPIC

_BOOT_LEN = 8


class Relaying:
    """What one robot does with messages of other robots.

    :param src_id: of this robot
    :param robots: the others
    :param neighbours: those that are heard
    :param outcomes: takes what comes of it
    :param packet_len: bytes of a packet
    :param repairs: whether lost packets are repaired
    :param most: bytes of all that is kept of messages of other robots
    :param make_inbox: see :class:`FarRobots`
    :param custody: makes what keeps messages for single robots
    :ivar gains: who lacks what
    :ivar routes: over whom robots are reached
    :ivar memory: shared by all that is kept: far tables, the two kinds of what is sent on, what is carried here and on
    :ivar far: the robots that are known over others
    :ivar sent_on: what is sent on
    """

    def __init__(
        self,
        src_id: int,
        robots: OtherRobots,
        neighbours: Neighbours,
        outcomes: Outcomes,
        make_inbox: Callable[[int, int, int], Inbox],
        *,
        custody: Callable[..., Custody],
        packet_len: int,
        repairs: bool,
        most: int,
        tuning: Tuning,
    ) -> None:
        self._tuning = tuning
        self.src_id, self._robots, self._packet_len = src_id, robots, packet_len
        self._neighbours, self._outcomes, self._dropped = neighbours, outcomes, outcomes.stats.dropped
        self.gains, self.routes = Gains(src_id, robots, tuning), Routes(robots)
        self.memory = Memory(most, kinds=5)
        self.far = FarRobots(robots, neighbours, outcomes, self.routes, make_inbox, share=self.memory.share())
        self.sent_on = SentOn(self.gains, self._dropped, self.memory, tuning, repairs=repairs)
        self._telling = deque[Stream | None]()
        """What is told next: a reliable topic for all, or None for the newest message of the next of the others."""
        self._swept = 0.0
        self._tables: dict[int, tuple[int, bytes, float]] = {}
        """Robots that are heard: boot number, table, and when it was last worth sending on."""
        self._carried_here = Sequences[Ready](self.memory.share())
        self.custody = custody(gains=self.gains, routes=self.routes, share=self.memory.share(), dropped=self._dropped)

    # ---- what arrives

    def heard(self, src_id: int, block: Block | None, now: float) -> None:
        """A packet of a robot was heard.

        :param block: tells whom that robot hears
        """
        names = () if block is None else [name for name in block.names if name != NOBODY]
        self.gains.neighbour(src_id, now, names, 0 if block is None else block.heard)
        self.routes.note(src_id, src_id, 0, now)
        neighbour = self._neighbours.all.get(src_id)
        boot, table, at = self._tables.get(src_id, (0, b"", now))
        if neighbour is not None and not neighbour.hello.digest and boot != neighbour.boot:
            boot, table, at = neighbour.boot, write_table(()), -inf  # others learn that it is there, and where
        packets = max(self._tuning.relay_table_later * len(table) / self._packet_len, 1)
        every = min(self._tuning.relay_table_s * packets, REPAIRED_S) * self._robots.slower()
        if table and neighbour is not None and now - at > every:
            self._table(src_id, boot, table, neighbour.inbox.newest, now)
        if now > self._swept + self._tuning.relay_table_s:
            self._sweep(now)

    def reached(self, neighbour: Neighbour, number: int, began: float) -> None:
        """A robot itself has reached this number, in a packet that began to arrive at a time, s: whoever has said more
        was wrong."""
        if self.far.overruled(neighbour, number, began):
            topics = neighbour.inbox.announced.topics
            self.sent_on.drop_above(neighbour.src_id, neighbour.boot & 0xFFFF, number, topics)

    def newest(self, src_id: int, newest: Newest, now: float) -> None:
        """A robot tells the newest message that it has of a topic."""
        if newest.place is None:
            self.gains.told(src_id, newest)
        else:
            self.sent_on.in_order.told(src_id, newest, now)

    def started(self, before: Neighbour, now: float) -> None:
        """A robot that is heard has started again: it has nothing of what it had."""
        self.gains.started(before.src_id)
        self.sent_on.in_order.started(before.src_id)
        self.far.replaced(before, now)

    def direct(self, src_id: int, boot: int, ready: Ready, now: float) -> None:
        """A message has come from the robot that made it."""
        number, place = ready.order
        self._robots.of(src_id).hops = 0
        if ready.topic_id == TABLE_TOPIC:
            if (inbox := self.far.inbox(src_id, boot & 0xFFFF)) is not None:
                self._due(inbox, now, receipts=True)
            if self._tables.get(src_id, (0, b"", 0.0))[:2] != (boot, ready.payload):
                self._tables[src_id] = boot, ready.payload, -inf  # of all rows in a packet
            return
        if ready.payload[:1] == FRAME and ready.coded:
            return  # a chain of frames is not passed on: who lacks one of them would have no use for the others
        if self._comes_whole(src_id, ready.topic_id):
            return
        message = Relayed(src_id, boot & 0xFFFF, number, place, ready.topic_id, 0, ready.payload, ready.coded)
        if now <= (until := ready.made + self._limit_s(message)):
            self.sent_on.take(src_id, ToPass(message, ready.made, until), now)

    def in_order(self, messages: ArrivingMessages, ready: Ready, late: int) -> None:
        """A message of a reliable topic for all has come out: it is kept for those who do not hear its origin."""
        if ready.payload[:1] == FRAME and ready.coded:
            return
        (number, place), after = ready.order, messages.order.before(ready)
        messages.order.passed_on[ready.topic_id] = ready.order
        origin, start = messages.src_id, messages.boot & 0xFFFF
        message = Relayed(
            origin, start, number, place, ready.topic_id, ready.hops, ready.payload, ready.coded, after=after
        )
        until = ready.made + min(self._limit_s(message), ready.limit_s)
        via = messages.src_id if ready.over is None else ready.over
        self.sent_on.take_in_order(Kept(message, ready.made, until), via, late)

    def receive(self, via: int, ready: Ready, now: float, *, withheld: bool = False) -> None:
        """A message of another robot has come over one that is heard.

        :param withheld: the packet may have been held back too long for what has to be fresh
        """
        try:
            carried = ready.topic_id == CARRIED_TOPIC
            taker, message = read_carried(ready.payload) if carried else (BROADCAST, read_relayed(ready.payload))
        except WireError as error:
            self._dropped[error.kind] += 1
            return
        origin, start, table = message.origin, message.start, message.topic_id == TABLE_TOPIC
        if withheld and not (carried or table or self._in_a_row(message)):  # these may have been under repair
            self._dropped["withheld"] += 1
            return
        neighbour = self._neighbours.all.get(origin)
        heard = None if neighbour is None or neighbour.gone else neighbour
        age_s, limit_s = age_of(message.age), age_of(message.limit)
        made = max(ready.made - age_s, now - UNKNOWN_S)
        another = heard is not None and heard.boot & 0xFFFF != start
        if (message.hops == 0) != (origin == via) or another:
            self._dropped["false_origin"] += 1
            if another:
                self._neighbours.sent_by_another_start(origin, start, made, now)
            return
        if origin == self.src_id:
            self._dropped["relayed_before"] += 1
            self.custody.handed_back(taker, message, via, now)
            return
        self.routes.note(origin, via, message.hops, ready.made)
        kept = ToPass(message, made, made + min(limit_s, self._limit_s(message)))
        if now > kept.until and not self._in_a_row(message):
            self._dropped["too_old"] += 1
            return
        order = message.number, message.place
        payload = message.payload[_BOOT_LEN * table :]
        of = Ready(message.topic_id, order, payload, -1, message.coded, False, message.hops, via, carried)
        of.made, of.sealed, of.limit_s = made, ready.sealed - age_s if ready.sealed < inf else inf, limit_s
        if table and not carried and not self._starts(message, via, now, min(made, of.sealed), heard=heard is not None):
            return
        near = heard is not None and self._robots.is_near(origin, now)
        if heard is not None and near and message.number > heard.inbox.newest:
            self._dropped["ahead"] += 1  # its next packet tells whether it has come so far
            return
        if carried:
            self._handed(taker, via, kept, of, now, near=near)
            return
        inbox = self.far.inbox(origin, start)
        topic = None if inbox is None else inbox.announced.topic_of(message)
        if inbox is None or (not table and topic is None):
            self._dropped["unknown_origin"] += 1  # not taken: who has it must not learn that it is here
            return
        inbox = self.far.begun(inbox, message.number, made)
        if topic is not None and for_all_in_order(topic):
            of.after = message.after
            self.sent_on.in_order.heard(via, Name(Stream(origin, start, topic.topic_id), order), now)
        elif not self.sent_on.take(via, kept, now):
            self._dropped["relayed_before"] += 1
            return
        self._robots.of(origin).hops = message.hops
        if message.dst_id in (BROADCAST, self.src_id):
            self._delivered(inbox, of, now)
            if table:
                self._due(inbox, now, receipts=True)

    def _handed(self, taker: int, via: int, kept: ToPass, ready: Ready, now: float, *, near: bool) -> None:
        """A message was heard that is carried to one robot.

        :param near: whether the robot that made it is heard
        """
        message = kept.message
        if message.dst_id != self.src_id:
            if taker == self.src_id:
                self.custody.take(message, via, now, made=kept.made, until=kept.until)
            return
        if message.topic_id == RECEIPT_TOPIC:
            if near and via != message.origin:
                self._dropped["false_origin"] += 1  # what it has it tells itself
                return
            try:
                self.custody.told(message.origin, read_receipts(message.payload), now)
            except WireError as error:
                self._dropped[error.kind] += 1
            return
        self._robots.of(message.origin).hops = message.hops
        inbox = self.far.inbox(message.origin, message.start)
        known = inbox is not None and message.topic_id in inbox.announced.topics
        if inbox is not None and self._carried_here.refutes(message, kept.made):
            inbox.deliveries.begin_anew(message.topic_id)
        new = self._carried_here.take(message, ready, kept.made, now, known=known)
        if not new:
            self._dropped["custody_full" if new is None else "relayed_before"] += 1
        reported = taker == self.src_id and not message.hops  # its origin learns from a report that it is here
        if inbox is not None:
            self._due(inbox, now, receipts=not reported)
        if not new and not reported:
            self._confirm(message.origin, message.start, message.topic_id)

    def _due(self, inbox: Inbox, now: float, *, receipts: bool) -> None:
        """Deliver what was carried here of a robot, as far as its turn has come."""
        for ready in self._carried_here.due(inbox.src_id, inbox.boot & 0xFFFF, inbox.announced.topics):
            self._delivered(inbox, ready, now)
            if receipts:
                self._confirm(inbox.src_id, inbox.boot & 0xFFFF, ready.topic_id)

    def _confirm(self, origin: int, start: int, topic_id: int) -> None:
        """Tell a robot what has come of one of its topics."""
        newest = self._carried_here.newest(Stream(origin, start, topic_id))
        if newest is not None:
            self.custody.receipt(origin, Receipt(start, topic_id, *newest))

    def _delivered(self, inbox: Inbox, ready: Ready, now: float) -> None:
        self.far.came(inbox, ready.order[0], ready.made, now)
        inbox.relayed(ready, now)

    def _comes_whole(self, src_id: int, topic_id: int) -> bool:
        """Whether all of a robot's messages of a topic are sent on, not the newest."""
        neighbour = self._neighbours.all.get(src_id)
        topic = None if neighbour is None else neighbour.inbox.announced.topics.get(topic_id)
        if topic is None or for_all_in_order(topic):
            return topic is not None
        return topic.reliable and (topic.dst_id != BROADCAST or topic.type_name == CALLS_TYPE)

    def _in_a_row(self, message: Relayed) -> bool:
        """Whether others wait for a message, even if it is too old."""
        inbox = self.far.inbox(message.origin, message.start)
        topic = None if inbox is None else inbox.announced.topics.get(message.topic_id)
        return topic is not None and for_all_in_order(topic)

    def _limit_s(self, message: Relayed) -> float:
        """Age in s at which a message is of no more use, as far as its table is known."""
        inbox = self.far.inbox(message.origin, message.start)
        topic = None if inbox is None else inbox.announced.topics.get(message.topic_id)
        return inf if inbox is None or topic is None else inbox.deliveries.limit_s(topic)

    def _sweep(self, now: float) -> None:
        """Forget what is too long ago."""
        self._swept = now
        for origin in self._robots.quiet(now):
            self.sent_on.drop_of(origin)
        for origin in self._robots.forget(now):
            self.far.drop(origin)
            self.sent_on.in_order.drop_of(origin, lambda _: True)
        for src_id in [src_id for src_id in self._tables if src_id not in self._neighbours.all]:
            del self._tables[src_id]

    def _table(self, src_id: int, boot: int, table: bytes, number: int, now: float) -> None:
        payload = boot.to_bytes(_BOOT_LEN, "big") + table
        self.sent_on.drop_other_starts(src_id, boot & 0xFFFF)
        message = Relayed(src_id, boot & 0xFFFF, number, 0, TABLE_TOPIC, 0, payload)
        if self.sent_on.take(src_id, ToPass(message, now, inf), now):
            self._tables[src_id] = boot, table, now

    def _starts(self, message: Relayed, via: int, now: float, made: float, *, heard: bool) -> bool:
        """Look at the table of a robot; returns whether it is that of its start, as far as this is known."""
        origin, boot = message.origin, int.from_bytes(message.payload[:_BOOT_LEN], "big")
        if len(message.payload) <= _BOOT_LEN or boot & 0xFFFF != message.start:
            self._dropped["bad_table"] += 1
            return False
        if heard:
            self._dropped["relayed_before"] += 1
            return False
        if self.far.inbox(origin, message.start) is None:
            if now > made + QUIET_S * self._robots.slower():
                self._dropped["too_old"] += 1
                return False
            known = self.far.present(origin)
            if known is not None and known.boot > boot and self.far.believes(origin, made):
                self._dropped["old_start"] += 1
                self._neighbours.sent_by_another_start(origin, boot, made, now)
                return False
            if known is not None:
                known.ended(now)
            self.far.start(origin, boot, message.number + 1, made)
            self.sent_on.drop_of(origin)
            self.sent_on.drop_other_starts(origin, message.start)
            self._robots.of(origin).met_over = now
            self._outcomes.facts.append(Reached(origin))
        if lost := self.far.hold(origin, via, len(message.payload)):
            self._dropped["max_sources"] += lost
        return True

    # ---- what leaves

    def left(self, message: Message, now: float) -> None:
        """A message leaves whole in the packet that is composed: one that was offered, or any other."""
        if message.topic_id in RELAYED:
            self.sent_on.left(message, now, self.custody.repaired_for)
        elif message.topic_id in (CARRIED_TOPIC, LONG_CARRIED):
            self.custody.left(message, now)

    def tells(self, now: float) -> list[Newest]:
        """What this robot has of others' topics, in turn: of reliable topics for all, what has not come directly."""
        told: list[Newest] = []
        for _ in range(self._tuning.gain_told):
            if not self._telling:
                self._telling.extend([None] * self.gains.others)
                self._telling.extend(self._apart(now))
            if not self._telling:
                break
            stream = self._telling.popleft()
            if stream is None:
                told += self.gains.tells(1)
            elif (inbox := self.far.inbox(stream.origin, stream.start)) is not None:
                topic = inbox.announced.topics.get(stream.topic_id)
                if topic is not None and (has := inbox.up_to(topic)) is not None:
                    told.append(Newest(stream.origin, stream.start & 0xFF, stream.topic_id, *has))
        return told

    def _apart(self, now: float) -> list[Stream]:
        """The reliable topics for all of robots that are not heard, or were not for long."""
        found = []
        for src_id in {*self._neighbours.all, *self.far.inboxes}:
            inbox, neighbour = self.far.present(src_id), self._neighbours.all.get(src_id)
            if inbox is not None:
                heard = neighbour is not None and self._robots.is_near(src_id, now)
                topics = [topic.topic_id for topic in inbox.announced.topics.values() if for_all_in_order(topic)]
                told = [topic_id for topic_id in topics if not heard or inbox.order.ahead(topic_id)]
                found += [Stream(src_id, inbox.boot & 0xFFFF, topic_id) for topic_id in told]
        return found
