"""The topics that one robot has announced, and the messages that wait for the announcement.

A message can be delivered only if a row of the table of topics names its topic and how it is coded. Rows come one by
one; messages that arrive before theirs are kept, within bounds.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable
from math import inf

from gr_ros2.core.errors import CodecError, EntryBoundsError
from gr_ros2.link.fates import Fate
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.v1.order import Ready
from gr_ros2.wire.relayed import Relayed
from gr_ros2.wire.table import AnnouncedTopic, read_table, write_table

_WAITING = 256
"""Number of messages of unknown topics, or coded in an unknown way, that are kept until the table arrives."""
_COST, _ROW_COST = 400, 700
"""Bytes beside its payload that a message takes which waits, and that a row takes beside its texts (measured with
``tracemalloc``)."""
ARRIVING_S = 1.0
"""s for which more of what a robot sends again is waited for before it is asked for it; more on a slow channel."""


class AnnouncedTopics:
    """The table of topics of one start of one robot.

    :param decoder_for: makes the decoder for its messages from its table of topics
    :param most: bytes of the table, and of messages that may wait for it
    :ivar topics: those that are offered, by topic id
    :ivar digest: sum of the marks of the rows that are known
    """

    def __init__(
        self,
        decoder_for: Callable[[tuple[AnnouncedTopic, ...]], MessageCodec] | None,
        most: int,
    ) -> None:
        self.topics: dict[int, AnnouncedTopic] = {}
        self.digest = 0
        self._newest = (-1, -inf)
        """Number of the packet that brought the newest row, and when, s."""
        self._rows: dict[int, AnnouncedTopic] = {}
        self._orders: dict[int, tuple[int, int]] = {}
        """The order of the newest row of each topic that the robot's own packets brought."""
        self._decoder_for = decoder_for
        self._codec: MessageCodec | None = None
        self._waiting: deque[Ready] = deque()
        self._bytes = self._row_bytes = 0
        self._most = most

    @property
    def held(self) -> int:
        """Bytes of the table and of the messages that wait for it."""
        return self._bytes + self._row_bytes

    def came(self, number: int, now: float) -> None:
        """A row has come in a packet of the robot itself."""
        self._newest = max(number, self._newest[0]), now

    def topic_of(self, ready: Ready | Relayed) -> AnnouncedTopic | None:
        """The topic of a message; None if the message has to wait for a table."""
        topic = self.topics.get(ready.topic_id)
        if topic is None or (
            ready.coded and self._codec is not None and self._codec.lacks(ready.topic_id, ready.payload)
        ):
            return None
        return topic

    def wait(self, ready: Ready) -> list[Ready]:
        """Keep a message until a table arrives; returns the messages that are given up for it."""
        self._waiting.append(ready)
        self._bytes += len(ready.payload) + _COST
        given_up = []
        while self._waiting and (len(self._waiting) > _WAITING or self.held > self._most):
            given_up.append(self._waiting.popleft())
            self._bytes -= len(given_up[-1].payload) + _COST
        return given_up

    def take(self, table: bytes, order: tuple[int, int], *, direct: bool = True) -> tuple[AnnouncedTopic, ...] | None:
        """Take over the rows of a table that are newer than those that are known; returns all topics, None if nothing
        has changed.

        :param order: of the message that it is
        :param direct: it comes from the robot itself: whatever others say, only its own rows are older or newer
        :raises WireError: it cannot be read, or is too large
        """
        rows = [row for row in read_table(table) if order >= self._orders.get(row.topic_id, order)]
        if direct:
            self._orders.update(dict.fromkeys((row.topic_id for row in rows), order))
        changed = {row.topic_id: row for row in rows if row != self._rows.get(row.topic_id)}
        if not changed:
            return None
        replaced = [self._rows[topic_id] for topic_id in changed if topic_id in self._rows]
        row_bytes = self._row_bytes + sum(map(_size, changed.values())) - sum(map(_size, replaced))
        if row_bytes > self._most:
            raise EntryBoundsError(f"a table of topics of {row_bytes} bytes, where {self._most} are free for it")
        self._row_bytes = row_bytes
        self._rows.update(changed)
        marks = sum(row.mark for row in changed.values()) - sum(row.mark for row in replaced)
        self.digest = (self.digest + marks) & 0xFFFF_FFFF
        topics = tuple(row for _, row in sorted(self._rows.items()) if row.name)
        self.topics = {topic.topic_id: topic for topic in topics}
        if self._decoder_for is not None:
            self._codec = self._decoder_for(topics)
        return topics

    @property
    def table(self) -> bytes:
        """The rows that are known."""
        return write_table(row for _, row in sorted(self._rows.items()))

    def lacks(self, digest: int, number: int, since: float) -> bool:
        """Whether rows of a table, named in a hello at a packet number, are not here, and none came since then, s."""
        newest, at = self._newest
        return digest != self.digest and newest <= number and at <= since

    def waiting(self) -> list[Ready]:
        """The messages that have waited for a table, in order; they are returned once."""
        waiting, self._waiting, self._bytes = self._waiting, deque(), 0
        return sorted(waiting, key=lambda ready: ready.order)

    def decode(self, ready: Ready) -> bytes:
        """The payload of a coded message.

        :raises CodecError: it cannot be decoded; ``fate`` names the fate of the message
        """
        if self._codec is None:
            raise CodecError("coded, and no codec is configured here")
        return self._codec.decode(ready.topic_id, ready.payload)

    def unknown(self, ready: Ready) -> Fate:
        """The fate of a message that is given up because its table did not arrive."""
        return Fate.UNKNOWN_DICTIONARY if ready.topic_id in self.topics else Fate.UNKNOWN_TOPIC


def _size(row: AnnouncedTopic) -> int:
    """Bytes that a row takes."""
    return _ROW_COST + sum(map(sys.getsizeof, (row.name, row.type_name, row.codec)))
