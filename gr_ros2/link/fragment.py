"""How a message is cut into fragments (the paper, section 5.2).

Law: the cut of a message is fixed when its first fragment is sent, since every entry carries ``total``; all fragments
but the last have the same length.
"""

from __future__ import annotations

from dataclasses import dataclass

from gr_ros2.config import MAX_PACKET_LEN, SINGLE_ENTRY_OVERHEAD
from gr_ros2.wire import MAX_TOTAL, Entry, equal_entry_payload, single_entry_payload


def largest_message(packet_len: int) -> int:
    """Bytes of the largest message that 255 entries can carry."""
    return MAX_TOTAL * single_entry_payload(packet_len)


def smallest_packet_len(size: int) -> int | None:
    """Smallest packet_len that carries a message of ``size`` bytes, None where none does."""
    packet_len = max(-(-size // MAX_TOTAL), 1) + SINGLE_ENTRY_OVERHEAD
    return packet_len if packet_len <= MAX_PACKET_LEN else None


def fragment_len(size: int, pending_topics: int, packet_len: int, min_fragment: int) -> int:
    """Length of the fragments of a message of ``size`` bytes whose first entry is about to be sent.

    Two or more pending topics share packets, k = max(k*(2), k_min); one alone fills them, k = packet_len - 13.
    A message that would need more than 255 entries at that k is cut at packet_len - 13.
    """
    alone = single_entry_payload(packet_len)
    if pending_topics < 2:
        return alone
    shared = max(equal_entry_payload(packet_len, 2), min_fragment)
    return shared if -(-size // shared) <= MAX_TOTAL else alone


@dataclass(slots=True, eq=False)
class Outgoing:
    """A message on its way out.

    :param serial: number of the submitted message; -1 for a repeat of a transient-local one
    :param qos: QoS class of its entries
    :param submitted: time of submission, s
    :param entry_id: its name on the air, -1 until it is cut
    :param cut: bytes per fragment, 0 until it is cut
    :param index: next fragment to send
    """

    serial: int
    topic_id: int
    payload: bytes
    qos: int
    submitted: float
    entry_id: int = -1
    cut: int = 0
    total: int = 0
    index: int = 0

    @property
    def started(self) -> bool:
        """Whether at least one fragment has left."""
        return self.index > 0

    def plan(self, cut: int) -> int:
        """Fix the cut if it is still open; returns the payload length of the next fragment."""
        if not self.started:
            self.cut = cut
            self.total = max(-(-len(self.payload) // cut), 1)
        return self.remaining if self.index == self.total - 1 else self.cut

    @property
    def remaining(self) -> int:
        """Bytes not yet sent."""
        return len(self.payload) - self.index * self.cut

    def next_entry(self) -> Entry:
        """Take the next fragment."""
        start = self.index * self.cut
        entry = Entry(self.topic_id, self.entry_id, self.index, self.total, self.payload[start : start + self.cut])
        self.index += 1
        return entry

    @property
    def done(self) -> bool:
        """Whether the last fragment has left."""
        return self.started and self.index >= self.total
