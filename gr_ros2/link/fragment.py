"""How a message is cut into fragments (the paper, section 5.2): at fixed lengths, or to fit the free space of a packet.

Invariants: the number of fragments of a message is fixed when its first one is sent, since every entry carries
``total``; fragments are taken in order and together are the message. Version 0 gives each entry its own length, so only
the paper's policy makes them equal (all but the last); a flexible cut may fill the free space with each fragment,
provided that the remaining bytes still fit the remaining entries, with at most ``cut`` bytes and at least one byte
each.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True, eq=False)
class Outgoing:
    """A message being sent.

    :param serial: number of the submitted message
    :param payload: the bytes that are sent: the message, coded if the link compresses
    :param qos: QoS class of its entries
    :param submitted: time of submission, s
    :param weight: weight of its age relative to other topics
    :param lifespan_s: s after which the message is useless, where its queue's deadline is later
    :param expires: time after which the message is useless, s
    :param repeat: the message was sent before, and is sent again for robots that join late (transient-local topics)
    :param entry_id: its number on the wire, -1 until its first fragment leaves
    :param cut: most bytes that any remaining fragment needs to carry, 0 until the message is cut
    :param index: next fragment to send
    :param offset: bytes sent
    """

    serial: int
    topic_id: int
    payload: bytes
    qos: int
    submitted: float
    weight: float = 1.0
    lifespan_s: float = float("inf")
    expires: float = float("inf")
    repeat: bool = False
    entry_id: int = -1
    cut: int = 0
    total: int = 0
    index: int = 0
    offset: int = 0

    @property
    def started(self) -> bool:
        """Whether at least one fragment has left."""
        return self.index > 0

    def plan(self, cut: int) -> int:
        """Fix an equal cut if it is still open; returns the payload length of the next fragment."""
        if not self.index:
            self.cut = cut
            self.total = max(-(-len(self.payload) // cut), 1)
        return min(self.cut, len(self.payload) - self.offset)

    @property
    def remaining(self) -> int:
        """Bytes not yet sent."""
        return len(self.payload) - self.offset

    def take(self, length: int) -> bytes:
        """The next fragment, of this many bytes."""
        payload = self.payload[self.offset : self.offset + length]
        self.index += 1
        self.offset += length
        return payload

    @property
    def done(self) -> bool:
        """Whether the last fragment has left."""
        return 0 < self.total <= self.index
