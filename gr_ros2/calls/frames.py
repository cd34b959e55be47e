"""The bytes of a request and of a reply: messages of version 1 on a topic of their own (docs/reference/wire-format.md).

Invariants: ``read_frame`` raises nothing but a named WireError; ``read_frame(write_frame(frame)) == frame``.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct

from gr_ros2.core.errors import EncodeError, EntryBoundsError, EntryKindError

NO_DEADLINE = 0.0
"""Deadline, in s, of a call that waits for its reply without limit."""
MAX_DEADLINE_S = 6553.5
"""The longest deadline that a request can carry."""

OF_LINK = 240
"""In place of a service: the link of the robot itself, which is asked for topics (:mod:`gr_ros2.calls.wish_frames`)."""

_REQUEST, _REPLY = 0, 1
_HEAD = Struct(">BBQI")
_TAIL = Struct(">BH")
_DEADLINES_PER_S = 10


@dataclass(frozen=True, slots=True)
class CallFrame:
    """A request or a reply.

    :param dst_id: robot for which it is, 0..254
    :param dst_boot: start of that robot for which it is: any other start drops it
    :param number: number of the call among those of the robot that calls, from 1
    :param service_id: topic id of the service in the table of the robot that is called, or ``OF_LINK``; -1 in a reply
    :param deadline_s: s that the caller waits for the reply, to 0.1 s, 0..6553.5; ``NO_DEADLINE`` without limit
    :param payload: CDR message with encapsulation header
    """

    dst_id: int
    dst_boot: int
    number: int
    payload: bytes
    service_id: int = -1
    deadline_s: float = NO_DEADLINE

    @property
    def is_request(self) -> bool:
        """Whether it is a request, and not a reply."""
        return self.service_id >= 0


def write_frame(frame: CallFrame) -> bytes:
    """The bytes of a frame.

    :raises EncodeError: a field out of range
    """
    fits = 0 <= frame.dst_id < 255 and 0 <= frame.dst_boot < 1 << 64 and 0 < frame.number < 1 << 32
    if not fits or not -1 <= frame.service_id <= OF_LINK or not 0 <= frame.deadline_s <= MAX_DEADLINE_S:
        raise EncodeError(f"a field of {frame} is out of range")
    kind = _REQUEST if frame.is_request else _REPLY
    head = _HEAD.pack(kind, frame.dst_id, frame.dst_boot, frame.number)
    if not frame.is_request:
        return head + frame.payload
    tenths = round(frame.deadline_s * _DEADLINES_PER_S)
    return head + _TAIL.pack(frame.service_id, max(tenths, 1) if frame.deadline_s else 0) + frame.payload


def read_frame(data: bytes) -> CallFrame:
    """The frame of these bytes.

    :raises WireError: EntryBoundsError (cut off) or EntryKindError (neither a request nor a reply, or a field that
        cannot be)
    """
    if len(data) < _HEAD.size:
        raise EntryBoundsError(f"a frame of a call ends at byte {len(data)}")
    kind, dst_id, dst_boot, number = _HEAD.unpack_from(data)
    if kind not in (_REQUEST, _REPLY) or dst_id == 255 or not number:
        raise EntryKindError(f"kind {kind}, robot {dst_id} or number {number} in a frame of a call")
    if kind == _REPLY:
        return CallFrame(dst_id, dst_boot, number, data[_HEAD.size :])
    if len(data) < _HEAD.size + _TAIL.size:
        raise EntryBoundsError(f"a request ends at byte {len(data)}")
    service_id, tenths = _TAIL.unpack_from(data, _HEAD.size)
    if service_id > OF_LINK:
        raise EntryKindError(f"service {service_id} in a request")
    return CallFrame(dst_id, dst_boot, number, data[_HEAD.size + _TAIL.size :], service_id, tenths / _DEADLINES_PER_S)
