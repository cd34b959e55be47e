"""The table of topics that a robot announces: rows in messages of version 1 on topic ``TABLE_TOPIC``.

Invariants: ``read_table`` raises nothing but a named WireError; ``read_table(write_table(topics)) == topics``; equal
rows have equal bytes, so a receiver can tell from the sum of their marks whether it has the newest of each.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple
from zlib import crc32

from gr_ros2.core.errors import EncodeError, EntryBoundsError, EntryKindError, VersionError
from gr_ros2.wire.ages import NO_AGE, age_of
from gr_ros2.wire.format import BROADCAST, QOS_NAMES

_FORMAT = 1
_QOS, _RELIABLE, _LATCHED, _FRESH, _ADDRESSED, _DEADLINE = 3, 4, 8, 16, 32, 64
_FIXED = 4
_MOST = 239, 2, 255, BROADCAST, NO_AGE - 1


class AnnouncedTopic(NamedTuple):
    """One topic.

    :param topic_id: 0..239
    :param name: as registered, relative to the robot's namespace or absolute with leading slash; '' for a topic that is
        not offered any more
    :param type_name: ``package/msg/Type``
    :param qos: 0 default, 1 latency, 2 bulk
    :param reliable: its publishers are reliable: messages are delivered in their order
    :param latched: its publishers keep messages for late joiners (transient-local)
    :param depth: history depth of its publishers, 1..255; 0 if unknown
    :param codec: how its messages are coded, '' if they are not; the codec defines the text
    :param fresh: its messages are of no use when they are old: they have a deadline or a lifespan, or are calls
    :param dst_id: the robot for which its messages are, 255 for all
    :param deadline: code of the age (``wire.relayed``) at which its messages are of no more use, 0 for none
    """

    topic_id: int
    name: str
    type_name: str
    qos: int = 0
    reliable: bool = False
    latched: bool = False
    depth: int = 0
    codec: str = ""
    fresh: bool = False
    dst_id: int = BROADCAST
    deadline: int = 0

    @property
    def deadline_s(self) -> float:
        """Age in s at which its messages are of no more use; 0 for none."""
        return age_of(self.deadline)

    @property
    def mark(self) -> int:
        """CRC-32 of a table of this row alone. The sum of those of all rows, mod 2^32, tells two tables apart."""
        return crc32(write_table((self,)))

    def describe(self) -> str:
        if not self.name:
            return f"topic {self.topic_id}: not offered any more"
        words = [f"topic {self.topic_id}: {self.name} {self.type_name}, {QOS_NAMES[self.qos]}"]
        words += ["reliable"] * self.reliable + ["latched"] * self.latched + ["of no use when old"] * self.fresh
        words += [f"depth {self.depth}"] * (self.depth > 0) + [f"codec {self.codec}"] * bool(self.codec)
        words += [f"for robot {self.dst_id}"] * (self.dst_id != BROADCAST)
        words += [f"over after {self.deadline_s:g} s"] * (self.deadline > 0)
        return ", ".join(words)


def write_table(topics: Iterable[AnnouncedTopic]) -> bytes:
    """The bytes of a table.

    :raises EncodeError: a field out of range, or a text of more than 255 bytes
    """
    parts = [bytes((_FORMAT,))]
    for topic in topics:
        texts = [text.encode() for text in (topic.name, topic.type_name, topic.codec)]
        numbers = topic.topic_id, topic.qos, topic.depth, topic.dst_id, topic.deadline
        if any(not 0 <= value <= most for value, most in zip(numbers, _MOST, strict=True)):
            raise EncodeError(f"a field of {topic} is out of range")
        if max(map(len, texts)) > 255:
            raise EncodeError(f"{topic}: name, type and codec have at most 255 bytes each")
        flags = topic.qos | topic.reliable * _RELIABLE | topic.latched * _LATCHED | topic.fresh * _FRESH
        addressed, limited = topic.dst_id != BROADCAST, topic.deadline > 0
        flags |= addressed * _ADDRESSED | limited * _DEADLINE
        parts.append(bytes((topic.topic_id, flags, topic.depth)))
        parts.append(bytes((topic.dst_id,)) * addressed + bytes((topic.deadline,)) * limited)
        parts += [bytes((len(text),)) + text for text in texts]
    return b"".join(parts)


def read_table(data: bytes) -> tuple[AnnouncedTopic, ...]:
    """The topics of a table.

    :raises WireError: VersionError (an unknown layout), EntryBoundsError (cut off) or EntryKindError
    """
    if data[:1] != bytes((_FORMAT,)):
        raise VersionError(f"a table of topics of layout {data[:1].hex() or 'none'}")
    topics: list[AnnouncedTopic] = []
    position = 1
    while position < len(data):
        if position + _FIXED > len(data):
            raise EntryBoundsError(f"topic {len(topics)} of a table runs past byte {len(data)}")
        topic_id, flags, depth = data[position : position + 3]
        position += 3
        dst_id = BROADCAST
        if flags & _ADDRESSED:
            dst_id, position = data[position], position + 1
            if dst_id == BROADCAST:
                raise EntryKindError(f"topic {len(topics)} of a table is for robot {BROADCAST}")
        deadline = 0
        if flags & _DEADLINE:
            if position == len(data):
                raise EntryBoundsError(f"topic {len(topics)} of a table ends before its deadline")
            deadline, position = data[position], position + 1
            if deadline in (0, NO_AGE):
                raise EntryKindError(f"topic {len(topics)} of a table has a deadline of code {deadline}")
        texts: list[str] = []
        for _ in range(3):
            start = position + 1
            if start > len(data) or start + data[position] > len(data):
                raise EntryBoundsError(f"a text in topic {len(topics)} of a table runs past byte {len(data)}")
            position = start + data[position]
            try:
                texts.append(data[start:position].decode())
            except UnicodeDecodeError as error:
                raise EntryKindError(f"a text in topic {len(topics)} of a table is no UTF-8") from error
        if topic_id >= 240 or flags & _QOS == _QOS or flags > 127 or topic_id in {row.topic_id for row in topics}:
            raise EntryKindError(f"topic id {topic_id} or flags {flags:#x} in topic {len(topics)} of a table")
        name, type_name, codec = texts
        reliable, latched = flags & _RELIABLE != 0, flags & _LATCHED != 0
        of = flags & _QOS, reliable, latched, depth, codec, flags & _FRESH != 0, dst_id, deadline
        topics.append(AnnouncedTopic(topic_id, name, type_name, *of))
    return tuple(topics)
