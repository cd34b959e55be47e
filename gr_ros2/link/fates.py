"""The possible fates of a message, as the loss ledger counts them.

Invariant: every message that was sent has exactly one fate. A fate is its name: it counts, compares and is written as
that text.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import Enum


class Fate(str, Enum):
    """What became of a message.

    :ivar end: where the fate is known: source, sink, or link where the records of both ends have to be joined
    :ivar colour: its colour in figures and on the dashboard
    :ivar words: its description, as a part of a sentence about messages
    """

    DELIVERED = "delivered", "sink", "#2a9d5c", "delivered"
    REPAIRED = "repaired", "sink", "#1d6b3f", "delivered after repair"
    LOST_ON_GRAPH = "lost_on_graph", "source", "#5b5b9a", "lost by the ROS graph of the source before the link had them"
    TOO_LARGE = "too_large", "source", "#c9a08a", "too large for the packet length"
    QUEUE_BOUND = "queue_bound", "source", "#f0a330", "dropped at the bound of the source's queue"
    OVERLOAD = "overload", "source", "#b0612c", "dropped at the source because the computer did not keep up"
    SUPERSEDED = "superseded", "source", "#88ccee", "replaced by a newer one before the first packet"
    STALE = "stale", "source", "#e7cf4f", "dropped at the source after their deadline"
    CANNOT_COMPLETE = "cannot_complete", "source", "#661100", "not begun, since they would have missed their deadline"
    ABANDONED = "abandoned", "source", "#332288", "given up half sent, since they would have missed their deadline"
    LOST_FRAGMENTS = "lost_fragments", "link", "#d62728", "lost because a fragment did not arrive"
    GIVEN_UP = "given_up", "link", "#aa3377", "given up, since what was lost of them did not come again in time"
    OVERTAKEN = "overtaken", "sink", "#ccbb44", "complete only after a newer one of their topic was delivered"
    EXPIRED = "expired", "sink", "#b565a7", "given up incomplete after the reassembly timeout"
    MEMORY = "memory", "sink", "#7f7f7f", "given up incomplete when the sink's memory was full"
    NOT_FRESH = "not_fresh", "sink", "#4b0082", "not taken, since they may have been withheld for longer than max_age_s"
    LATE = "late", "sink", "#cc6677", "not delivered, since they came after their deadline or an outage"
    NOT_FOR_US = "not_for_us", "sink", "#bbbbbb", "for another robot"
    UNSUPPORTED = "unsupported", "sink", "#17becf", "coded or encrypted in a way the sink cannot undo"
    UNKNOWN_DICTIONARY = "unknown_dictionary", "sink", "#999933", "coded with a dictionary the sink does not have"
    DAMAGED = "damaged", "sink", "#882255", "complete but not decodable"
    UNKNOWN_TOPIC = "unknown_topic", "sink", "#4477aa", "of a topic that its sender has not announced"
    SENDER_RESTARTED = "sender_restarted", "sink", "#666633", "incomplete when their sender restarted"
    PUBLISH_FAILED = "publish_failed", "sink", "#6b1d1d", "received whole but not published on the sink's ROS graph"
    NOT_TAKEN = "not_taken", "link", "#8c564b", "received whole but not taken by the sink"
    IN_FLIGHT = "in_flight", "link", "#9db8d9", "still in flight at the end"

    end: str
    colour: str
    words: str

    def __new__(cls, name: str, end: str, colour: str, words: str) -> Fate:
        fate = str.__new__(cls, name)
        fate._value_ = name
        fate.end, fate.colour, fate.words = end, colour, words
        return fate

    def __str__(self) -> str:
        return str(self.value)


ARRIVED = (Fate.DELIVERED, Fate.REPAIRED)
"""The fates of delivered messages."""


def arrived(fates: Mapping[str, int]) -> int:
    """How many of the messages with these fates were delivered."""
    return sum(fates.get(fate, 0) for fate in ARRIVED)


FATES = {fate.value: fate for fate in Fate}
"""The fates by name. Results of another version may have fates that are not here."""


def fate_order(ledgers: Iterable[Mapping[str, int]]) -> list[str]:
    """The ledger fates that occurred: delivered and repaired first, then the others by name, in_flight last."""
    found = {fate for ledger in ledgers for fate, count in ledger.items() if count}
    return sorted(found, key=lambda fate: (fate != Fate.DELIVERED, fate != Fate.REPAIRED, fate == Fate.IN_FLIGHT, fate))
