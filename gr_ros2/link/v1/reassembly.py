"""Joins the fragments of one sender to messages.

A fragment names its message by the packet in which the message began, and gives its offset in the message. Packet
numbers are full numbers here, of one start of the sender, so two messages cannot be confused. When a message is sent
again, its fragments name the packet in which it began at first, and may be cut elsewhere: what is here already is left
out.

Invariants: memory grows with what has arrived, never with what was announced; the memory held, bookkeeping included,
is bounded, and the message longest without a new fragment is given up first; work per fragment does not grow with the
number of incomplete messages.
"""

from __future__ import annotations

import sys
from bisect import bisect_right, insort
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heappop, heappush
from math import inf

from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.wire.v1 import Part

_PARTIAL_COST, _FRAGMENT_COST = 500, 80
"""Bytes of bookkeeping per message and per fragment held, beside the dictionary and the list of a message (measured
with ``tracemalloc`` where the others have just grown)."""
_FEW = 64


@dataclass(slots=True, eq=False)
class PartialMessage:
    """A message of which a part is missing.

    :param starts: offsets of its pieces, in order
    :param newest: packet of its newest fragment, and its place among the entries there
    :param cost: bytes that it takes, bookkeeping included
    :param place: its place among the entries of the packet in which it began; -1 until that packet is here
    :param made: when it was made, s, as far as its origin told that it had waited
    """

    topic_id: int
    begin: int
    coded: bool
    last: float
    pieces: dict[int, bytes] = field(default_factory=dict)
    starts: list[int] = field(default_factory=list)
    size: int = 0
    cost: int = 0
    total: int = -1
    newest: tuple[int, int] = (-1, -1)
    place: int = -1
    repaired: bool = False
    made: float = inf

    @property
    def order(self) -> tuple[int, int]:
        """Its place among the messages of its topic: where it began or, where that is only known of a repeat, where the
        newest fragment stands."""
        return (self.begin, self.place) if self.place >= 0 else self.newest

    def missing(self, offset: int, payload: bytes) -> list[tuple[int, bytes]]:
        """What of a fragment is not here yet, in pieces with their offsets."""
        starts, end, found = self.starts, offset + len(payload), []
        at = bisect_right(starts, offset)
        begin = max(offset, starts[at - 1] + len(self.pieces[starts[at - 1]])) if at else offset
        while begin < end:
            stop = min(end, starts[at]) if at < len(starts) else end
            if begin < stop:
                found.append((begin, payload[begin - offset : stop - offset]))
            begin = stop if stop == end else stop + len(self.pieces[stop])
            at += 1
        return found

    def payload(self) -> bytes | None:
        """The message; None if its fragments do not join."""
        parts = []
        offset = 0
        for start in self.starts:
            if start != offset:
                return None
            parts.append(self.pieces[start])
            offset += len(parts[-1])
        return b"".join(parts)


