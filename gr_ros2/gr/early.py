"""The first messages of a new publisher, until the subscribers that are there have found it.

DDS matches each side in its own time. A best-effort subscriber misses what is published before it knows the publisher.

Invariants: messages leave in their order; memory is bounded, and when it is full, nothing waits any longer.
"""

from __future__ import annotations

from gr_ros2.link import Delivered
from gr_ros2.middleware import Publisher

CHECK_S = 0.01
"""s between two looks whether subscribers have been found."""
MOST_S = 0.5
"""s that a publisher waits at most. Where nobody subscribes, its first message comes so much later."""
MESSAGES, BYTES = 64, 1 << 18
"""So much may wait; the first message always may."""


class EarlyMessages:
    """What waits for the subscribers of one publisher.

    :param settling_s: s from the first match on this side to that on the other
    :param now: s
    """

    def __init__(self, publisher: Publisher, settling_s: float, now: float) -> None:
        self.waiting: list[Delivered] = []
        self._publisher, self._settling_s = publisher, settling_s
        self._until, self._matched = now + MOST_S, False
        self._size = 0

    def add(self, event: Delivered) -> None:
        """Let a message wait behind the others."""
        self.waiting.append(event)
        self._size += len(event.payload)

    def ended(self, now: float) -> bool:
        """Whether nothing needs to wait any longer."""
        if not self._matched and self._publisher.matched():
            self._matched, self._until = True, min(self._until, now + self._settling_s)
        full = len(self.waiting) > 1 and (len(self.waiting) >= MESSAGES or self._size >= BYTES)
        return full or now >= self._until
