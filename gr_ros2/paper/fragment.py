"""How version 0 cuts a message into fragments (the paper, section 5.2): into equal ones, all but the last.

Invariants: the number of fragments of a message is fixed when its first one is sent, since every entry carries
``total``; fragments are taken in order and together are the message.
"""

from __future__ import annotations

from dataclasses import dataclass

from gr_ros2.link.queues import Outgoing


@dataclass(slots=True, eq=False)
class Fragmented(Outgoing):
    """A message being sent.

    :param entry_id: its number on the wire, -1 until its first fragment leaves
    :param cut: most bytes that any remaining fragment needs to carry, 0 until the message is cut
    :param total: number of its fragments, 0 until the message is cut
    """

    entry_id: int = -1
    cut: int = 0
    total: int = 0

    def plan(self, cut: int) -> int:
        """Fix an equal cut if it is still open; returns the payload length of the next fragment."""
        if not self.index:
            self.cut = cut
            self.total = max(-(-len(self.payload) // cut), 1)
        return min(self.cut, self.remaining)

    @property
    def done(self) -> bool:
        """Whether the last fragment has left."""
        return 0 < self.total <= self.index
