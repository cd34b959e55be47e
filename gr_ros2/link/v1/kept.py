"""The messages that a robot keeps for others that join late, and its table of topics, one message per row.

A robot that lacks one asks for it; hellos name them. While no robot reports, they are repeated. Fragments of a repeat
complete those that came before: a robot that came while a message was under way gets its beginning alone.

Invariants: a message is named in hellos only after the receivers had time to get it when it was first sent; however
many ask, and whoever they are, each message takes a bounded share of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from math import inf
from zlib import crc32

from gr_ros2.link.instances import ALL, Keys, replaced
from gr_ros2.link.stats import SenderStats
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.packing import ENTRY
from gr_ros2.link.v1.sent_topics import SentTopic, SentTopics
from gr_ros2.wire import QOS_BULK, QOS_DEFAULT, QOS_LATENCY
from gr_ros2.wire.table import AnnouncedTopic, write_table
from gr_ros2.wire.v1 import TABLE_TOPIC


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
    keys: Keys = ALL
    """The instances that it speaks of."""
    made: float = 0.0
    """When it was submitted, s."""
    begin: int = 0
    """The packet in which its first fragment left for the first time; 0 if it left whole."""
    missed: dict[int, int] = field(default_factory=dict)
    """How many of its bytes had left when a robot came, by the robot, until it asks."""


class KeptMessages:
    """The newest messages of the topics that keep some.

    :param room: bytes of the longest body
    :param admit: puts a message into the queue of its topic
    :ivar digest: sum of the marks of the table's rows; 0 if there is nothing to announce
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
        self._topics, self._room = topics, room
        self._settings, self._tuning = settings, settings.tuning
        self._stats, self._admit = stats, admit
        self._kept: dict[int, list[_Kept]] = {}
        self._rows: dict[int, _Kept] = {}
        """The rows of the table by topic id."""
        self._answers: dict[int, tuple[float, float]] = {}
        """How often messages of each topic may be sent again because somebody asks, at a time in s."""
        self._starting_until = inf

    def keep(self, topic: SentTopic, message: Message) -> None:
        """Keep a new message of a topic that keeps some."""
        kept = self._kept.setdefault(message.topic_id, [])
        until = message.submitted + min(
            inf if topic.latched else topic.topic.options.keep_s, topic.queue.deadline_s or inf, message.lifespan_s
        )
        for old in replaced(kept, message.keys) if message.keys else ():
            kept.remove(old)
        mark = crc32(message.payload)
        kept.append(
            _Kept(
                message.serial,
                message.payload,
                message.coded,
                mark,
                until=until,
                keys=message.keys,
                made=message.submitted,
            )
        )
        del kept[: -max(topic.kept_depth, 1)]

    def tabulate(self, rows: Sequence[AnnouncedTopic]) -> bool:
        """Keep the rows of the table of topics; returns whether one has changed."""
        table = {topic_id: AnnouncedTopic(topic_id, "", "") for topic_id in self._rows}
        table |= {row.topic_id: row for row in rows}
        written = {topic_id: write_table((row,)) for topic_id, row in table.items()}
        before = {topic_id: kept.payload for topic_id, kept in self._rows.items()}
        for topic_id, row in written.items():
            if row != before.get(topic_id):
                self._rows[topic_id] = _Kept(-1, row, False, crc32(row))
        self.digest = sum(kept.mark for kept in self._rows.values()) & 0xFFFF_FFFF
        return written != before

    @property
    def table_packets(self) -> float:
        """Packets that the table of topics takes."""
        return self._packets(TABLE_TOPIC)

    def _packets(self, topic_id: int) -> float:
        """Packets that all take which are kept of a topic."""
        return sum(len(kept.payload) + ENTRY for kept in self._of(topic_id)) / self._room

    def forget(self, topic_id: int) -> None:
        """Keep none of the messages of a topic so far."""
        self._kept.pop(topic_id, None)

    def meet(self, robot: int) -> None:
        """A robot comes; of what is under way it hears the rest."""
        for topic_id, messages in self._kept.items():
            queue = self._topics[topic_id].queue
            head = next(iter(queue), None)
            for kept in messages:
                kept.missed.pop(robot, None)
                if head is not None and head.started and head.serial == kept.serial and not head.begins:
                    kept.missed[robot] = head.offset

    def asked(self, topic_id: int, now: float, interval_s: float = 0.0, *, robot: int = -1, anew: bool = False) -> bool:
        """A robot asks for the kept message of a topic; returns whether that is not too often.

        :param interval_s: s from one packet of this robot to the next; 0 = not known
        :param robot: which robot asks; -1 = not known
        :param anew: it has nothing of it. Otherwise rows of the table that wait may be those that it lacks
        """
        if topic_id == TABLE_TOPIC and not anew and self._topics[TABLE_TOPIC].queue and self._settings.turns_are_rare:
            return True
        if not self._of(topic_id):
            return True
        tuning = self._tuning
        air_s = self._packets(topic_id) * interval_s
        pause = max(tuning.kept_pause_s * self._settings.slower, tuning.kept_pause * air_s)
        left, at = self._answers.get(topic_id, (tuning.kept_answers, now))
        left = min(left + (now - at) / pause, tuning.kept_answers)
        if left >= 1:
            left -= self._tell_anew(now) if topic_id == TABLE_TOPIC else self.ask(topic_id, now, robot)
            self._answers[topic_id] = left, now
            return True
        return False

    def tell(self, now: float) -> None:
        """Send the rows of the table that have not left yet, and none of before."""
        queue, rows = self._topics[TABLE_TOPIC].queue, {row.payload: row for row in self._rows.values()}
        for message in [message for message in queue if not message.started and message.payload not in rows]:
            queue.remove(message)
        waiting = {message.payload for message in queue}
        new = [row for row in rows.values() if row.named == inf and row.payload not in waiting]
        self._send_rows(new, self._table_qos, now)

    def untold(self, now: float) -> None:
        """Send all rows of the table as if none had left: somebody is heard who may have heard none, or nobody is."""
        for row in self._rows.values():
            row.named = inf
        self._tell_anew(now)

    def _tell_anew(self, now: float) -> bool:
        """Send all rows of the table: those that wait already, then first those of topics whose messages wait; returns
        whether there are any."""
        self._starting_until = min(self._starting_until, now + self._tuning.kept_starting_s * self._settings.slower)
        queue = self._topics[TABLE_TOPIC].queue
        leaving = set[bytes]()
        for message in queue:
            message.qos = self._table_qos
            leaving.add(message.payload)
        waits = {topic_id for topic_id, topic in self._topics.items() if topic.queue}
        rows = [self._rows[topic_id] for topic_id in sorted(self._rows, key=lambda topic_id: topic_id not in waits)]
        self._send_rows([row for row in rows if row.payload not in leaving], self._table_qos, now)
        return bool(rows)

    def ask(self, topic_id: int, now: float, robot: int = -1, *, fills: bool = False) -> bool:
        """Send the kept message of a topic again because a robot lacks it, unless it is waiting already; returns
        whether it is sent.

        :param robot: which robot; what it missed of messages that were under way when it came is enough at first
        :param fills: the table takes only room that nothing else needs
        """
        self._starting_until = min(self._starting_until, now + self._tuning.kept_starting_s * self._settings.slower)
        topic = self._topics.get(topic_id)
        if topic is None:
            return False
        if topic.coded:
            return True  # whoever codes it makes a key frame
        if topic_id == TABLE_TOPIC and not fills:
            for message in topic.queue:
                message.qos = self._table_qos
        messages = self._kept.get(topic_id, ())
        missed = {kept.serial: kept.missed.pop(robot) for kept in messages if robot in kept.missed}
        if any(message.repeat for message in topic.queue):
            self._lengthen(topic, missed)
            return False
        if topic_id == TABLE_TOPIC:
            self._send_rows(self._rows.values(), QOS_BULK if fills else self._table_qos, now)
            return True
        qos = QOS_BULK if topic.latched else topic.qos
        waiting = {message.serial for message in topic.queue}
        for kept in messages:
            if now > kept.until or kept.serial in waiting or (missed and kept.serial not in missed):
                continue
            payload = kept.payload[: missed[kept.serial]] if missed else kept.payload
            again = Message(kept.serial, topic_id, payload, qos, now, topic.weight, kept.until - now)
            again.begins = len(payload) < len(kept.payload)
            again.repeat, again.coded, again.published = True, kept.coded, kept.made
            again.begin, again.dst_id, again.keys = kept.begin, topic.dst_id, kept.keys
            self._admit(topic, again)
            self._stats.repeats += 1
        return True

    def _lengthen(self, topic: SentTopic, missed: dict[int, int]) -> None:
        """Another robot has missed more of a message whose beginning is sent again."""
        for kept in self._kept.get(topic.topic.topic_id, ()):
            for message in topic.queue:
                if message.begins and message.serial == kept.serial:
                    message.payload = kept.payload[: max(len(message.payload), missed.get(kept.serial, 0))]

    @property
    def _table_qos(self) -> int:
        # Nothing is delivered without the table. A long one does not delay urgent messages.
        return QOS_LATENCY if self.table_packets <= self._tuning.table_first else QOS_DEFAULT

    def _send_rows(self, rows: Collection[_Kept], qos: int, now: float) -> None:
        queue = self._topics[TABLE_TOPIC].queue
        for row in rows:
            message = Message(-1, TABLE_TOPIC, row.payload, qos, now, repeat=True, begin=row.begin)
            message.left_at = row.named  # whether it has left before
            queue.append(message)
        self._stats.repeats += len(rows)

    def _of(self, topic_id: int) -> Collection[_Kept]:
        return self._rows.values() if topic_id == TABLE_TOPIC else self._kept.get(topic_id, ())

    def announce(self, now: float) -> None:
        """Send all kept messages, for robots that cannot ask."""
        for topic_id in (TABLE_TOPIC, *self._kept):
            if topic_id == TABLE_TOPIC or not self._topics[topic_id].queue:
                self.ask(topic_id, now)

    def marks(self, now: float) -> list[tuple[int, int]]:
        """What hellos name: (topic id, CRC-32) of the newest message that is kept of each topic, and of those before it
        that speak of others. A receiver remembers what hellos name."""
        return [
            (topic_id, kept.mark)
            for topic_id, messages in self._kept.items()
            for kept in messages
            if (kept.keys or kept is messages[-1]) and kept.named <= now <= kept.until
        ]

    def left(self, message: Message, now: float, *, reported: bool) -> None:
        """A message has left whole.

        :param reported: whether receivers report that they have it
        """
        if not (of := self._of(message.topic_id)):
            return
        for kept in of:
            if kept.payload is message.payload:
                settling_s = 0.0 if kept.missed else self._tuning.kept_settling_s * self._settings.slower
                kept.named = min(kept.named, now + settling_s)
                kept.begin = message.begin if message.index > 1 else kept.begin
        if not reported:
            # Later the table is sent again, and is small; at the start, nothing can be delivered without it.
            lifetime, waited = message.lifetime, now - message.submitted
            again = self._tuning.kept_starting_s * self._settings.slower
            table = message.topic_id == TABLE_TOPIC
            lifetime.expires = self._starting_until if table else min(lifetime.expires, now + 2 * waited + again)
