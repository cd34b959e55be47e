"""The topics that one robot has announced, and the messages that wait for the announcement.

A message can be delivered only if the table of topics names its topic and how it is coded. Messages that arrive before
the table are kept, within bounds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from zlib import crc32

from gr_ros2.core.errors import CodecError
from gr_ros2.link.fates import Fate
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.v1.order import Ready
from gr_ros2.wire.relayed import Relayed
from gr_ros2.wire.table import AnnouncedTopic, read_table

_WAITING = 256
"""Number of messages of unknown topics, or coded in an unknown way, that are kept until the table arrives."""


class AnnouncedTopics:
    """The table of topics of one start of one robot.

    :param decoder_for: makes the decoder for its messages from its table of topics
    :param most: bytes of messages that may wait for the table
    :ivar topics: by topic id
    :ivar digest: CRC-32 of the table that is known
    """

    def __init__(
        self,
        decoder_for: Callable[[tuple[AnnouncedTopic, ...]], MessageCodec] | None,
        most: int,
    ) -> None:
        self.topics: dict[int, AnnouncedTopic] = {}
        self.digest = 0
        self._decoder_for = decoder_for
        self._codec: MessageCodec | None = None
        self._waiting: deque[Ready] = deque()
        self._bytes = 0
        self._most = most

    @property
    def held(self) -> int:
        """Bytes of the messages that wait for a table."""
        return self._bytes

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
        self._bytes += len(ready.payload)
        given_up = []
        while len(self._waiting) > _WAITING or self._bytes > self._most:
            given_up.append(self._waiting.popleft())
            self._bytes -= len(given_up[-1].payload)
        return given_up

    def take(self, table: bytes) -> tuple[AnnouncedTopic, ...] | None:
        """Take over a table; returns its topics, None if it is known already.

        :raises WireError: it cannot be read
        """
        topics = read_table(table)
        digest = crc32(table)
        if digest == self.digest:
            return None
        self.digest = digest
        self.topics = {topic.topic_id: topic for topic in topics}
        if self._decoder_for is not None:
            self._codec = self._decoder_for(topics)
        return topics

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
