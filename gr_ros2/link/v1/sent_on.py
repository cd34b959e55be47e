"""What is sent on of the messages of other robots.

Of reliable topics for all, all messages in their order (``relay.in_order``); of all others the newest of each topic
(``relay.gain``). Both compete with own messages by what they are worth. A table is of use only whole, and may take many
packets: these are repaired for ``REPAIRED_S``.

Invariant: what is kept is bounded by ``MOST_STREAMS``, ``MOST_KEPT`` and its shares of the memory; of the neighbours
that brought it, the one with most of it loses first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from math import inf
from typing import NamedTuple

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.sent_topics import RELAYED, RELAYED_IN_ORDER, RELAYED_TABLES, SentTopic, SentTopics
from gr_ros2.relay.gain import Gains, Stream
from gr_ros2.relay.in_order import COST, InOrder, Kept, Name
from gr_ros2.relay.memory import Memory
from gr_ros2.relay.quotas import Quotas
from gr_ros2.wire import QOS_DEFAULT
from gr_ros2.wire.ages import age_code
from gr_ros2.wire.relayed import MOST_HOPS, RELAYED_LEN, Relayed, write_relayed
from gr_ros2.wire.v1 import RELAYED_TOPIC, TABLE_TOPIC

MOST_STREAMS = 4096
"""Topics of other robots of which a message is kept to be sent on."""
MOST_KEPT = 4096
"""Messages of reliable topics for all that are kept to be sent on."""
_COST = 4500
"""Bytes that the newest message of a topic takes beside its payload, with what is known of who has it (measured with
``tracemalloc``)."""
REPAIRED_S = 20.0
"""s for which a table is repaired after it has left: another one follows then at the latest."""
Repaired = Callable[[int, float], bool]
"""Whether something is being repaired for a robot at a time, s."""


class ToPass(NamedTuple):
    """A message to be sent on.

    :param made: when it was made, s
    :param until: when it is of no more use, s
    """

    message: Relayed
    made: float
    until: float


class SentOn:
    """The messages of other robots that are worth sending on.

    :param gains: knows who lacks what
    :param dropped: counts what is not sent on any more
    :param memory: where both kinds of messages have a share
    :param repairs: whether lost packets are repaired
    :ivar in_order: the messages of reliable topics for all
    :ivar relayed: messages sent on, by origin and topic id
    """

    def __init__(self, gains: Gains, dropped: Counter[str], memory: Memory, tuning: Tuning, *, repairs: bool) -> None:
        self.relayed: Counter[tuple[int, int]] = Counter()
        self.in_order = InOrder(gains, Quotas(MOST_KEPT, memory.share(), COST), tuning)
        self._gains, self._dropped, self._repairs = gains, dropped, repairs
        self._newest: dict[Stream, ToPass] = {}
        self._quotas: Quotas[Stream] = Quotas(MOST_STREAMS, memory.share(), _COST)
        self._offered: dict[int, tuple[Stream, ToPass]] = {}
        """What is in a queue of the newest messages or of tables, by its id."""
        self._next: Name | None = None

    def take(self, via: int, to_pass: ToPass, now: float) -> bool:
        """Keep a message to be sent on; returns whether it is newer than what is here."""
        message = to_pass.message
        stream = Stream(message.origin, message.start, message.topic_id)
        before = self._newest.get(stream)
        if stream.topic_id == TABLE_TOPIC and before is not None and before.message.payload != message.payload:
            self._gains.changed(stream)
        if not self._gains.message(via, stream, message.number, now, to_pass.made):
            return False
        self._newest[stream] = to_pass
        for lost in self._quotas.put(stream, via, len(message.payload)):
            self._dropped["relay_full"] += 1
            self._drop(lost)
        return True

    def take_in_order(self, kept: Kept, via: int, late: int) -> None:
        """Keep a message of a reliable topic for all.

        :param late: number of messages of its topic that those get who come late
        """
        message = kept.message
        stream = Stream(message.origin, message.start, message.topic_id)
        if stream in self._newest:
            self._drop(stream)  # it came before its topic was known
        if lost := self.in_order.keep(kept, via, late):
            self._dropped["relay_full"] += lost

    def drop_of(self, origin: int, which: Callable[[Stream], bool] = lambda _: True) -> None:
        """Send no newest message on of these streams of a robot."""
        for stream in [stream for stream in self._newest if stream.origin == origin and which(stream)]:
            self._drop(stream)

    def drop_other_starts(self, origin: int, start: int) -> None:
        """Send nothing on of other starts of a robot."""
        self.drop_of(origin, lambda stream: stream.start != start)
        self.in_order.drop_of(origin, lambda stream: stream.start != start)

    def drop_above(self, origin: int, start: int, number: int, topic_ids: Collection[int]) -> None:
        """Send nothing on of a robot that has a number above this one.

        :param topic_ids: the robot's topics
        """
        self.drop_of(origin, lambda stream: self._newest[stream].message.number > number)
        for topic_id in topic_ids:
            self.in_order.drop(Stream(origin, start, topic_id), lambda order: order[0] > number)

    def offer(self, topics: SentTopics, now: float, leaves: float, room: int) -> None:
        """Let the messages that are worth most compete for the next packet, unless some are leaving.

        Their value is ``g^2 / c`` as for own messages, with g the gain per neighbour. What every neighbour is likely to
        have is not sent: repairs would wait for it, and it would have to be repaired.

        :param topics: with the queues of relayed messages
        :param leaves: when the packet leaves, s
        :param room: bytes that it has for messages
        """
        for stream in [stream for stream, to_pass in self._newest.items() if now > to_pass.until]:
            self._dropped["too_old"] += self._gains.lacks(stream, now)
            self._drop(stream)
        name, worth, gains, late = self.in_order.best(now)
        if late:
            self._dropped["too_old"] += late
        free = {topic_id for topic_id in RELAYED if _is_free(topics[topic_id], now)}
        chosen, gain = self._gains.best(
            now,
            lambda stream: self._cost(stream, now),
            gains,
            lambda stream: self._queue_of(stream) in free,
            room if self._repairs else inf,
        )
        for topic_id in free - {RELAYED_IN_ORDER}:
            self._offered.pop(topic_id, None)
        if chosen is not None:
            self._offered[self._queue_of(chosen)] = chosen, self._newest[chosen]
            self._queue(topics[self._queue_of(chosen)], self._newest[chosen], gain, now, leaves)
        if RELAYED_IN_ORDER in free:
            self._next = name
            if name is not None:
                self._queue(topics[RELAYED_IN_ORDER], self.in_order[name], worth, now, leaves)

    def left(self, message: Message, now: float, repaired_for: Callable[[Message], Repaired]) -> None:
        """A message that was offered leaves whole in the packet that is composed.

        :param repaired_for: gives what tells whether a part of it is being repaired
        """
        if message.topic_id == RELAYED_IN_ORDER and self._next is not None:
            self.in_order.sent(self._next, now, repaired_for(message))
            self.relayed[self._next.stream.origin, self._next.stream.topic_id] += 1
        table = message.topic_id == RELAYED_TABLES
        if table:
            message.lifetime.expires = now + REPAIRED_S * self._gains.robots.slower()
        if message.topic_id in self._offered:
            stream, to_pass = self._offered.pop(message.topic_id)
            self._gains.sent(stream, to_pass.message.number, now, 1.0 if table else None)
            self.relayed[stream.origin, stream.topic_id] += 1

    def _drop(self, stream: Stream) -> None:
        """Send nothing of a stream on."""
        self._newest.pop(stream, None)
        self._quotas.drop(stream)
        self._gains.drop(stream)
        self._offered = {topic_id: offered for topic_id, offered in self._offered.items() if offered[0] != stream}

    def _queue(self, topic: SentTopic, to_pass: ToPass | Kept, gain: float, now: float, leaves: float) -> None:
        message = to_pass.message
        hops = min(message.hops + 1, MOST_HOPS)
        payload = write_relayed(message._replace(hops=hops, age=age_code(leaves - to_pass.made)))
        topic.newest = now - gain / max(len(self._gains.robots.near(now)), 1)
        queued = Message(-1, topic.topic.topic_id, payload, QOS_DEFAULT, now, expires=to_pass.until, repeat=True)
        topic.queue.append(queued)

    def _queue_of(self, stream: Stream) -> int:
        """The queue of the newest message of a stream."""
        return RELAYED_TABLES if self._repairs and stream.topic_id == TABLE_TOPIC else RELAYED_TOPIC

    def _cost(self, stream: Stream, now: float) -> float:
        if stream not in self._newest or not self._gains.lacks(stream, now):
            return inf
        return RELAYED_LEN + len(self._newest[stream].message.payload)


def _is_free(topic: SentTopic, now: float) -> bool:
    """Whether another message may be put into a queue; what has not begun to leave is removed."""
    queue = topic.queue
    if queue and queue[0].started and now <= queue[0].expires:
        return False
    queue.clear()
    return True
