"""The messages that a robot keeps for others that join late, and its table of topics.

A robot that lacks one asks for it; hellos name them. While no robot reports, they are repeated.

Invariants: a message is named in hellos only after the receivers had time to get it when it was first sent; however
many ask, and whoever they are, each message takes a bounded share of the time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from zlib import crc32

from gr_ros2.link.stats import SenderStats
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.sent_topics import SentTopic, SentTopics
from gr_ros2.wire import QOS_BULK
from gr_ros2.wire.table import AnnouncedTopic, write_table
from gr_ros2.wire.v1 import TABLE_TOPIC

TABLE_FIRST = 2
"""Number of packets up to which the table of topics goes before messages."""
SETTLING_S = 1.0
"""s after which a latched message is named in hellos: a receiver that lacks it then has lost it, not just not received
it yet."""
ANSWERS, PAUSE, PAUSE_S = 3, 9, 1.0
"""A message is sent again for robots that ask once in a pause, and up to ``ANSWERS`` times at once after a time without
need. A pause is ``PAUSE`` times the time that the message took to leave, and ``PAUSE_S`` s at least. So those who join
one after the other are answered at once, and forged requests take a tenth of the time at most in the long run."""
STARTING_S = 2.0
"""s from the start during which the table is repaired even if no receiver reports; any other kept message is for so
long beyond the time that it waited."""


@dataclass(slots=True, eq=False)
class _Kept:
    """A message kept for robots that join late."""

    serial: int
    payload: bytes
    coded: bool
    mark: int
    named: float = inf
    """Time in s from which on hellos name it."""
    until: float = inf
    """Time in s until which it is sent again."""


class KeptMessages:
    """The newest messages of the topics that keep some.

    :param room: bytes of the longest body
    :param admit: puts a message into the queue of its topic
    :ivar digest: CRC-32 of the table; 0 if there is nothing to announce
    """

    def __init__(
        self,
        topics: SentTopics,
        room: int,
        settings: Settings,
        stats: SenderStats,
        admit: Callable[[SentTopic, Message], None],
    ) -> None:
        self.digest = 0
        self._topics, self._room, self._settings = topics, room, settings
        self._stats, self._admit = stats, admit
        self._kept: dict[int, deque[_Kept]] = {}
        self._answers: dict[int, tuple[float, float]] = {}
        """How often messages of each topic may be sent again because somebody asks, at a time in s."""
        self._took: dict[int, float] = {}
        """How long the newest of them took to leave, s."""
        self._starting_until = inf

    def keep(self, topic: SentTopic, message: Message) -> None:
        """Keep a new message of a topic that keeps some."""
        kept = self._kept.setdefault(message.topic_id, deque(maxlen=max(topic.kept_depth, 1)))
        until = message.submitted + min(
            inf if topic.latched else topic.topic.options.keep_s, topic.queue.deadline_s or inf, message.lifespan_s
        )
        kept.append(_Kept(message.serial, message.payload, message.coded, crc32(message.payload), until=until))

    def tabulate(self, rows: Sequence[AnnouncedTopic]) -> bool:
        """Keep the table of topics; returns whether it has changed."""
        if not rows and not self.digest:
            return False
        table, before = write_table(rows), self.digest
        self.digest = crc32(table)
        self._kept[TABLE_TOPIC] = deque([_Kept(-1, table, False, self.digest)])
        return self.digest != before

    def forget(self, topic_id: int) -> None:
        """Keep none of the messages of a topic so far."""
        self._kept.pop(topic_id, None)

    def asked(self, topic_id: int, now: float) -> bool:
        """A robot asks for the kept message of a topic; returns whether that is not too often."""
        if topic_id not in self._kept:
            return True
        pause = max(PAUSE_S * self._settings.slower, PAUSE * self._took.get(topic_id, 0.0))
        left, at = self._answers.get(topic_id, (ANSWERS, now))
        left = min(left + (now - at) / pause, ANSWERS)
        if left >= 1:
            left -= self.ask(topic_id, now)
            self._answers[topic_id] = left, now
            return True
        return False

    def ask(self, topic_id: int, now: float) -> bool:
        """Send the kept message of a topic again because a robot lacks it, unless it is waiting already; returns
        whether it is sent."""
        self._starting_until = min(self._starting_until, now + STARTING_S * self._settings.slower)
        topic = self._topics.get(topic_id)
        if topic is None or any(message.repeat for message in topic.queue):
            return False
        for kept in self._kept.get(topic_id, ()):
            if now > kept.until:
                continue
            if topic_id == TABLE_TOPIC:
                # Nothing is delivered without the table. A long table does not delay urgent messages.
                qos = 1 if len(kept.payload) <= TABLE_FIRST * self._room else 0
                topic.queue.append(Message(kept.serial, TABLE_TOPIC, kept.payload, qos, now, repeat=True))
            else:
                qos = QOS_BULK if topic.latched else topic.qos
                again = Message(
                    kept.serial, topic_id, kept.payload, qos, now, topic.weight, repeat=True, coded=kept.coded
                )
                again.dst_id = topic.dst_id
                self._admit(topic, again)
            self._stats.repeats += 1
        return True

    def announce(self, now: float) -> None:
        """Send all kept messages, for robots that cannot ask."""
        for topic_id in self._kept:
            if not self._topics[topic_id].queue:
                self.ask(topic_id, now)

    def marks(self, now: float) -> list[tuple[int, int]]:
        """What hellos name: (topic id, CRC-32) of the newest message that is kept of each topic.

        A receiver remembers no other of a topic. If hellos named older ones too, it would ask for them for ever.
        """
        return [
            (topic_id, messages[-1].mark)
            for topic_id, messages in self._kept.items()
            if topic_id != TABLE_TOPIC and messages[-1].named <= now <= messages[-1].until
        ]

    def left(self, message: Message, now: float, *, reported: bool) -> None:
        """A message has left whole.

        :param reported: whether receivers report that they have it
        """
        if message.topic_id not in self._kept:
            return
        if message.repeat:
            self._took[message.topic_id] = now - message.submitted
        for kept in self._kept[message.topic_id]:
            if kept.payload is message.payload and kept.named == inf:
                kept.named = now + SETTLING_S * self._settings.slower
        if not reported:
            # Later the table is sent again, and is small; at the start, nothing can be delivered without it.
            lifetime, waited = message.lifetime, now - message.submitted
            again = STARTING_S * self._settings.slower
            table = message.topic_id == TABLE_TOPIC
            lifetime.expires = self._starting_until if table else min(lifetime.expires, now + 2 * waited + again)
