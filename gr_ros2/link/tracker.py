"""Joins the events of a sender with the deliveries at the other end: which delivery belongs to which message.

Invariants: a message is found by its key while the engine's key still denotes it, otherwise by its bytes; a repeat
counts for the message that it repeats; a closed message is forgotten. Memory holds a digest of each open message, and
no payload.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from hashlib import blake2b
from typing import Generic, TypeVar

from gr_ros2.link.events import Accepted, Delivered, Lost, SentEntry

REPEATS = 4096
"""Number of repeat keys remembered per sender; those of the oldest repeats are forgotten first."""


def digest_of(payload: bytes) -> bytes:
    """Digest of a message's bytes."""
    return blake2b(payload, digest_size=16).digest()


@dataclass(slots=True, eq=False)
class Tracked:
    """A message whose fate is not known yet.

    :ivar digest: digest of the bytes that the other end should publish
    :ivar key: topic id and the engine's key, once its first fragment has left
    :ivar total: number of fragments, 0 while unknown
    :ivar sent: number of fragments that have left
    """

    serial: int
    topic_id: int
    t_sent: float
    digest: bytes
    key: tuple[int, Hashable] | None = None
    total: int = 0
    sent: int = 0

    @classmethod
    def of(cls: type[T], event: Accepted) -> T:
        """A message that was submitted."""
        expected = event.payload if event.expected is None else event.expected
        return cls(event.serial, event.topic_id, event.now, digest_of(expected))

    @property
    def all_sent(self) -> bool:
        """Whether the last fragment has left."""
        return self.sent >= self.total > 0


T = TypeVar("T", bound=Tracked)
_Index = TypeVar("_Index", bound=Hashable)


class Tracker(Generic[T]):
    """The open messages of one sender, and its repeats.

    :param most: most open messages kept, the oldest are forgotten first; 0 keeps all
    """

    def __init__(self, most: int = 0) -> None:
        self._most = most
        self._open: dict[int, T] = {}
        self._by_key: dict[tuple[int, Hashable], dict[int, T]] = {}
        """A key may be used again, so several messages may have had it; by serial, oldest first."""
        self._by_digest: dict[tuple[int, bytes], dict[int, T]] = {}
        self._repeats: OrderedDict[tuple[int, Hashable], int] = OrderedDict()
        """Topic id and key whose latest use was a repeat -> serial of the message repeated."""

    def __len__(self) -> int:
        return len(self._open)

    @property
    def open(self) -> Iterable[T]:
        """The open messages, oldest first."""
        return self._open.values()

    def get(self, serial: int) -> T | None:
        """The open message with that serial number."""
        return self._open.get(serial)

    def add(self, message: T) -> None:
        """A message was submitted."""
        self._open[message.serial] = message
        self._by_digest.setdefault((message.topic_id, message.digest), {})[message.serial] = message
        if self._most and len(self._open) > self._most:
            self.close(next(iter(self._open.values())))

    def left(self, entry: SentEntry) -> T | None:
        """A fragment left the sender: returns its open message, None for a repeat or a closed message."""
        key = (entry.topic_id, entry.key)
        if entry.repeat:
            self._repeats[key] = entry.serial
            self._repeats.move_to_end(key)
            if len(self._repeats) > REPEATS:
                self._repeats.popitem(last=False)
            return None
        message = self._open.get(entry.serial)
        if message is None:
            return None
        message.total = entry.total
        message.sent += 1
        if message.key is None:
            message.key = key
            self._repeats.pop(key, None)
            self._by_key.setdefault(key, {})[message.serial] = message
        return message

    def under(self, topic_id: int, key: Hashable) -> list[T]:
        """The open messages that have had this key, oldest first."""
        return list(self._by_key.get((topic_id, key), {}).values())

    def repeats(self, event: Delivered | Lost) -> bool:
        """Whether an event belongs to a repeat."""
        return (event.topic_id, event.key) in self._repeats

    def find(self, event: Delivered) -> T | None:
        """The open message of a delivery, None if there is none."""
        digest = digest_of(event.payload)
        for message in self._by_key.get((event.topic_id, event.key), {}).values():
            if message.digest == digest:
                return message
        if self.repeats(event):
            repeated = self._open.get(self._repeats[event.topic_id, event.key])
            return repeated if repeated is not None and repeated.digest == digest else None
        return next((message for message in self.alike(event.topic_id, digest) if message.sent), None)

    def alike(self, topic_id: int, digest: bytes) -> Iterable[T]:
        """The open messages with these bytes, oldest first."""
        return self._by_digest.get((topic_id, digest), {}).values()

    def repeated(self, event: Delivered) -> T | None:
        """The open message that an event's repeat repeats."""
        serial = self._repeats.get((event.topic_id, event.key))
        return None if serial is None else self._open.get(serial)

    def close(self, message: T) -> None:
        """Close a message whose fate is known."""
        del self._open[message.serial]
        _take(self._by_digest, (message.topic_id, message.digest), message.serial)
        if message.key is not None:
            _take(self._by_key, message.key, message.serial)


def _take(index: dict[_Index, dict[int, T]], at: _Index, serial: int) -> None:
    del index[at][serial]
    if not index[at]:
        del index[at]
