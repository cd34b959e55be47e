"""The messages that are carried to this robot, in the order in which their origins made them.

The messages of a topic have consecutive places, and each says how many before it its origin still keeps. So it waits
for these, and for no others: their origin hands them on until it is told that they have come.

A message that came over others may be false. Where it has put later ones off, one that was made ``EXPIRES_S`` after it
came begins anew.

Invariants: a message is given out once, and none after a later one of its topic; memory is bounded by a share of it
and by ``MOST_STREAMS`` topics.
"""

from __future__ import annotations

from collections.abc import Container
from math import inf
from typing import Generic, TypeVar

from gr_ros2.relay.gain import EXPIRES_S, Stream
from gr_ros2.relay.memory import Share
from gr_ros2.wire.relayed import PLACES, Relayed
from gr_ros2.wire.v1 import TABLE_TOPIC

MOST_STREAMS = 1024
"""Topics of which it is known what has come; of others, everything counts as new."""
_COST, _STREAM_COST = 900, 700
"""Bytes that a message which waits takes beside its payload, and a topic (measured with ``tracemalloc``)."""
T = TypeVar("T")


class _Sequence(Generic[T]):
    """The messages of one topic of one start of one robot, by places that are counted on.

    :ivar next: that of the next message
    :ivar floor: the origin keeps no message before it any more
    :ivar newest: number and place of the last message that was given out
    :ivar came: when the last one came that was new, s
    """

    __slots__ = ("came", "floor", "newest", "next", "waiting")

    def __init__(self, place: int) -> None:
        self.next = self.floor = place
        self.newest, self.came = (-1, -1), -inf
        self.waiting: dict[int, tuple[Relayed, T]] = {}

    def passed(self, message: Relayed) -> bool:
        """Whether a message is no later one than the last that was given out."""
        return (message.number, message.place) <= self.newest

    def take_out(self) -> tuple[Relayed, T] | None:
        """The next message; None if it is not here."""
        first = min(self.waiting, default=None)
        if first is None or first > max(self.next, self.floor):
            return None
        message, item = self.waiting.pop(first)
        self.next, self.newest = first + 1, (message.number, message.place)
        return message, item


class Sequences(Generic[T]):
    """Messages that wait for those before them.

    :param share: of the memory
    """

    def __init__(self, share: Share) -> None:
        self._share = share
        self._all: dict[Stream, _Sequence[T]] = {}

    def take(self, message: Relayed, item: T, made: float, now: float, *, known: bool = True) -> bool | None:
        """Keep a message until its turn.

        :param item: what is given out with it
        :param made: when it was made, s
        :param known: it can be delivered as soon as it is the next of its topic
        :return: whether it is new; None if there is no room for it
        """
        stream = Stream(message.origin, message.start, message.topic_id)
        if self.refutes(message, made):
            self._drop(stream)
        sequence = self._all.pop(stream, None)
        if sequence is None:
            if self._share.full and not known:
                return None
            self._share.held += _STREAM_COST
            sequence = _Sequence(message.place - message.waits)
        self._all[stream] = sequence
        if len(self._all) > MOST_STREAMS:
            self._drop(next(iter(self._all)))
        if sequence.passed(message):
            return False
        place = sequence.next + (message.place - sequence.next) % PLACES
        sequence.floor = max(sequence.floor, place - message.waits)
        if place in sequence.waiting:
            return False
        self._share.held += len(message.payload) + _COST
        if self._share.full and not (known and place <= max(sequence.next, sequence.floor)):
            self._share.held -= len(message.payload) + _COST
            return None
        sequence.waiting[place], sequence.came = (message, item), now
        return True

    def refutes(self, message: Relayed, made: float) -> bool:
        """Whether a message shows that the last one of its topic that was given out was false."""
        sequence = self._all.get(Stream(message.origin, message.start, message.topic_id))
        return sequence is not None and sequence.passed(message) and made > sequence.came + EXPIRES_S

    def due(self, origin: int, start: int, known: Container[int] = range(TABLE_TOPIC)) -> list[T]:
        """The messages of a start of a robot whose turn has come.

        :param known: its topics that can be delivered
        """
        found = []
        for stream, sequence in self._all.items():
            wanted = stream[:2] == (origin, start) and stream.topic_id in known
            while wanted and (out := sequence.take_out()) is not None:
                self._share.held -= len(out[0].payload) + _COST
                found.append(out[1])
        return found

    def newest(self, stream: Stream) -> tuple[int, int] | None:
        """Number and place of the last message of a topic that was given out."""
        sequence = self._all.get(stream)
        return None if sequence is None or sequence.newest[0] < 0 else sequence.newest

    def _drop(self, stream: Stream) -> None:
        gone = self._all.pop(stream, None)
        if gone is not None:
            waiting = sum(len(message.payload) + _COST for message, _ in gone.waiting.values())
            self._share.held -= waiting + _STREAM_COST
