"""How a message is cut into fragments (the paper, section 5.2), at fixed lengths or to fit what room there is.

Invariants: the number of fragments of a message is fixed when its first one is sent, since every entry carries
``total``; fragments are taken in order and together are the message. Version 0 gives each entry its own length, so only
the paper's policy makes them equal (all but the last); a flexible cut may make each as long as the room found, as long
as what remains can still go in the entries that remain, at most ``cut`` bytes each and at least one.
"""

from __future__ import annotations

from dataclasses import dataclass

from gr_ros2.wire import Format


def fragment_len(size: int, pending_topics: int, packet_len: int, min_fragment: int, wire_format: Format) -> int:
    """Length of the fragments of a message of ``size`` bytes whose first entry is about to be sent.

    Two or more pending topics share packets, k = max(k*(2), k_min); one alone fills them. A message that would need
    more fragments than it may have at that k is cut to fill packets.
    """
    alone = wire_format.single_entry_payload(packet_len)
    if pending_topics < 2:
        return alone
    shared = max(wire_format.equal_entry_payload(packet_len, 2), min_fragment)
    return shared if -(-size // shared) <= wire_format.max_fragments else alone


@dataclass(slots=True, eq=False)
class Outgoing:
    """A message on its way out.

    :param serial: number of the submitted message
    :param payload: what goes on the air: the message, coded where the link compresses
    :param qos: QoS class of its entries
    :param submitted: time of submission, s
    :param weight: what its age counts beside that of other topics
    :param expires: time after which it is of no use, s
    :param repeat: it was sent before, and goes again for robots that come late (transient-local topics)
    :param entry_id: its name on the air, -1 until its first fragment leaves
    :param cut: most bytes that any fragment still to come needs to take, 0 until it is cut
    :param index: next fragment to send
    :param offset: bytes sent
    """

    serial: int
    topic_id: int
    payload: bytes
    qos: int
    submitted: float
    weight: float = 1.0
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
        """The next fragment, of that many bytes."""
        payload = self.payload[self.offset : self.offset + length]
        self.index += 1
        self.offset += length
        return payload

    @property
    def done(self) -> bool:
        """Whether the last fragment has left."""
        return 0 < self.total <= self.index
