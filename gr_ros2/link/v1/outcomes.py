"""What comes of the packets that a robot receives: the events of one call, counted in its statistics, and facts."""

from __future__ import annotations

from gr_ros2.link.events import Delivered, Lost, ReceiverEvent
from gr_ros2.link.fates import Fate
from gr_ros2.link.stats import ReceiverStats
from gr_ros2.link.v1.facts import Fact


class Outcomes:
    """The events and facts since they were last taken.

    :ivar stats: what arrived and what did not
    :ivar events: in order
    :ivar facts: what matters to what this robot sends, in order
    """

    def __init__(self) -> None:
        self.stats = ReceiverStats()
        self.events: list[ReceiverEvent] = []
        self.facts: list[Fact] = []

    def take(self) -> list[ReceiverEvent]:
        """The events, which are forgotten here."""
        events, self.events = self.events, []
        return events

    def take_facts(self) -> list[Fact]:
        """The facts, which are forgotten here."""
        facts, self.facts = self.facts, []
        return facts

    def delivered(self, event: Delivered) -> None:
        """A message is complete."""
        self.events.append(event)
        topic = event.src_id, event.topic_id
        self.stats.delivered[topic] += 1
        self.stats.repaired[topic] += event.repaired

    def lost(self, event: Lost) -> None:
        """A message will not be delivered."""
        self.events.append(event)
        if event.reason is Fate.NOT_FOR_US:  # nothing is missed here
            self.stats.dropped["not_for_us"] += 1
            return
        self.stats.lost[event.src_id, event.topic_id, str(event.reason)] += 1
        self.stats.message_loss_est += 1
