"""What both halves of an end have counted since the start.

Invariant: counters only grow, but for estimates of loss, which a packet that comes late takes back.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass(slots=True)
class SenderStats:
    """What left and what did not.

    ``refused`` is keyed by (topic_id, reason); ``missed`` are messages that the ROS graph lost before ``submit``;
    ``air`` counts packets by what they were spent on (:data:`gr_ros2.link.events.AirKind`).
    """

    submitted: Counter[int] = field(default_factory=Counter)
    refused: Counter[tuple[int, str]] = field(default_factory=Counter)
    sent: Counter[int] = field(default_factory=Counter)
    missed: Counter[int] = field(default_factory=Counter)
    air: Counter[str] = field(default_factory=Counter)
    repeats: int = 0
    packets: int = 0
    entries: int = 0
    payload_bytes: int = 0


@dataclass(slots=True)
class ReceiverStats:
    """What arrived and what did not.

    ``rejected`` by kind of WireError; ``dropped`` by name: own, not_for_us, duplicate, max_sources, unknown_topic, and
    early, which were kept until their sender had said how to open them; ``delivered``, what was given out, by
    (src_id, topic_id), and ``repaired``, those of them that were not all there at first; ``lost`` by (src_id, topic_id,
    reason); ``packet_loss_est`` from gaps in packet numbers and ``message_loss_est`` from gaps in entry ids and
    messages given up are estimates; ``unknown_gaps`` counts where a sender restarted or was silent for long, so that
    nothing is known of what was lost.
    """

    packets: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    delivered: Counter[tuple[int, int]] = field(default_factory=Counter)
    repaired: Counter[tuple[int, int]] = field(default_factory=Counter)
    lost: Counter[tuple[int, int, str]] = field(default_factory=Counter)
    repeats: int = 0
    packet_loss_est: int = 0
    unknown_gaps: int = 0
    message_loss_est: int = 0
