"""The incomplete messages of all sources. Only this module holds them, knows their order and counts their bytes.

Invariants: a message is held from its first fragment until it is complete or removed; ``size`` is the sum over all held
messages; they are ordered by the time of their last new fragment, the oldest first.
"""

from __future__ import annotations

import sys
from collections import Counter, OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field

from gr_ros2.wire.v0 import EntryV0

_PARTIAL_COST, _FRAGMENT_COST = 560, 80
"""Bytes of bookkeeping counted per held message and fragment, beside the dictionary of fragments (measured with
``tracemalloc``)."""


@dataclass(slots=True, eq=False)
class Partial:
    """A message of which a fragment is missing.

    :ivar number: its entry id unwrapped
    :ivar last: time at which its last fragment came, s
    :ivar size: bytes that it takes
    :ivar following: the index of the next fragment of a sender that sends fragments in order
    :ivar doubtful: the sender used its id for another message at the same time
    """

    src_id: int
    topic_id: int
    entry_id: int
    number: int
    total: int
    flags: int
    doubtful: bool = False
    last: float = 0.0
    fragments: dict[int, bytes] = field(default_factory=dict)
    size: int = 0
    following: int = 0

    def contradicts(self, entry: EntryV0, flags: int) -> bool:
        """Whether an entry with the same id cannot belong to this message."""
        held = self.fragments.get(entry.index)
        return entry.total != self.total or flags != self.flags or (held is not None and held != entry.payload)

    def goes_on_with(self, entry: EntryV0) -> bool:
        """Whether an entry is the next fragment of this message, or one that was received before."""
        return not self.doubtful and (entry.index == self.following or entry.index in self.fragments)


class Partials:
    """Holds the incomplete messages; see the head of this module."""

    def __init__(self) -> None:
        self.size = 0
        """Bytes of all held messages."""
        self._sizes: Counter[int] = Counter()
        self._in_order: OrderedDict[Partial, None] = OrderedDict()
        self._of: dict[tuple[int, int], dict[int, Partial]] = {}

    def of(self, src_id: int, topic_id: int) -> dict[int, Partial]:
        """The messages of a source and topic by entry id: always the same dictionary; do not modify it."""
        return self._of.setdefault((src_id, topic_id), {})

    def size_of(self, src_id: int) -> int:
        """Bytes of the messages of a source."""
        return self._sizes[src_id]

    def oldest(self, src_id: int | None = None) -> Partial:
        """The message whose last new fragment is oldest, of one source or of all; there must be one."""
        return next(partial for partial in self._in_order if src_id is None or partial.src_id == src_id)

    def __iter__(self) -> Iterator[Partial]:
        """All messages in their order."""
        return iter(self._in_order)

    def add(self, partial: Partial, entry: EntryV0, now: float) -> bytes | None:
        """Hold a fragment of a message, which may be its first.

        :return: the complete message, which is then no longer held; None while fragments are missing
        """
        partial.last = now
        if partial not in self._in_order:
            self.of(partial.src_id, partial.topic_id)[partial.entry_id] = partial
            self._in_order[partial] = None
        elif entry.index in partial.fragments:
            self._in_order.move_to_end(partial)
            return None
        else:
            self._in_order.move_to_end(partial)
        room = sys.getsizeof(partial.fragments)
        partial.fragments[entry.index] = entry.payload
        partial.following = entry.index + 1
        cost = len(entry.payload) + _FRAGMENT_COST + sys.getsizeof(partial.fragments) - room
        cost += 0 if partial.size else _PARTIAL_COST
        partial.size += cost
        self.size += cost
        self._sizes[partial.src_id] += cost
        if len(partial.fragments) < partial.total:
            return None
        self.take(partial)
        return b"".join([partial.fragments[index] for index in range(partial.total)])

    def take(self, partial: Partial) -> Partial:
        """Stop holding a message."""
        del self._in_order[partial]
        del self._of[partial.src_id, partial.topic_id][partial.entry_id]
        self.size -= partial.size
        self._sizes[partial.src_id] -= partial.size
        return partial

    def forget(self, src_id: int) -> None:
        """Forget a source that has no incomplete messages."""
        for key in [key for key in self._of if key[0] == src_id]:
            del self._of[key]
        del self._sizes[src_id]
