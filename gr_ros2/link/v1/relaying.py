"""Messages of other robots at one robot: what it holds of them, what it sends on, and what it delivers.

A robot that is not heard directly is *far*: its table of topics and its messages come over others. The table travels
like a message, as topic 240 of its origin behind the full boot number; whoever hears the origin itself sends it on
under the number that the origin has reached, again every ``TABLE_S``.

Messages of reliable topics for one robot, and calls, are carried to it (``custody``); of all others the newest of each
topic is relayed.

Invariants: a message is delivered once, whether it comes directly or over others; memory is bounded by ``MOST_FAR``
robots and the topics that they announce.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from math import inf

from gr_ros2.core.errors import WireError
from gr_ros2.link.endpoint import HeardRobot
from gr_ros2.link.events import Gone, Met
from gr_ros2.link.v1.custody import Custody
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.neighbours import Neighbours
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.link.v1.sent_topics import SentTopic
from gr_ros2.relay.gain import Gains, Stream
from gr_ros2.relay.routes import STALE_S
from gr_ros2.settings.registry import CALLS_TYPE
from gr_ros2.wire import QOS_BULK, QOS_DEFAULT
from gr_ros2.wire.control import Newest
from gr_ros2.wire.mac_block import NOBODY, Block
from gr_ros2.wire.relayed import MOST_HOPS, RELAYED_LEN, Relayed, read_carried, read_relayed, write_relayed
from gr_ros2.wire.table import write_table
from gr_ros2.wire.v1 import BROADCAST, CARRIED_TOPIC, RELAYED_TOPIC, TABLE_TOPIC

TABLE_S = 5.0
"""s after which the table of a robot that is heard is worth sending on again: some may have come since."""
MOST_FAR = 64
"""Robots that are known over others only."""
MOST_EARLY = 16
"""Messages carried to this robot that wait for the table of their origin."""
_BOOT_LEN = 8


class Relaying:
    """See the module.

    :param src_id: of this robot
    :param neighbours: the robots that are heard
    :param outcomes: takes what comes of it
    :ivar hops: over how many robots the newest message of each robot came; 0 for directly
    """

    def __init__(self, src_id: int, neighbours: Neighbours, outcomes: Outcomes) -> None:
        self.src_id = src_id
        self.hops: dict[int, int] = {}
        self.relayed: Counter[tuple[int, int]] = Counter()
        """Messages sent on, by origin and topic id."""
        self.far: dict[int, Inbox] = {}
        self.gains = Gains(src_id)
        self.custody: Custody
        self._here: dict[int, tuple[int, float]] = {}
        """Robots that are reached over others: boot number, and when something of them last came, s."""
        self._neighbours, self._outcomes, self._dropped = neighbours, outcomes, outcomes.stats.dropped
        self._newest: dict[Stream, Relayed] = {}
        self._tables: dict[int, tuple[int, bytes, float]] = {}
        """Robots that are heard: boot number, table, and when it was last worth sending on."""
        self._early = deque[tuple[Relayed, int]](maxlen=MOST_EARLY)
        self._chosen: Stream | None = None
        self.found: Callable[[int, float], None] = lambda _, __: None
        """Called with a robot that is reached over others for the first time."""
        self._make_inbox: Callable[[int, int], Inbox]

    def tell(self, make_inbox: Callable[[int, int], Inbox]) -> None:
        """Use this to make the inbox of a far robot from its id and boot number."""
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
        if table and neighbour is not None and now - at > TABLE_S:
            self._table(src_id, boot, table, neighbour.inbox.newest, now)

    def newest(self, src_id: int, newest: Newest) -> None:
        """A robot tells the newest message that it has of a topic."""
        self.gains.told(src_id, newest)

    def direct(self, src_id: int, boot: int, ready: Ready, now: float) -> None:
        """A message has come from the robot that made it."""
        number, place = ready.order
        self.hops[src_id] = 0
        if ready.topic_id == TABLE_TOPIC:
            if self._tables.get(src_id, (0, b"", 0.0))[:2] != (boot, ready.payload):
                self._table(src_id, boot, ready.payload, number, now)
            return
        if self._carried(src_id, ready.topic_id):
            return
        message = Relayed(src_id, boot & 0xFFFF, number, place, ready.topic_id, 0, ready.payload, ready.coded)
        self._take(src_id, message, now)

    def receive(self, via: int, ready: Ready, now: float) -> None:
        """A message of another robot has come over one that is heard."""
        taker = BROADCAST
        try:
            if ready.topic_id == CARRIED_TOPIC:
                taker, message = read_carried(ready.payload)
            else:
                message = read_relayed(ready.payload)
        except WireError as error:
            self._dropped[error.kind] += 1
            return
        if message.origin != self.src_id:
            self.custody.routes.note(message.origin, via, message.hops, now)
        if taker != BROADCAST:
            if message.dst_id != self.src_id:
                if taker == self.src_id:
                    self.custody.take(message, via, now)
                return
        elif not self._known(message):
            self._dropped["unknown_origin"] += 1  # It is not taken, so whoever has it does not learn that it is here.
            return
        elif not self._take(via, message, now):
            self._dropped["relayed_before"] += 1
            return
        self.hops[message.origin] = message.hops
        if message.dst_id not in (BROADCAST, self.src_id):
            return
        if message.topic_id == TABLE_TOPIC:
            self._announced(message, via, now)
        elif (inbox := self._inbox(message.origin, message.start)) is not None:
            self._delivered(inbox, message, via, now, carried=taker != BROADCAST)
        else:  # Whoever has handed it on has forgotten it by now. It waits until the table of its origin is here.
            self._dropped["unknown_origin"] += len(self._early) == MOST_EARLY
            self._early.append((message, via))

    def _delivered(self, inbox: Inbox, message: Relayed, via: int, now: float, *, carried: bool = False) -> None:
        order = message.number, message.place
        ready = Ready(message.topic_id, order, message.payload, -1, message.coded, False, message.hops, via, carried)
        self._reached(inbox, now)
        inbox.relayed(ready, now)

    def _known(self, message: Relayed) -> bool:
        """Whether a table of topics says what a message is."""
        if message.topic_id == TABLE_TOPIC or message.origin == self.src_id:
            return True
        inbox = self._inbox(message.origin, message.start)
        return inbox is not None and inbox.announced.topic_of(message) is not None

    def _reached(self, inbox: Inbox, now: float) -> None:
        """Something of a robot came over others."""
        neighbour = self._neighbours.all.get(inbox.src_id)
        known = neighbour is not None and not neighbour.gone
        if neighbour is not None:
            neighbour.timeout = None
        met = not known and self._here.get(inbox.src_id, (-1, 0.0))[0] != inbox.boot
        self._here[inbox.src_id] = inbox.boot, now
        if met:
            self._outcomes.events.append(Met(inbox.src_id, inbox.boot, hears=False))

    def reaches(self, src_id: int, boot: int, now: float) -> bool:
        """Whether a start of a robot is reached over others."""
        known, at = self._here.get(src_id, (-1, -inf))
        return known == boot and now < at + STALE_S

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
                found.append(HeardRobot(src_id, now - at, False, boot, sealed, None, 0.0, 0, topics, hops, over))
        return found

    def handle_timeout(self, now: float) -> None:
        """Give up robots of which nothing comes any more, and robots that are never heard themselves."""
        for inbox in self.far.values():
            inbox.handle_timeout(now)
        for src_id, (boot, at) in list(self._here.items()):
            if now >= at + STALE_S:
                del self._here[src_id]
                neighbour = self._neighbours.all.get(src_id)
                if neighbour is None or neighbour.gone:
                    self._outcomes.events.append(Gone(src_id, boot))

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do."""
        times = [at + STALE_S for _, at in self._here.values()]
        times += [at for inbox in self.far.values() if (at := inbox.next_timeout()) is not None]
        return min(times, default=None)

    def _carried(self, src_id: int, topic_id: int) -> bool:
        """Whether a robot's messages of a topic are handed on to the one for which they are."""
        neighbour = self._neighbours.all.get(src_id)
        topic = None if neighbour is None else neighbour.inbox.announced.topics.get(topic_id)
        return topic is not None and topic.reliable and (topic.dst_id != BROADCAST or topic.type_name == CALLS_TYPE)

    def _take(self, via: int, message: Relayed, now: float) -> bool:
        stream = Stream(message.origin, message.start, message.topic_id)
        new = self.gains.message(via, stream, message.number, now)
        if new:
            self._newest[stream] = message
        return new

    def _table(self, src_id: int, boot: int, table: bytes, number: int, now: float) -> None:
        self._tables[src_id] = boot, table, now
        payload = boot.to_bytes(_BOOT_LEN, "big") + table
        self._take(src_id, Relayed(src_id, boot & 0xFFFF, number, 0, TABLE_TOPIC, 0, payload), now)

    def _announced(self, message: Relayed, via: int, now: float) -> None:
        """The table of a far robot."""
        boot = int.from_bytes(message.payload[:_BOOT_LEN], "big")
        if len(message.payload) <= _BOOT_LEN or boot & 0xFFFF != message.start:
            self._dropped["bad_table"] += 1
            return
        inbox = self._inbox(message.origin, message.start)
        if inbox is None:
            known = self.far.get(message.origin)
            if known is not None and known.boot > boot:
                self._dropped["old_start"] += 1
                return
            if known is None and len(self.far) >= MOST_FAR:
                self._dropped["max_sources"] += 1
                return
            inbox = self.far[message.origin] = self._make_inbox(message.origin, boot)
            self.found(message.origin, now)
        self._delivered(inbox, message._replace(payload=message.payload[_BOOT_LEN:]), via, now)
        for early in [early for early in self._early if early[0].origin == message.origin]:
            self._early.remove(early)
            if early[0].start == message.start:
                self._delivered(inbox, *early, now, carried=True)
            else:
                self._dropped["unknown_origin"] += 1

    def _inbox(self, origin: int, start: int) -> Inbox | None:
        """Where messages of a start of a robot come together, directly or over others."""
        neighbour = self._neighbours.all.get(origin)
        for inbox in (None if neighbour is None else neighbour.inbox, self.far.get(origin)):
            if inbox is not None and inbox.boot & 0xFFFF == start:
                return inbox
        return None

    # ---- what leaves

    def offer(self, topic: SentTopic, now: float) -> None:
        """Let the message that is worth most compete for the next packet, unless one is leaving.

        Its value is ``g^2 / c`` as for own messages, with g the gain per neighbour. What every neighbour is likely to
        have goes after all others: there is always some such message, and long ones would wait for their turns.

        :param topic: the queue of relayed messages
        """
        if topic.queue and topic.queue[0].started:
            return
        topic.queue.clear()
        self._chosen, gain = self.gains.best(now, self._cost)
        if self._chosen is None:
            return
        message = self._newest[self._chosen]
        payload = write_relayed(message._replace(hops=min(message.hops + 1, MOST_HOPS)))
        topic.newest = now - gain / max(self.gains.neighbours(now), 1)
        qos = QOS_DEFAULT if self.gains.lacks(self._chosen, now) else QOS_BULK
        topic.queue.append(Message(-1, RELAYED_TOPIC, payload, qos, now, repeat=True))

    def _cost(self, stream: Stream) -> float:
        message = self._newest.get(stream)
        return inf if message is None else RELAYED_LEN + len(message.payload)

    def left(self, now: float) -> None:
        """The message that was offered has left whole."""
        if self._chosen is not None:
            self.gains.sent(self._chosen, now)
            self.relayed[self._chosen.origin, self._chosen.topic_id] += 1
