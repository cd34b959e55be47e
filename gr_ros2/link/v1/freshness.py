"""Which topic goes first, so that the age of information at the other end stays low.

*Value.* Sending a message of ``c`` bytes reduces the age of its topic by ``g``, the time between its submission and
that of the newest message sent completely before. When the topics together need more than the channel's capacity, the
weighted mean age is lowest if each topic is sent with a period T, where T^2 is proportional to c / weight. Sending the
message with the greatest ``weight * g^2 / c`` first achieves that.

*Classes.* Messages of class latency go first, then default, then bulk in what is left.

*Turns.* Every ``turn_every``-th packet belongs to the topic whose last turn is longest ago.

Invariant: nothing starves: a topic that always has something waiting gets a turn within ``turn_every`` times the number
of topics.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.queues import Outgoing
from gr_ros2.wire import QOS_BULK, QOS_DEFAULT, QOS_LATENCY

RANK = {QOS_LATENCY: 0, QOS_DEFAULT: 1, QOS_BULK: 2}
"""The order of the classes."""


def value(message: Outgoing, before: float, cost: int) -> float:
    """The value of a message per byte sent.

    :param before: submission time of the previous sent message of its topic, s; -inf for none, which goes first
    :param cost: bytes that it takes in addition to its payload
    """
    younger = message.submitted - before
    return message.weight * younger * younger / (message.remaining + cost)


class Turns:
    """Decides whose turn it is: every ``turn_every``-th packet belongs to the topic whose last turn is longest ago."""

    def __init__(self, tuning: Tuning) -> None:
        self._tuning = tuning
        self._line: list[int] = []
        self._packets = 0

    def join(self, topic_id: int) -> None:
        """A topic has a message. The order of the first turns is that of the first messages."""
        if topic_id not in self._line:
            self._line.append(topic_id)

    def holder(self, pending: Collection[int]) -> int:
        """The topic to which the next packet belongs, one of ``pending``; -1 for none."""
        if self._packets % self._tuning.turn_every == self._tuning.turn_every - 1:
            for topic_id in self._line:
                if topic_id in pending:
                    return topic_id
        return -1

    def sent(self, topic_ids: Iterable[int]) -> None:
        """A packet left that belonged to these topics, or to none."""
        self._packets += 1
        for topic_id in topic_ids:
            if topic_id in self._line:
                self._line.remove(topic_id)
                self._line.append(topic_id)
