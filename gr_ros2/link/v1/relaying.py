"""Messages of other robots at one robot: what it holds of them, what it sends on, and what it delivers.

A robot that is not heard directly is *far*: its table of topics and its messages come over others. The table travels
like a message, as topic 240 of its origin behind the full boot number; whoever hears the origin itself sends it on
under the number that the origin has reached, again every ``TABLE_S``.

Messages of reliable topics for one robot, and calls, are carried to it (``custody``). Of reliable topics for all, all
messages are relayed to those who do not hear their origin, in their order, once they have come out here
(``relay.in_order``); of all others the newest of each topic.

A message has an age, which grows at every robot. Where its table is known, a robot sends nothing on that is older than
its topic allows. All that a start of a robot has said is forgotten ``FORGET_S`` after it was last there.

*Trust.* Which start a robot is in, its table and how far it is come from it alone as long as it is heard. Of a robot
that is not heard, a number or a start that came over others counts until the robot itself says less, or until something
with a lower one was made ``EXPIRES_S`` after it came. Repairs tell nothing of that, since they may be sent long after
what is in them.

Invariants: a message is delivered once, whether it comes directly or over others; what is sent on is bounded by
``MOST_STREAMS`` and ``max_source_bytes``, and of the neighbours that brought it, the one with most of it loses first.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from math import inf
from typing import NamedTuple

from gr_ros2.core.errors import WireError
from gr_ros2.link.endpoint import HeardRobot
from gr_ros2.link.events import Gone, Met
from gr_ros2.link.fates import Fate
from gr_ros2.link.message_codec import FRAME
from gr_ros2.link.v1.custody import Custody
from gr_ros2.link.v1.delivery import UNKNOWN_S, for_all_in_order
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.neighbours import Neighbour, Neighbours
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.link.v1.sent_topics import RELAYED_IN_ORDER, SentTopic, SentTopics
from gr_ros2.link.v1.sequences import Sequences
from gr_ros2.relay.gain import EXPIRES_S, TOLD, Gains, Stream
from gr_ros2.relay.in_order import InOrder, Kept, Name
from gr_ros2.relay.rooms import Rooms
from gr_ros2.settings.registry import CALLS_TYPE
from gr_ros2.wire import QOS_DEFAULT
from gr_ros2.wire.ages import age_code, age_of
from gr_ros2.wire.control import Newest
from gr_ros2.wire.mac_block import NOBODY, Block
from gr_ros2.wire.relayed import (
    MOST_HOPS,
    RECEIPT_TOPIC,
    RELAYED_LEN,
    Receipt,
    Relayed,
    read_carried,
    read_receipts,
    read_relayed,
    write_relayed,
)
from gr_ros2.wire.table import write_table
from gr_ros2.wire.v1 import BROADCAST, CARRIED_TOPIC, RELAYED_TOPIC, TABLE_TOPIC

TABLE_S = 5.0
"""s after which the table of a robot that is heard is worth sending on again: some may have come since."""
MOST_STREAMS = 4096
"""Topics of other robots of which a message is kept to be sent on."""
MOST_KEPT = 4096
"""Messages of reliable topics for all that are kept to be sent on."""
FORGET_S = 60.0
"""s after which nothing of a robot is sent on any more: its table comes every ``TABLE_S`` from who hears it."""
FAR_S = 600.0
"""s after which a robot that is known over others only is forgotten, and with it what has come of it."""
_BOOT_LEN = 8


class _ToPass(NamedTuple):
    """A message to be sent on.

    :param made: when it was made, s
    :param until: when it is of no more use, s
    """

    message: Relayed
    made: float
    until: float


class Relaying:
    """See the module.

    :param src_id: of this robot
    :param neighbours: the robots that are heard
    :param outcomes: takes what comes of it
    :param most: bytes of messages that are kept to be sent on, of those carried here that wait, and of far tables
    :param slower: see :class:`gr_ros2.relay.gain.Gains`
    :ivar hops: over how many robots the newest message of each robot came; 0 for directly
    """

    def __init__(
        self, src_id: int, neighbours: Neighbours, outcomes: Outcomes, *, most: int, slower: Callable[[], float]
    ) -> None:
        self.src_id = src_id
        self.hops: dict[int, int] = {}
        self.relayed: Counter[tuple[int, int]] = Counter()
        """Messages sent on, by origin and topic id."""
        self.far: dict[int, Inbox] = {}
        """Robots that are or were known over others only."""
        self.gains = Gains(src_id, slower)
        self.custody: Custody
        self._here: dict[int, tuple[int, float]] = {}
        """Robots that are reached over others: boot number, and when something of them last came, s."""
        self._neighbours, self._outcomes, self._dropped = neighbours, outcomes, outcomes.stats.dropped
        self._newest: dict[Stream, _ToPass] = {}
        self._rooms: Rooms[Stream] = Rooms(MOST_STREAMS, most)
        self._in_order = InOrder(self.gains, Rooms(MOST_KEPT, most))
        self._next: Name | None = None
        self._telling = deque[Stream | None]()
        """What is told next: a reliable topic for all, or None for the newest message of the next of the others."""
        self._far_rooms: Rooms[int] = Rooms(BROADCAST, most)
        self._first_made: dict[int, float] = {}
        """When that was made with which each start in ``far`` began, s."""
        self._there: dict[int, float] = {}
        """When a robot was there last, s."""
        self._came: dict[int, float] = {}
        """When something of its present start came over others, s."""
        self._swept = 0.0
        self.ahead: set[int] = set()
        """Robots of which a message came over others with a number that they had not reached themselves."""
        self._tables: dict[int, tuple[int, bytes, float]] = {}
        """Robots that are heard: boot number, table, and when it was last worth sending on."""
        self._carried_here = Sequences[Ready](most)
        self._chosen: Stream | None = None
        self.found: Callable[[int, float], None] = lambda _, __: None
        """Called with a robot that is reached over others for the first time."""
        self._make_inbox: Callable[[int, int, int], Inbox]

    def tell(self, make_inbox: Callable[[int, int, int], Inbox]) -> None:
        """Use this to make the inbox of a far robot from its id, its boot number and the first packet that counts."""
        self._make_inbox = make_inbox

    # ---- what arrives

    def heard(self, src_id: int, block: Block | None, now: float) -> None:
        """A packet of a robot was heard.

        :param block: tells whom that robot hears
        """
        names = () if block is None else [name for name in block.names if name != NOBODY]
        self.gains.neighbour(src_id, now, names, 0 if block is None else block.heard)
        self.custody.routes.note(src_id, src_id, 0, now)
        neighbour = self._neighbours.all.get(src_id)
        boot, table, at = self._tables.get(src_id, (0, b"", now))
        if neighbour is not None and not neighbour.hello.digest and boot != neighbour.boot:
            boot, table, at = neighbour.boot, write_table(()), -inf  # others learn that it is there, and where
        self._there[src_id] = now
        if table and neighbour is not None and now - at > TABLE_S * self.gains.slower():
            self._table(src_id, boot, table, neighbour.inbox.newest, now)
        if now > self._swept + TABLE_S:
            self._sweep(now)

    def met(self, neighbour: Neighbour, now: float) -> None:
        """A robot is heard: what is known of its start over others goes on there, and no other start is known. It may
        bring what is missing of others."""
        src_id = neighbour.src_id
        if (far := self.far.get(src_id)) is not None:
            if far.boot == neighbour.boot:
                neighbour.inbox.adopt(far)
                self.ahead.add(src_id)
            self._forget(src_id, Fate.SENDER_RESTARTED)
        for inbox in self.far.values():
            inbox.order.wait_anew(now)

    def reached(self, neighbour: Neighbour, number: int) -> None:
        """A robot itself has reached this number: whoever has said more was wrong."""
        src_id = neighbour.src_id
        if src_id in self.ahead and number >= neighbour.inbox.newest:
            if neighbour.inbox.overrule(number):
                self.ahead.discard(src_id)
            self._drop_of(src_id, lambda stream: self._newest[stream].message.number > number)
            for topic_id in neighbour.inbox.announced.topics:
                stream = Stream(src_id, neighbour.boot & 0xFFFF, topic_id)
                self._in_order.drop(stream, lambda order: order[0] > number)

    def newest(self, src_id: int, newest: Newest, now: float) -> None:
        """A robot tells the newest message that it has of a topic."""
        if newest.place is None:
            self.gains.told(src_id, newest)
        else:
            self._in_order.told(src_id, newest, now)

    def started(self, before: Neighbour, now: float) -> None:
        """A robot that is heard has started again: it has nothing of what it had. Until its new start is proven, what
        others bring of the one before goes on where that was."""
        src_id = before.src_id
        self.gains.started(src_id)
        self._in_order.started(src_id)
        if before.proven and src_id not in self.far:
            self.far[src_id] = before.inbox
            self._there.setdefault(src_id, now)

    def direct(self, src_id: int, boot: int, ready: Ready, now: float) -> None:
        """A message has come from the robot that made it."""
        number, place = ready.order
        self.hops[src_id] = 0
        if ready.topic_id == TABLE_TOPIC:
            if (inbox := self._inbox(src_id, boot & 0xFFFF)) is not None:
                self._due(inbox, now, receipts=True)
            if self._tables.get(src_id, (0, b"", 0.0))[:2] != (boot, ready.payload):
                self._table(src_id, boot, ready.payload, number, now)
            return
        if ready.payload[:1] == FRAME and ready.coded:
            return  # a chain of frames is not passed on: who lacks one of them would have no use for the others
        if self._comes_whole(src_id, ready.topic_id):
            return
        message = Relayed(src_id, boot & 0xFFFF, number, place, ready.topic_id, 0, ready.payload, ready.coded)
        if now <= (until := ready.made + self._limit_s(message)):
            self._take(src_id, _ToPass(message, ready.made, until), now)

    def in_order(self, inbox: Inbox, ready: Ready, late: int) -> None:
        """A message of a reliable topic for all has come out: it is kept for those who do not hear its origin."""
        if ready.payload[:1] == FRAME and ready.coded:
            return
        (number, place), after = ready.order, inbox.order.before(ready)
        inbox.order.passed_on[ready.topic_id] = ready.order
        stream = Stream(inbox.src_id, inbox.boot & 0xFFFF, ready.topic_id)
        if stream in self._newest:
            self._drop(stream)  # it came before its topic was known
        message = Relayed(
            *stream[:2], number, place, ready.topic_id, ready.hops, ready.payload, ready.coded, after=after
        )
        until = ready.made + min(self._limit_s(message), ready.limit_s)
        via = inbox.src_id if ready.over is None else ready.over
        if lost := self._in_order.keep(Kept(message, ready.made, until), via, late):
            self._dropped["relay_full"] += lost

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
        if withheld and not (carried or self._in_a_row(message)):  # what comes in a row may have been under repair
            self._dropped["withheld"] += 1
            return
        origin, start = message.origin, message.start
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
            return
        self.custody.routes.note(origin, via, message.hops, ready.made)
        kept = _ToPass(message, made, made + min(limit_s, self._limit_s(message)))
        if now > kept.until and not self._in_a_row(message):
            self._dropped["too_old"] += 1
            return
        order, table = (message.number, message.place), message.topic_id == TABLE_TOPIC
        payload = message.payload[_BOOT_LEN * table :]
        of = Ready(message.topic_id, order, payload, -1, message.coded, False, message.hops, via, carried)
        of.made, of.sealed, of.limit_s = made, ready.sealed - age_s if ready.sealed < inf else inf, limit_s
        if table and not carried and not self._starts(message, via, now, made, heard=heard is not None):
            return
        near = heard is not None and self.gains.near(heard.heard, now)
        if heard is not None and near and message.number > heard.inbox.newest:
            self._dropped["ahead"] += 1  # its next packet tells whether it has come so far
            return
        if carried:
            self._handed(taker, via, kept, of, now, near=near)
            return
        inbox = self._inbox(origin, start)
        topic = None if inbox is None else inbox.announced.topic_of(message)
        if inbox is None or (not table and topic is None):
            self._dropped["unknown_origin"] += 1  # not taken: who has it must not learn that it is here
            return
        inbox = self._begun(inbox, message.number, made)
        if topic is not None and for_all_in_order(topic):
            of.after = message.after
            self._in_order.heard(via, Name(Stream(origin, start, topic.topic_id), order), now)
        elif not self._take(via, kept, now):
            self._dropped["relayed_before"] += 1
            return
        self.hops[origin] = message.hops
        if message.dst_id in (BROADCAST, self.src_id):
            self._delivered(inbox, of, now)
            if table:
                self._due(inbox, now, receipts=True)

    def _handed(self, taker: int, via: int, kept: _ToPass, ready: Ready, now: float, *, near: bool) -> None:
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
        self.hops[message.origin] = message.hops
        new = self._carried_here.take(message, ready, kept.made, now)
        if not new:
            self._dropped["custody_full" if new is None else "relayed_before"] += 1
        reported = taker == self.src_id and not message.hops  # its origin learns from a report that it is here
        if (inbox := self._inbox(message.origin, message.start)) is not None:
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
        neighbour = self._neighbours.all.get(inbox.src_id)
        if neighbour is not None and ready.order[0] > neighbour.inbox.newest:
            self.ahead.add(inbox.src_id)
        self._reached(inbox, ready.made, now)
        inbox.relayed(ready, now)

    def _reached(self, inbox: Inbox, made: float, now: float) -> None:
        """Something of a robot came over others."""
        self._came[inbox.src_id] = now
        self._there[inbox.src_id] = max(self._there.get(inbox.src_id, -inf), made)
        boot, at = self._here.get(inbox.src_id, (-1, -inf))
        at = max(made, at if boot == inbox.boot else -inf)
        if now >= at + self.custody.routes.stale_s:
            return  # it was there when that was made, which is too long ago
        neighbour = self._neighbours.all.get(inbox.src_id)
        known = neighbour is not None and not neighbour.gone
        if neighbour is not None:
            neighbour.timeout = None
        self._here[inbox.src_id] = inbox.boot, at
        if boot != inbox.boot and not known:
            self._outcomes.events.append(Met(inbox.src_id, inbox.boot, hears=False))

    def reaches(self, src_id: int, boot: int, now: float) -> bool:
        """Whether a start of a robot is reached over others."""
        known, at = self._here.get(src_id, (-1, -inf))
        return known == boot and now < at + self.custody.routes.stale_s

    def robots(self, now: float, *, sealed: bool) -> list[HeardRobot]:
        """The robots that are not heard, but reached over others.

        :param sealed: whether packets are sealed
        """
        found = []
        for src_id, (boot, at) in self._here.items():
            neighbour, inbox = self._neighbours.all.get(src_id), self._inbox(src_id, boot & 0xFFFF)
            if inbox is not None and (neighbour is None or neighbour.gone):
                hops, over = self.hops.get(src_id, 0), self.custody.routes.over(src_id, now, lambda _: True)
                topics = len(inbox.announced.topics)
                two = self._neighbours.doubled(src_id, now)
                found.append(HeardRobot(src_id, now - at, False, boot, sealed, None, 0.0, 0, topics, hops, over, two))
        return found

    def handle_timeout(self, now: float) -> None:
        """Give up robots of which nothing comes any more, and robots that are never heard themselves."""
        for inbox in self.far.values():
            inbox.handle_timeout(now)
        stale_s = self.custody.routes.stale_s
        for src_id, (boot, at) in list(self._here.items()):
            if now >= at + stale_s:
                del self._here[src_id]
                neighbour = self._neighbours.all.get(src_id)
                if neighbour is None or neighbour.gone:
                    self._outcomes.events.append(Gone(src_id, boot))

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do."""
        stale_s = self.custody.routes.stale_s
        times = [at + stale_s for _, at in self._here.values()]
        times += [at for inbox in self.far.values() if (at := inbox.next_timeout()) is not None]
        return min(times, default=None)

    def _comes_whole(self, src_id: int, topic_id: int) -> bool:
        """Whether all of a robot's messages of a topic are sent on, not the newest."""
        neighbour = self._neighbours.all.get(src_id)
        topic = None if neighbour is None else neighbour.inbox.announced.topics.get(topic_id)
        if topic is None or for_all_in_order(topic):
            return topic is not None
        return topic.reliable and (topic.dst_id != BROADCAST or topic.type_name == CALLS_TYPE)

    def _take(self, via: int, kept: _ToPass, now: float) -> bool:
        """Keep a message to be sent on; returns whether it is newer than what is here."""
        message = kept.message
        stream = Stream(message.origin, message.start, message.topic_id)
        if not self.gains.message(via, stream, message.number, now, kept.made):
            return False
        self._newest[stream] = kept
        for lost in self._rooms.put(stream, via, len(message.payload)):
            self._dropped["relay_full"] += 1
            self._drop(lost)
        return True

    def _drop(self, stream: Stream) -> None:
        """Send nothing of a stream on."""
        self._newest.pop(stream, None)
        self._rooms.drop(stream)
        self.gains.drop(stream)
        if stream == self._chosen:
            self._chosen = None

    def _in_a_row(self, message: Relayed) -> bool:
        """Whether others wait for a message, even if it is too old."""
        inbox = self._inbox(message.origin, message.start)
        topic = None if inbox is None else inbox.announced.topics.get(message.topic_id)
        return topic is not None and for_all_in_order(topic)

    def _limit_s(self, message: Relayed) -> float:
        """Age in s at which a message is of no more use, as far as its table is known."""
        inbox = self._inbox(message.origin, message.start)
        topic = None if inbox is None else inbox.announced.topics.get(message.topic_id)
        return inf if inbox is None or topic is None else inbox.deliveries.limit_s(topic)

    def _sweep(self, now: float) -> None:
        """Forget what is too long ago."""
        self._swept = now
        for origin, at in list(self._there.items()):
            if now > at + FORGET_S * self.gains.slower():
                self._drop_of(origin, lambda _: True)
            if now > max(at, self._came.get(origin, at)) + FAR_S:
                self._in_order.drop_of(origin, lambda _: True)
                del self._there[origin]
                self._came.pop(origin, None)
                self._forget(origin, Fate.GIVEN_UP)
        for src_id in [src_id for src_id in self._tables if src_id not in self._neighbours.all]:
            del self._tables[src_id]

    def _forget(self, origin: int, reason: Fate) -> None:
        """A start of a robot that was known over others is over."""
        self._far_rooms.drop(origin)
        self._first_made.pop(origin, None)
        if (inbox := self.far.pop(origin, None)) is not None:
            inbox.close(reason)

    def _table(self, src_id: int, boot: int, table: bytes, number: int, now: float) -> None:
        self._tables[src_id] = boot, table, now
        payload = boot.to_bytes(_BOOT_LEN, "big") + table
        self._drop_of(src_id, lambda stream: stream.start != boot & 0xFFFF)
        self._in_order.drop_of(src_id, lambda stream: stream.start != boot & 0xFFFF)
        self._take(src_id, _ToPass(Relayed(src_id, boot & 0xFFFF, number, 0, TABLE_TOPIC, 0, payload), now, inf), now)

    def _drop_of(self, origin: int, over: Callable[[Stream], bool]) -> None:
        """Send nothing on of these streams of a robot."""
        for stream in [stream for stream in self._newest if stream.origin == origin and over(stream)]:
            self._drop(stream)

    def _starts(self, message: Relayed, via: int, now: float, made: float, *, heard: bool) -> bool:
        """Look at the table of a robot; returns whether it is that of its start, as far as this is known."""
        origin, boot = message.origin, int.from_bytes(message.payload[:_BOOT_LEN], "big")
        if len(message.payload) <= _BOOT_LEN or boot & 0xFFFF != message.start:
            self._dropped["bad_table"] += 1
            return False
        if heard:
            self._dropped["relayed_before"] += 1
            return False
        if self._inbox(origin, message.start) is None:
            if now > made + FORGET_S * self.gains.slower():
                self._dropped["too_old"] += 1
                return False
            known, neighbour = self.present(origin), self._neighbours.all.get(origin)
            if known is not None and known.boot > boot and made <= self._came_at(origin) + EXPIRES_S:
                self._dropped["old_start"] += 1
                self._neighbours.sent_by_another_start(origin, boot, made, now)
                return False
            if known is not None:
                known.ended(now)
            self._forget(origin, Fate.SENDER_RESTARTED)
            self._drop_of(origin, lambda _: True)
            self._in_order.drop_of(origin, lambda stream: stream.start != message.start)
            if neighbour is None or neighbour.boot != boot or not neighbour.proven:
                self.far[origin] = self._make_inbox(origin, boot, message.number + 1)
                self._first_made[origin] = made
            self._neighbours.met_over_others(origin, now)
            self.found(origin, now)
        if origin in self.far:
            for lost in self._far_rooms.put(origin, via, len(message.payload)):
                self._dropped["max_sources"] += 1
                self._forget(lost, Fate.MEMORY)
        return True

    def _begun(self, inbox: Inbox, number: int, made: float) -> Inbox:
        """Where a message goes. The number with which its start began over others was false if the message has a lower
        one and was made much later; this robot would say for ever that it has all up to there."""
        origin = inbox.src_id
        if number >= inbox.first - 1 or made <= self._first_made.get(origin, inf) + EXPIRES_S:
            return inbox
        anew = self.far[origin] = self._make_inbox(origin, inbox.boot, number + 1)
        anew.adopt(inbox)
        self._first_made[origin] = made
        return anew

    def _inbox(self, origin: int, start: int) -> Inbox | None:
        """Where messages of a start of a robot come together, directly or over others; None for one that is not the
        present start."""
        inbox = self.present(origin)
        return None if inbox is None or inbox.boot & 0xFFFF != start else inbox

    def _came_at(self, origin: int) -> float:
        """When something of the present start of a robot came, s."""
        neighbour = self._neighbours.all.get(origin)
        heard = -inf if neighbour is None or not neighbour.proven else neighbour.heard
        return max(heard, self._came.get(origin, -inf))

    def present(self, origin: int) -> Inbox | None:
        """The inbox of the present start of a robot: that of one that is heard, or else the latest that is known."""
        neighbour, far = self._neighbours.all.get(origin), self.far.get(origin)
        if neighbour is None or not neighbour.proven:
            return far
        return neighbour.inbox if far is None or not neighbour.gone or neighbour.boot >= far.boot else far

    # ---- what leaves

    def offer(self, topics: SentTopics, now: float, leaves: float) -> None:
        """Let the messages that are worth most compete for the next packet, unless some are leaving.

        Their value is ``g^2 / c`` as for own messages, with g the gain per neighbour. What every neighbour is likely to
        have is not sent: repairs would wait for it, and it would have to be repaired.

        :param topics: with the queues of relayed messages
        :param leaves: when the packet leaves, s
        """
        for stream in [stream for stream, kept in self._newest.items() if now > kept.until]:
            self._dropped["too_old"] += self.gains.lacks(stream, now)
            self._drop(stream)
        name, worth, gains, late = self._in_order.best(now)
        if late:
            self._dropped["too_old"] += late
        chosen, gain = self.gains.best(now, lambda stream: self._cost(stream, now), gains)
        queue = topics[RELAYED_TOPIC].queue
        if not (queue and queue[0].started and now <= queue[0].expires):
            queue.clear()
            self._chosen = chosen
            if chosen is not None:
                self._queue(topics[RELAYED_TOPIC], self._newest[chosen], gain, now, leaves)
        queue = topics[RELAYED_IN_ORDER].queue
        if not (queue and queue[0].started and now <= queue[0].expires):
            queue.clear()
            self._next = name
            if name is not None:
                self._queue(topics[RELAYED_IN_ORDER], self._in_order[name], worth, now, leaves)

    def _queue(self, topic: SentTopic, to_pass: _ToPass | Kept, gain: float, now: float, leaves: float) -> None:
        message = to_pass.message
        hops = min(message.hops + 1, MOST_HOPS)
        payload = write_relayed(message._replace(hops=hops, age=age_code(leaves - to_pass.made)))
        topic.newest = now - gain / max(self.gains.neighbours(now), 1)
        queued = Message(-1, topic.topic.topic_id, payload, QOS_DEFAULT, now, expires=to_pass.until, repeat=True)
        topic.queue.append(queued)

    def _cost(self, stream: Stream, now: float) -> float:
        if stream not in self._newest or not self.gains.lacks(stream, now):
            return inf
        return RELAYED_LEN + len(self._newest[stream].message.payload)

    def left(self, message: Message, now: float) -> None:
        """A message that was offered leaves whole in the packet that is composed."""
        if message.topic_id == RELAYED_IN_ORDER and self._next is not None:
            self._in_order.sent(self._next, now, self.custody.repaired_for(message))
            self.relayed[self._next.stream.origin, self._next.stream.topic_id] += 1
        elif message.topic_id == RELAYED_TOPIC and self._chosen is not None:
            self.gains.sent(self._chosen, now)
            self.relayed[self._chosen.origin, self._chosen.topic_id] += 1

    def tells(self, now: float) -> list[Newest]:
        """What this robot has of others' topics, in turn: of reliable topics for all, what it does not hear itself."""
        told: list[Newest] = []
        for _ in range(TOLD):
            if not self._telling:
                self._telling.extend([None] * self.gains.others)
                self._telling.extend(self._apart(now))
            if not self._telling:
                break
            stream = self._telling.popleft()
            if stream is None:
                told += self.gains.tells(1)
            elif (inbox := self._inbox(stream.origin, stream.start)) is not None:
                topic = inbox.announced.topics.get(stream.topic_id)
                if topic is not None and (has := inbox.up_to(topic)) is not None:
                    told.append(Newest(stream.origin, stream.start & 0xFF, stream.topic_id, *has))
        return told

    def _apart(self, now: float) -> list[Stream]:
        """The reliable topics for all of robots that are not heard."""
        found = []
        for src_id in {*self._neighbours.all, *self.far}:
            inbox, neighbour = self.present(src_id), self._neighbours.all.get(src_id)
            if inbox is not None and not (neighbour is not None and self.gains.near(neighbour.heard, now)):
                topics = [topic.topic_id for topic in inbox.announced.topics.values() if for_all_in_order(topic)]
                found += [Stream(src_id, inbox.boot & 0xFFFF, topic_id) for topic_id in topics]
        return found
