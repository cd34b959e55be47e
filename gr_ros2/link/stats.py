"""What both halves of an end have counted since the start.

Invariant: counters only grow. The exceptions are the estimates of loss: a packet that arrives late lowers them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass(slots=True)
class SenderStats:
    """Counters of the sending half.

    ``refused`` is keyed by (topic_id, reason); ``missed`` are messages that the ROS graph lost before ``submit``;
    ``ended`` counts messages for one robot by (topic_id, whether that robot has told that it has them), where messages
    are relayed; ``air`` counts packets by their use (:data:`gr_ros2.link.events.AirKind`).
    """

    submitted: Counter[int] = field(default_factory=Counter)
    refused: Counter[tuple[int, str]] = field(default_factory=Counter)
    sent: Counter[int] = field(default_factory=Counter)
    missed: Counter[int] = field(default_factory=Counter)
    ended: Counter[tuple[int, bool]] = field(default_factory=Counter)
    air: Counter[str] = field(default_factory=Counter)
    repeats: int = 0
    packets: int = 0
    entries: int = 0
    payload_bytes: int = 0


@dataclass(slots=True)
class ReceiverStats:
    """Counters of the receiving half.

    ``rejected`` by kind of WireError; ``dropped`` by name: own, not_for_us, duplicate, late (older than what is
    remembered), max_sources, unknown_topic, early (kept until their sender had said how to open them), and of what
    is in them: overtaken (fragments of a message older than one delivered), bad_table (cannot be read);
    ``delivered`` by (src_id, topic_id); ``repaired``, those delivered messages of which a packet was lost at first;
    ``lost`` by (src_id, topic_id, reason). Two counters are estimates: ``missed``, the packets of each robot that
    were lost since it was heard, from gaps in their numbers, repaired or not, and ``message_loss_est`` from gaps in
    entry ids and messages given up. ``unknown_gaps`` counts how often a sender restarted or was silent for long, so
    that the number of lost packets is unknown.
    """

    packets: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    delivered: Counter[tuple[int, int]] = field(default_factory=Counter)
    repaired: Counter[tuple[int, int]] = field(default_factory=Counter)
    lost: Counter[tuple[int, int, str]] = field(default_factory=Counter)
    repeats: int = 0
    missed: Counter[int] = field(default_factory=Counter)
    unknown_gaps: int = 0
    message_loss_est: int = 0

    @property
    def packet_loss_est(self) -> int:
        """Packets of all robots that were lost."""
        return self.missed.total()
