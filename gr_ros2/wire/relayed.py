"""A message of one robot that another one sends on, as it stands in a message of the topics 241 and 242 of version 1.

```text
byte 0        robot that made the message
bytes 1, 2    the low 16 bits of its boot number
bytes 3..6    number of its packet in which the message began
byte 7        place of the message among the entries there
byte 8        topic id in its table; 240 for the table itself, behind 8 bytes of its boot number
byte 9        C, A, P, hops   C = 1: coded; A = 1: for one robot; P = 1: the message before it is told; 0..31 robots
                              that have sent it on, this one included
byte 10       age of the message when this packet leaves, see below
byte 11       if A: the robot for which it is
varint        if P: how many packets before its own the message of its topic before it began, and
byte          if P: the place of that one among the entries there
then          the message
```

Only messages of reliable topics for all robots have P = 1. Between the message that it tells and this one no other of
the topic was begun; the one that it tells need not exist (place 255: all that began in that packet).

A message of topic 242 is *carried*: A is 1, and in front stand three bytes more: the robot that is to take it on; the
age at which the message is of no more use; and how many messages of its topic before it, with the places before its
own, its origin still keeps (0..127). P is 0. One of topic 240 is a receipt: it says what has come of the messages of
the robot for which it is, in entries of 8 bytes.

```text
bytes 0, 1    the low 16 bits of the boot number of the robot for which the receipt is
byte 2        topic id in the table of that robot
bytes 3..6    number, and
byte 7        place of the newest message of this topic that has come with all before it
```

Ages are codes of :mod:`gr_ros2.wire.ages`: an age is rounded up and a limit down, at every hop.

Invariants: reading raises nothing but a named WireError; every value has one encoding; no message is written younger
than it is.
"""

from __future__ import annotations

from collections.abc import Iterable
from struct import Struct
from struct import error as struct_error
from typing import NamedTuple

from gr_ros2.core.errors import EncodeError, EntryBoundsError, EntryKindError
from gr_ros2.wire.ages import NO_AGE, age_in_words
from gr_ros2.wire.format import varint
from gr_ros2.wire.v1 import BROADCAST, TABLE_TOPIC, read_varint

MOST_HOPS = 31
FIRST_PLACE, PLACES = 128, 128
"""Messages that their origin hands on have places that no entry has, one after the other, and again from the first."""
RECEIPT_TOPIC = TABLE_TOPIC
"""Topic id of receipts: a table of topics is not carried."""
_head, _receipt = Struct(">BHIBBBB"), Struct(">HBIB")
RELAYED_LEN = _head.size
"""Bytes in front of a message for everybody. One for a single robot has one more."""
_CODED, _ADDRESSED, _FOLLOWS = 0x80, 0x40, 0x20
_MOST_BACK = (1 << 28) - 1


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
    :param age: code of its age when it is sent on
    :param limit: code of the age at which it is of no more use; only carried messages have one
    :param waits: where it is carried: messages of its topic before it that its origin keeps
    :param after: number and place of the message of its topic before it, or of what was known to be before it; None
        where that is not told
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
    age: int = NO_AGE
    limit: int = NO_AGE
    waits: int = 0
    after: tuple[int, int] | None = None

    def describe(self) -> str:
        to = "" if self.dst_id == BROADCAST else f" to robot {self.dst_id}"
        after = "" if self.after is None else " after {}.{}".format(*self.after)
        return (
            f"robot {self.origin}'s (boot ends in {self.start:04x}) topic {self.topic_id}{to}, from its packet "
            f"{self.number}.{self.place}{after}, hop {self.hops}, {age_in_words(self.age)} old"
        )


