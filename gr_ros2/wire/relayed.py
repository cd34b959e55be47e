"""A message of one robot that another one sends on, as it stands in a message of the topics 241 and 242 of version 1.

```text
byte 0        robot that made the message
bytes 1, 2    the low 16 bits of its boot number
bytes 3..6    number of its packet in which the message began
byte 7        place of the message among the entries there
byte 8        topic id in its table; 240 for the table itself, behind 8 bytes of its boot number
byte 9        C, A, hops      C = 1: coded; A = 1: for one robot; 0..63 robots that have sent it on, this one included
byte 10       if A: the robot for which it is
then          the message
```

A message of topic 242 is *carried*: in front stands one byte more, the robot that is to take it on, and A is 1.

Invariants: reading raises nothing but a named WireError; every value has one encoding.
"""

from __future__ import annotations

from struct import Struct
from struct import error as struct_error
from typing import NamedTuple

from gr_ros2.core.errors import EncodeError, EntryBoundsError, EntryKindError
from gr_ros2.wire.v1 import BROADCAST, TABLE_TOPIC

MOST_HOPS = 63
_head = Struct(">BHIBBB")
RELAYED_LEN = _head.size
"""Bytes in front of a message for everybody. One for a single robot has one more."""
_CODED, _ADDRESSED = 0x80, 0x40


class Relayed(NamedTuple):
    """A message of another robot.

    :param origin: the robot that made it
    :param start: the low 16 bits of its boot number
    :param number: its packet in which the message began; with ``place`` it names the message
    :param place: among the entries of that packet
    :param topic_id: in its table; 240 for the table
    :param hops: robots that have sent it on, the sender of this packet included
    :param coded: whether the message is coded
    :param dst_id: the robot for which it is, 255 for all
    """

    origin: int
    start: int
    number: int
    place: int
    topic_id: int
    hops: int
    payload: bytes
    coded: bool = False
    dst_id: int = BROADCAST

    def describe(self) -> str:
        """The fields in words."""
        to = "" if self.dst_id == BROADCAST else f" to robot {self.dst_id}"
        return (
            f"robot {self.origin}'s (boot ends in {self.start:04x}) topic {self.topic_id}{to}, from its packet "
            f"{self.number}.{self.place}, hop {self.hops}"
        )


def write_relayed(message: Relayed) -> bytes:
    """The bytes of a relayed message.

    :raises EncodeError: a field out of range
    """
    origin, start, number, place, topic_id, hops, payload, coded, dst_id = message
    if not 0 <= hops <= MOST_HOPS or topic_id > TABLE_TOPIC or origin == BROADCAST:
        raise EncodeError(f"{message.describe()}: hops are 0..{MOST_HOPS}, topics 0..{TABLE_TOPIC}, robots 0..254")
    addressed = dst_id != BROADCAST
    try:
        flags = coded * _CODED | addressed * _ADDRESSED | hops
        head = _head.pack(origin, start, number, place, topic_id, flags)
        return head + bytes((dst_id,)) * addressed + payload
    except (struct_error, ValueError) as error:
        raise EncodeError(f"{message.describe()}: a field is out of range ({error})") from error


def write_carried(taker: int, message: Relayed) -> bytes:
    """The bytes of a carried message.

    :param taker: the robot that is to take it on
    :raises EncodeError: a field out of range
    """
    if not 0 <= taker < BROADCAST or message.dst_id == BROADCAST:
        raise EncodeError(f"{message.describe()}, taken on by robot {taker}: it is for no single robot")
    return bytes((taker,)) + write_relayed(message)


def read_carried(data: bytes) -> tuple[int, Relayed]:
    """The robot that is to take a carried message on, and the message.

    :raises EntryBoundsError: it is cut off
    :raises EntryKindError: a topic or robot that does not exist, or it is for no single robot
    """
    message = read_relayed(data[1:])
    if data[0] == BROADCAST or message.dst_id == BROADCAST:
        raise EntryKindError(f"a carried message to robot {message.dst_id} over robot {data[0]}")
    return data[0], message


def read_relayed(data: bytes) -> Relayed:
    """The message.

    :raises EntryBoundsError: it is cut off
    :raises EntryKindError: a topic or robot that does not exist
    """
    if len(data) < RELAYED_LEN:
        raise EntryBoundsError(f"a relayed message of {len(data)} bytes")
    origin, start, number, place, topic_id, flags = _head.unpack_from(data)
    at, dst_id = RELAYED_LEN, BROADCAST
    if flags & _ADDRESSED:
        if len(data) == at:
            raise EntryBoundsError(f"a relayed message of {len(data)} bytes without its destination")
        dst_id, at = data[at], at + 1
    if topic_id > TABLE_TOPIC or origin == BROADCAST or (flags & _ADDRESSED and dst_id == BROADCAST):
        raise EntryKindError(f"a relayed message of robot {origin}, topic {topic_id}, to robot {dst_id}")
    return Relayed(origin, start, number, place, topic_id, flags & MOST_HOPS, data[at:], flags & _CODED != 0, dst_id)
