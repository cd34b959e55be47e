"""Version 0 cuts messages into fragments, equal ones but for the last, and chooses those of the next packet, as the
paper has it (section 5.2).

Invariants: the number of fragments of a message is fixed when its first one is sent, since every entry carries
``total``; fragments are taken in order and together are the message. The scheduler only plans: it changes only its own
order of topics and the cut of waiting messages that is not fixed yet. The sender executes the last plan or asks for
another one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gr_ros2.link.queues import Outgoing
from gr_ros2.paper.settings import PaperConfig
from gr_ros2.wire.v0 import V0


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


class Plan(NamedTuple):
    """The next packet: from each message, in this order, one further fragment.

    :param picks: messages to take one fragment of; a message may occur several times
    :param lengths: bytes of each of these fragments
    :param full: no further entry of ``min_fragment`` bytes would fit, so that waiting for more is useless
    """

    picks: tuple[Fragmented, ...]
    lengths: tuple[int, ...]
    full: bool


class PaperScheduler:
    """Round robin over topics: one entry per topic and packet, or with ``greedy`` several back to back.

    A topic that got an entry goes to the end of the queue; a topic whose next fragment did not fit keeps its place.
    """

    def __init__(self, packet_len: int, paper: PaperConfig) -> None:
        self.packet_len, self.paper = packet_len, paper
        self._line: list[int] = []

    def plan(self, queues: Mapping[int, Sequence[Fragmented]]) -> Plan | None:
        """The next packet's content from the messages waiting per topic id, or None if nothing is waiting."""
        pending = [topic_id for topic_id, queue in queues.items() if queue]
        if not pending:
            return None
        for topic_id in pending:
            if topic_id not in self._line:
                self._line.append(topic_id)
        picks: list[Fragmented] = []
        chosen: list[int] = []
        payload = 0
        for topic_id in self._line:
            for message in queues.get(topic_id, ()):
                cut = fragment_len(len(message.payload), len(pending), self.packet_len, self.paper.min_fragment)
                lengths = self._fitting(message, cut, len(picks), payload)
                picks += [message] * len(lengths)
                chosen += lengths
                payload += sum(lengths)
                whole = message.index + len(lengths) == message.total
                if not (self.paper.greedy and lengths and whole):
                    break
            if len(picks) == V0.max_entries:
                break
        room = V0.room(self.packet_len, len(picks), payload)
        return Plan(tuple(picks), tuple(chosen), room < self.paper.min_fragment)

    def _fitting(self, message: Fragmented, cut: int, entries: int, payload: int) -> list[int]:
        """Lengths of the next fragments of a message that fit beside ``entries`` with ``payload`` bytes."""
        lengths: list[int] = []
        length = message.plan(cut)
        index, remaining = message.index, message.remaining
        room, packet_len = V0.room, self.packet_len
        most = V0.max_entries if self.paper.greedy else 1
        while len(lengths) < most and index < message.total:
            if length > room(packet_len, entries + len(lengths), payload):
                break
            lengths.append(length)
            payload += length
            index += 1
            remaining -= length
            length = min(message.cut, remaining)
        return lengths

    def sent(self, plan: Plan) -> None:
        """The last plan was executed."""
        for topic_id in dict.fromkeys(message.topic_id for message in plan.picks):
            self._line.remove(topic_id)
            self._line.append(topic_id)


def fragment_len(size: int, pending_topics: int, packet_len: int, min_fragment: int) -> int:
    """Length of the fragments of a message of ``size`` bytes whose first entry is about to be sent.

    Two or more pending topics share packets, k = max(k*(2), k_min); a single one fills them. A message that would need
    more fragments than allowed at that k is cut to fill packets.
    """
    alone = V0.single_entry_payload(packet_len)
    if pending_topics < 2:
        return alone
    shared = max(V0.equal_entry_payload(packet_len, 2), min_fragment)
    return shared if -(-size // shared) <= V0.max_fragments else alone