def write_relayed(message: Relayed) -> bytes:
    """The bytes of a relayed message.

    :raises EncodeError: a field out of range
    """
    origin, start, number, place, topic_id, hops, payload, coded, dst_id, age, _, _, after = message
    if not 0 <= hops <= MOST_HOPS or topic_id > TABLE_TOPIC or origin == BROADCAST:
        raise EncodeError(f"{message.describe()}: hops are 0..{MOST_HOPS}, topics 0..{TABLE_TOPIC}, robots 0..254")
    addressed, before = dst_id != BROADCAST, b""
    try:
        flags = coded * _CODED | addressed * _ADDRESSED | hops
        if after is not None:
            if not (after[0] >= 0 and after < (number, place) and number - after[0] <= _MOST_BACK):
                raise EncodeError(f"{message.describe()}: it cannot tell that it follows this one")
            flags, before = flags | _FOLLOWS, varint(number - after[0]) + bytes(after[1:])
        head = _head.pack(origin, start, number, place, topic_id, flags, age)
        return head + bytes((dst_id,)) * addressed + before + payload
    except (struct_error, ValueError) as error:
        raise EncodeError(f"{message.describe()}: a field is out of range ({error})") from error


def write_carried(taker: int, message: Relayed) -> bytes:
    """The bytes of a carried message.

    :param taker: the robot that is to take it on
    :raises EncodeError: a field out of range
    """
    if not 0 <= taker < BROADCAST or message.dst_id == BROADCAST or message.after is not None:
        raise EncodeError(f"{message.describe()}, taken on by robot {taker}: it is for no single robot, or in a row")
    if not 0 <= message.waits < PLACES:
        raise EncodeError(f"{message.describe()}: {message.waits} messages before it; at most {PLACES - 1}")
    return bytes((taker, message.limit, message.waits)) + write_relayed(message)


def read_carried(data: bytes) -> tuple[int, Relayed]:
    """The robot that is to take a carried message on, and the message.

    :raises EntryBoundsError: it is cut off
    :raises EntryKindError: a topic or robot that does not exist, or it is for no single robot
    """
    message = read_relayed(data[3:])
    if data[0] == BROADCAST or data[2] >= PLACES or message.dst_id == BROADCAST or message.after is not None:
        raise EntryKindError(f"a carried message to robot {message.dst_id} over robot {data[0]}")
    return data[0], message._replace(limit=data[1], waits=data[2])


class Receipt(NamedTuple):
    """What has come of the messages of one topic that were carried to one robot.

    :param start: the low 16 bits of the boot number of the robot that made them
    :param topic_id: in its table
    :param number: number and ``place`` of the newest message that has come with all before it
    """

    start: int
    topic_id: int
    number: int
    place: int


def write_receipts(receipts: Iterable[Receipt]) -> bytes:
    """The payload of a receipt."""
    return b"".join(_receipt.pack(*receipt) for receipt in receipts)


def read_receipts(payload: bytes) -> list[Receipt]:
    """The entries of a receipt.

    :raises EntryBoundsError: it is cut off
    """
    if len(payload) % _receipt.size:
        raise EntryBoundsError(f"a receipt of {len(payload)} bytes, which are no entries of {_receipt.size}")
    return [Receipt(*entry) for entry in _receipt.iter_unpack(payload)]


def read_relayed(data: bytes) -> Relayed:
    """The message.

    :raises EntryBoundsError: it is cut off
    :raises EntryKindError: a topic or robot that does not exist, or it comes before itself
    :raises VarintError: a number that is not the shortest
    """
    if len(data) < RELAYED_LEN:
        raise EntryBoundsError(f"a relayed message of {len(data)} bytes")
    origin, start, number, place, topic_id, flags, age = _head.unpack_from(data)
    at, dst_id = RELAYED_LEN, BROADCAST
    if flags & _ADDRESSED:
        if len(data) == at:
            raise EntryBoundsError(f"a relayed message of {len(data)} bytes without its destination")
        dst_id, at = data[at], at + 1
    if topic_id > TABLE_TOPIC or origin == BROADCAST or (flags & _ADDRESSED and dst_id == BROADCAST):
        raise EntryKindError(f"a relayed message of robot {origin}, topic {topic_id}, to robot {dst_id}")
    after = None
    if flags & _FOLLOWS:
        back, at = read_varint(data, at, len(data) - 1)
        after, at = (number - back, data[at]), at + 1
        if not after[0] >= 0 or after >= (number, place):
            raise EntryKindError(f"a relayed message from packet {number}.{place} after {after[0]}.{after[1]}")
    hops, coded = flags & MOST_HOPS, flags & _CODED != 0
    return Relayed(origin, start, number, place, topic_id, hops, data[at:], coded, dst_id, age, after=after)
