"""A scheduler that keeps the age of information at the other end low: it chooses the fragments of the next packet.

*Value.* Sending a message of ``c`` bytes reduces the age of its topic by ``g``, the time between its submission and
that of the newest message sent completely before. When the topics together need more than the channel's capacity, the
weighted mean age is lowest if each topic is sent with a period T, where T^2 is proportional to c / weight. Sending the
message with the greatest ``weight * g^2 / c`` first achieves that.

*Classes.* Messages of class latency go first, then default, then bulk in what is left.

*Turns.* Every ``TURN``-th packet belongs to the topic whose last turn is longest ago, whatever its class. That topic
gets the space that it needs, but ``reserve`` bytes stay free for a message of class latency.

*Cuts.* A fragment fills the free space. ``total`` is fixed at the first fragment, so it includes slack: the rest of a
message never needs fragments of more than ``cut`` bytes, and ``cut`` is smaller than a packet's space by that reserve.

Invariants: a message of class latency that waits alone in its class has an entry in the next packet; a topic that
always has something waiting gets a turn within TURN times the number of topics, and a message needs no more turns than
it has fragments, at most 1 + ceil(size / cut): nothing starves.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from heapq import heapify, heappop, heappush

from gr_ros2.config import SourceConfig
from gr_ros2.link.fragment import Outgoing
from gr_ros2.link.schedule import Plan
from gr_ros2.registry import Registry
from gr_ros2.wire import QOS_BULK, QOS_DEFAULT, QOS_LATENCY, Format

TURN = 4
"""One packet in this many belongs to the topic whose last turn is longest ago."""
FIRST_AGE_S = 1.0
"""Age in s that a topic is assumed to have when its first message arrives."""
LARGE = 4
"""A message of this many packets or more is cut with slack, so that it can fill the space that others leave."""

RANK = {QOS_LATENCY: 0, QOS_DEFAULT: 1, QOS_BULK: 2}
"""The order of the classes."""

Queues = Mapping[int, Sequence[Outgoing]]


def value(message: Outgoing, before: float, cost: int) -> float:
    """The value of a message per byte sent.

    :param before: submission time of the previous sent message of its topic, s
    :param cost: bytes that it takes in addition to its payload
    """
    younger = message.submitted - before
    return message.weight * younger * younger / (message.remaining + cost)


class Turns:
    """Decides whose turn it is: every ``TURN``-th packet belongs to the topic whose last turn is longest ago."""

    def __init__(self) -> None:
        self._line: list[int] = []
        self._packets = 0

    def join(self, topic_id: int) -> None:
        """A topic has a message. The order of the first turns is that of the first messages."""
        if topic_id not in self._line:
            self._line.append(topic_id)

    def holder(self, pending: Collection[int]) -> int:
        """The topic to which the next packet belongs, one of ``pending``; -1 for none."""
        if self._packets % TURN != TURN - 1:
            return -1
        return next((topic_id for topic_id in self._line if topic_id in pending), -1)

    def sent(self, holder: int) -> None:
        """A packet left that belonged to this topic, or to none."""
        self._packets += 1
        if holder >= 0:
            self._line.remove(holder)
            self._line.append(holder)


class _Packing:
    """A packet being filled. ``keep``: payload bytes that must stay free for one more entry."""

    def __init__(self, wire_format: Format, packet_len: int) -> None:
        self._room = wire_format.room
        self._packet_len = packet_len
        self.picks: list[Outgoing] = []
        self.lengths: list[int] = []
        self._payload = 0
        self.keep = 0

    def room(self) -> int:
        """Payload bytes a further entry may have; 0 or negative where no entry fits."""
        return self._room(self._packet_len, len(self.picks) + (self.keep > 0), self._payload + self.keep)

    def add(self, message: Outgoing, length: int) -> None:
        self.picks.append(message)
        self.lengths.append(length)
        self._payload += length


class FreshnessScheduler:
    """The scheduler that the head of this module describes.

    :param registry: says which topics are of class latency
    """

    def __init__(self, config: SourceConfig, registry: Registry, wire_format: Format) -> None:
        self.config = config
        self._format = wire_format
        self._share = wire_format.entry_cost
        self._single = wire_format.single_entry_payload(config.packet_len)
        self._half = max(wire_format.equal_entry_payload(config.packet_len, 2), 0)
        self._alone = len(registry) == 1
        self._latency = {topic.topic_id for topic in registry if topic.options.qos == "latency"}
        self._urgent = min(config.min_fragment, self._half)
        """Bytes of the largest message of class latency so far, at most half a packet."""
        self._newest: dict[int, float] = {}
        """Per topic, submission time of the newest message sent completely."""
        self._turns = Turns()
        self._holder = -1
        """The topic to which the turn of the planned packet belongs."""

    def plan(self, queues: Queues) -> Plan | None:
        pending = [topic_id for topic_id, queue in queues.items() if queue]
        if not pending:
            return None
        for topic_id in pending:
            self._turns.join(topic_id)
        holder = self._holder = self._turns.holder(pending)
        for topic_id in self._latency.intersection(pending):
            self._urgent = max(self._urgent, min(len(queues[topic_id][0].payload), self._half))
        packing = _Packing(self._format, self.config.packet_len)
        if holder >= 0:
            others = [topic_id for topic_id in pending if topic_id != holder]
            packing.keep = self._needs(queues[holder][0])
            self._fill(packing, queues, [topic_id for topic_id in others if queues[topic_id][0].qos == QOS_LATENCY])
            packing.keep = 0
            self._fill(packing, queues, [holder])
            self._fill(packing, queues, [topic_id for topic_id in others if queues[topic_id][0].qos != QOS_LATENCY])
        else:
            self._fill(packing, queues, pending)
        full = packing.room() < self.config.min_fragment
        return Plan(tuple(packing.picks), tuple(packing.lengths), full)

    def sent(self, plan: Plan) -> None:
        self._turns.sent(self._holder)
        for message in plan.picks:
            if message.done:
                self._newest[message.topic_id] = max(message.submitted, self._newest.get(message.topic_id, 0.0))

    def _fill(self, packing: _Packing, queues: Queues, topic_ids: Iterable[int]) -> None:
        """Add fragments, the most valuable messages of the most urgent class first, those of a topic in order."""
        heap = []
        for topic_id in topic_ids:
            head = queues[topic_id][0]
            before = self._newest.get(topic_id, head.submitted - FIRST_AGE_S)
            heap.append((RANK[head.qos], -value(head, before, self._share), topic_id, 0))
        heapify(heap)
        while heap and packing.room() > 0:
            _, _, topic_id, position = heappop(heap)
            queue = queues[topic_id]
            message = queue[position]
            if self._add(packing, message) and position + 1 < len(queue):
                following = queue[position + 1]
                worth = value(following, message.submitted, self._share)
                heappush(heap, (RANK[following.qos], -worth, topic_id, position + 1))

    def _add(self, packing: _Packing, message: Outgoing) -> bool:
        """Add as much of a message as fits; returns whether that was all of it."""
        if not message.started and not self._cut(packing, message):
            return False
        remaining = message.remaining
        left = message.total - message.index
        while left:
            # Each fragment still to come takes `cut` bytes at most and one at least, so this one must, and may, take:
            least = max(remaining - (left - 1) * message.cut, min(remaining, 1))
            most = remaining - (left - 1)
            length = min(packing.room(), most)
            if length < least or length < min(most, message.cut, self.config.min_fragment) or packing.room() < 0:
                return False
            packing.add(message, length)
            remaining -= length
            left -= 1
        return True

    def _cut(self, packing: _Packing, message: Outgoing) -> bool:
        """Fix ``total`` and ``cut`` of a message that would start in this packet; False if it is better to wait."""
        size, room = len(message.payload), packing.room()
        if size <= room:
            message.total, message.cut = 1, size
            return True
        if room < self.config.min_fragment:
            return False
        chosen = message.qos == QOS_LATENCY or message.topic_id == self._holder or not packing.picks
        packets = -(-size // self._single)
        if not chosen and 1 < packets < LARGE and -(-(size - room) // self._single) == packets:
            return False  # it would be older when it is complete, and need as many packets
        cut = self._most(message)
        most = self._format.max_fragments
        if -(-(size - room) // cut) >= most:
            cut = -(-(size - room) // (most - 1))
        message.total, message.cut = 1 + -(-(size - room) // cut), cut
        return cut <= self._single

    def _most(self, message: Outgoing) -> int:
        """Most bytes that a later fragment of a message should need."""
        cut = self._single
        if self._latency - {message.topic_id} and self._half:
            cut -= self._urgent + self._share
        if not self._alone and len(message.payload) > (LARGE - 1) * self._single:
            cut = min(cut, 3 * self._single // 4)
        return max(cut, 1)

    def _needs(self, message: Outgoing) -> int:
        """Bytes of space that the next fragment of a message needs in its turn."""
        if message.started:
            return min(message.cut, message.remaining - (message.total - message.index - 1))
        return max(min(len(message.payload), self._most(message)), 1)
