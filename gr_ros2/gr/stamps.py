"""Header stamps of other robots' messages, moved to this robot's clock.

Invariants: the stamp of every Header in a message is moved, those of transforms too, and nothing else changes. A stamp
of zero means unset, and stays, as does one that would leave the range of a stamp. A message that begins with the only
Header that it has is not decoded.
"""

from __future__ import annotations

import struct
from collections import Counter
from typing import Any

from rosbags.typesys.store import Typestore

from gr_ros2.gr.members import HEADER, ChangedMembers

_NS = 1_000_000_000
_SECONDS = range(-(2**31), 2**31)
_TIME = (struct.Struct(">iI"), struct.Struct("<iI"))
_CDR_HEAD = 4


class MovedStamps:
    """Moves the stamps of messages.

    :param counters: counts messages that passed unchanged, see :class:`ChangedMembers`
    """

    def __init__(self, counters: Counter[str]) -> None:
        self._members = ChangedMembers("stamp", _is_stamp, counters)

    def learn(self, type_name: str, store: Typestore) -> None:
        """Use a definition of a type that was not known, or in preference to those that were."""
        self._members.learn(type_name, store)

    def apply(self, type_name: str, payload: bytes, by_s: float) -> bytes:
        """The message with stamps that are later by so many s, or the unchanged message."""
        by_ns = round(by_s * _NS)
        if len(payload) >= _CDR_HEAD + 8 and self._members.leads(type_name, "stamp"):
            time = _TIME[payload[1] & 1]
            sec, nanosec = time.unpack_from(payload, _CDR_HEAD)
            moved = time.pack(*_moved(sec, nanosec, by_ns))
            return payload[:_CDR_HEAD] + moved + payload[_CDR_HEAD + 8 :]

        def move(header: Any, _: str) -> None:
            stamp = header.stamp
            stamp.sec, stamp.nanosec = _moved(stamp.sec, stamp.nanosec, by_ns)

        return self._members.apply(type_name, payload, move)


def _is_stamp(type_name: str, name: str, _: bool) -> bool:
    return (type_name, name) == (HEADER, "stamp")


def _moved(sec: int, nanosec: int, by_ns: int) -> tuple[int, int]:
    if not sec and not nanosec:
        return 0, 0
    moved = divmod(sec * _NS + nanosec + by_ns, _NS)
    return moved if moved[0] in _SECONDS else (sec, nanosec)