class Reassembly:
    """The incomplete messages of one sender.

    :param most: most bytes held
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._partials: OrderedDict[tuple[int, int], PartialMessage] = OrderedDict()
        """By topic id and packet in which they began; the message longest without a new fragment first."""
        self._begins: dict[int, list[int]] = {}
        """By topic id: a heap of the packets in which its messages began; some of them may be over."""
        self._noted = 0
        """Packets in these."""
        self._grown: dict[int, PartialMessage] = {}
        """By topic id: the message that had the last fragment."""
        self._held = 0

    @property
    def held(self) -> int:
        """Bytes in use."""
        return self._held

    def add(
        self, part: Part, number: int, place: int, *, repaired: bool, now: float, made: float = inf
    ) -> PartialMessage | None:
        """Take a fragment.

        :param number: number of its packet
        :param place: its place among the entries there
        :param repaired: the packet did not arrive when it was first sent
        :param made: when the message was made, s, if its packet tells that
        :return: its message, if that is complete now; it is then no longer held here
        """
        begin = number - part.back
        name = (part.topic_id, begin)
        partial = self._partials.get(name)
        if partial is None:
            partial = self._partials[name] = PartialMessage(part.topic_id, begin, part.coded, now)
            heappush(self._begins.setdefault(part.topic_id, []), begin)
            self._noted += 1
            if self._noted > 2 * len(self._partials) + _FEW:
                self._note_anew()
        else:
            self._partials.move_to_end(name)
        partial.last = now
        partial.newest = max(partial.newest, (number, place))
        self._grown[part.topic_id] = partial
        partial.repaired |= repaired
        partial.made = min(partial.made, made)
        for offset, payload in partial.missing(part.offset, part.payload):
            partial.pieces[offset] = payload
            insort(partial.starts, offset)
            partial.size += len(payload)
        lists = sys.getsizeof(partial.pieces) + sys.getsizeof(partial.starts)
        cost = _PARTIAL_COST + partial.size + len(partial.pieces) * _FRAGMENT_COST + lists
        self._held += cost - partial.cost
        partial.cost = cost
        if not (part.offset or part.back):
            partial.place = place
        if part.last:
            partial.total = part.offset + len(part.payload)
        if partial.size != partial.total:
            return None
        self._release(partial)
        return partial

    def overflowing(self) -> list[PartialMessage]:
        """Give up the oldest messages while memory is above its bound."""
        ended = []
        while self._held > self._most:
            ended.append(self._release(next(iter(self._partials.values()))))
        return ended

    def expired(self, now: float, after: float, keep: Callable[[PartialMessage], bool]) -> list[PartialMessage]:
        """Give up messages without a new fragment for so many s.

        :param keep: whether one waits longer; asked again after as many s
        """
        ended = []
        while self._partials and (partial := next(iter(self._partials.values()))).last + after <= now:
            if keep(partial):
                partial.last = now
                self._partials.move_to_end((partial.topic_id, partial.begin))
            else:
                ended.append(self._release(partial))
        return ended

    def overtaken(self, topic_id: int, begin: int) -> list[PartialMessage]:
        """Give up messages that began before a later message of the same topic that has been delivered."""
        ended, begins = [], self._begins.get(topic_id, [])
        while begins and begins[0] < begin:
            self._noted -= 1
            partial = self._partials.get((topic_id, heappop(begins)))
            if partial is not None:
                ended.append(self._release(partial))
        return ended

    def oldest(self, topic_id: int) -> tuple[int, int] | None:
        """The packet in which the oldest incomplete message of a topic began, and its place there; None for none."""
        begins = self._begins.get(topic_id, [])
        while begins and (topic_id, begins[0]) not in self._partials:
            heappop(begins)
            self._noted -= 1
        return (begins[0], self._partials[topic_id, begins[0]].place) if begins else None

    def clear(self) -> list[PartialMessage]:
        """Give up everything."""
        ended = list(self._partials.values())
        self._partials.clear()
        self._note_anew()
        self._grown.clear()
        self._held = 0
        return ended

    def lacks(self, known: RepairDecoder) -> bool:
        """Whether a packet is missing between the fragments of a message of which nothing more is to come.

        :param known: the packets that are here
        """
        return any(partial.total >= 0 or partial.newest[0] < known.newest for partial in self._partials.values())

    def growing(self, topic_id: int, since: float) -> bool:
        """Whether a message of a topic has had a fragment since a time."""
        partial = self._grown.get(topic_id)
        return partial is not None and partial.last > since

    def next_timeout(self) -> float | None:
        """The time of the last fragment of the message that is longest without a new one."""
        for partial in self._partials.values():
            return partial.last
        return None

    def _release(self, partial: PartialMessage) -> PartialMessage:
        del self._partials[partial.topic_id, partial.begin]
        self._held -= partial.cost
        if self._grown.get(partial.topic_id) is partial:
            del self._grown[partial.topic_id]
        return partial

    def _note_anew(self) -> None:
        """Note where the messages began that are not over."""
        self._begins.clear()
        for topic_id, begin in sorted(self._partials):
            self._begins.setdefault(topic_id, []).append(begin)
        self._noted = len(self._partials)
