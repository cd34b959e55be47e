"""The messages of one start of one robot, from the entries of packets that are known to messages that come out.

Which messages wait for an earlier one says ``order``, which for the table of topics says ``announced``, and which are
delivered says ``delivery``. Messages of topics without reliable publishers are delivered as they arrive, but never
after a later message of the same topic; over several radios ``overtaking`` says which wait for an earlier one.

Invariants: no message is delivered twice, or after a later message of its topic; every message of which a part arrived
ends in one Delivered or Lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import inf
from typing import Protocol

from gr_ros2.core.errors import CodecError, WireError
from gr_ros2.link.events import Announced, Delivered, Lost
from gr_ros2.link.fates import FATES, Fate
from gr_ros2.link.key import Key
from gr_ros2.link.v1.announced import AnnouncedTopics
from gr_ros2.link.v1.delivery import UNKNOWN_S, DeliveryRules, for_all_in_order, passed_over
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.order import Order, Ready
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.link.v1.overtaking import Overtaking
from gr_ros2.link.v1.reassembly import PartialMessage, Reassembly
from gr_ros2.link.v1.reports import Reporter
from gr_ros2.wire.control import Control, Waited
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import CARRIED_TOPIC, TABLE_TOPIC, EntryV1, Part

_INCOMPLETE_S = 60.0
"""s that an incomplete message waits for its next fragment, unless its sender repairs it until it is here."""


def _waited(entries: Sequence[EntryV1]) -> Waited | None:
    """What a packet tells, behind its messages, of how long these have waited."""
    for entry in reversed(entries):
        if isinstance(entry, Part):
            return None
        if isinstance(entry, Waited):
            return entry
    return None


class Passing(Protocol):
    """What is told of messages that may be sent on."""

    def direct(self, src_id: int, boot: int, ready: Ready, now: float) -> None:
        """A message has come from the robot that made it."""

    def receive(self, via: int, ready: Ready, now: float, *, withheld: bool = False) -> None:
        """A message of another robot has come over one that is heard.

        :param withheld: the packet may have been held back too long for what has to be fresh
        """

    def in_order(self, messages: ArrivingMessages, ready: Ready, late: int) -> None:
        """A message of a reliable topic for all has come out.

        :param late: how many messages of its topic robots get that come later
        """


class ArrivingMessages:
    """See the module.

    :param of: id and boot number of the robot
    :param reports: of its packets
    :param outcomes: takes what comes of its messages
    :param control: called with entries that are not messages
    :param relaying: is told of messages that came, where they are relayed
    :param overtaking: which messages of other topics do; None where packets come in order
    :ivar order: which messages wait for an earlier one
    :ivar announced: the topics of the robot
    :ivar deliveries: which messages are delivered
    :ivar reassembly: the incomplete ones
    """

    def __init__(
        self,
        of: tuple[int, int],
        settings: Settings,
        *,
        order: Order,
        overtaking: Overtaking | None,
        announced: AnnouncedTopics,
        deliveries: DeliveryRules,
        reassembly: Reassembly,
        reports: Reporter,
        outcomes: Outcomes,
        control: Callable[[Control], None],
        relaying: Passing | None,
    ) -> None:
        self.src_id, self.boot = of
        self.order, self.announced, self.deliveries, self.reassembly = order, announced, deliveries, reassembly
        self._settings, self._reports, self._overtaking = settings, reports, overtaking
        self._outcomes, self._stats = outcomes, outcomes.stats
        self._control, self._relaying = control, relaying
        self._now, self._began = 0.0, inf

    def take(
        self,
        number: int,
        entries: Sequence[EntryV1],
        qos: int,
        now: float,
        began: float,
        *,
        repaired: bool,
        of_use: bool = True,
    ) -> None:
        """Process the entries of a packet that is known now.

        :param began: when the packet that made it known began to arrive, s
        :param of_use: whether it is known that the packet was of use when it was repaired
        """
        self._now, self._began = now, began
        self.order.contents.learn(number)
        repaired_s = self._repaired_s(entries) if repaired and of_use else inf
        waited = _waited(entries)
        for place, entry in enumerate(entries):
            if not isinstance(entry, Part):
                self._control(entry)
                continue
            waited_s = 0.0 if waited is None else min(waited.age_s(place), UNKNOWN_S)
            topic = self.announced.topics.get(entry.topic_id)
            if topic is None or topic.reliable or topic.latched:
                self._reports.confirm()
            if entry.whole:
                ready = Ready(entry.topic_id, (number, place), entry.payload, qos, entry.coded, repaired)
                self._arrived(ready, repaired_s, waited_s)
            else:
                self._fragment(entry, number, place, qos, repaired=repaired, waited_s=waited_s)

    def _fragment(self, part: Part, number: int, place: int, qos: int, *, repaired: bool, waited_s: float) -> None:
        if (number, place) < self.deliveries.newest.get(part.topic_id, (0, 0)) or number < part.back:
            self._stats.dropped["overtaken"] += 1
            return
        made = self.deliveries.made(number, self._began, repaired=repaired) - waited_s if waited_s else inf
        whole = self.reassembly.add(part, number, place, repaired=repaired, now=self._now, made=made)
        for partial in self.reassembly.overflowing():
            self._lose(partial, Fate.MEMORY)
        if whole is None:
            return
        payload = whole.payload()
        if payload is None:
            self._lose(whole, Fate.DAMAGED)
            return
        ready = Ready(whole.topic_id, whole.order, payload, qos, whole.coded, whole.repaired)
        ready.made = whole.made
        self._arrived(ready)

    def _repaired_s(self, entries: Iterable[EntryV1]) -> float:
        """s for which the sender repairs a packet: as long as one of its messages is of use."""
        rows = (self.announced.topics.get(entry.topic_id) for entry in entries if isinstance(entry, Part))
        return max((inf if row is None else row.deadline_s or inf for row in rows), default=inf)

    def _arrived(self, ready: Ready, repaired_s: float = inf, waited_s: float = 0.0) -> None:
        """A message is complete.

        :param repaired_s: s for which its sender repairs the packet that brought it
        :param waited_s: s for which it had waited at its sender when that packet left
        """
        topic = self.announced.topics.get(ready.topic_id)
        if repaired_s < inf and topic is not None and repaired_s > self.deliveries.deadline_s(topic):
            repaired_s = inf
        left = self.deliveries.made(ready.order[0], self._began, repaired_s, repaired=ready.repaired)
        ready.made = min(ready.made, left - waited_s)
        if ready.topic_id > TABLE_TOPIC:
            if ready.topic_id == CARRIED_TOPIC and ready.order[0] > self.order.low:
                self.order.wait(ready, self._now)
            else:
                self._of_another(ready)
            return
        if ready.topic_id == TABLE_TOPIC:
            self.announced.came(ready.order[0], self._now)
            self._table(ready.payload, ready.order)
        if self._relaying is not None:
            if ready.topic_id == TABLE_TOPIC:
                ready.payload = self.announced.table
            self._relaying.direct(self.src_id, self.boot, ready, self._now)
        if ready.topic_id != TABLE_TOPIC:
            self._known(ready)

    def _known(self, ready: Ready) -> None:
        """Deliver a message as soon as its topic is known. One of a reliable topic waits for those before it, unless
        robots that kept all of them have handed it on."""
        topic = self.announced.topic_of(ready)
        if topic is None:
            self._await_table(ready)
        elif topic.reliable and not ready.carried and not self.order.passes(ready):
            self.order.wait(ready, self._now)
        elif not self._may_overtake(ready, topic):
            self._deliver(ready, topic)

    def _may_overtake(self, ready: Ready, topic: AnnouncedTopic) -> bool:
        """Whether a message waits because one before it may have been overtaken."""
        if self._overtaking is None or topic.reliable or topic.fresh or ready.over is not None:
            return False
        return self._overtaking.holds(ready, self._now)

    def _await_table(self, ready: Ready) -> None:
        for lost in self.announced.wait(ready):
            self.give_up([lost], self.announced.unknown(lost))

    def _of_another(self, ready: Ready) -> None:
        """A message of another robot."""
        if self._relaying is None:
            self._stats.dropped["relayed"] += 1
            return
        ready.sealed = self.deliveries.sealed(ready)
        withheld = self._now - ready.sealed > self.deliveries.withheld_s
        self._relaying.receive(self.src_id, ready, self._now, withheld=withheld)

    def over_another(self, ready: Ready, now: float) -> None:
        """Take a message of this robot that has come over another one."""
        self._now = now
        if ready.topic_id == TABLE_TOPIC:
            self._table(ready.payload, ready.order, direct=False)
        else:
            if not self.deliveries.came_over(ready) and not self.order.told_again(ready):
                self._stats.repeats += 1
                return
            topic = self.announced.topics.get(ready.topic_id)
            begins = topic is not None and topic.latched and ready.topic_id not in self.deliveries.newest
            if begins or (topic is not None and not for_all_in_order(topic)):
                ready.after = (0, 0)  # it follows whatever is here
            self._known(ready)

    def adopt(self, far: ArrivingMessages, now: float) -> None:
        """Go on from what has come of this start over other robots."""
        self._now = now
        self.deliveries.adopt(far.deliveries)
        self.order.reached.update(far.order.reached)
        self.order.passed_on.update(far.order.passed_on)
        for ready in far.order.without(()):
            self.order.wait(ready, now)
        if not self.announced.topics:
            self.announced = far.announced
        for ready in far.announced.waiting():
            self._known(ready)

    def release(self, due: Iterable[Ready], now: float) -> None:
        """Messages need not wait for earlier ones any more."""
        self._now = now
        for ready in due:
            if ready.topic_id == CARRIED_TOPIC:
                self._of_another(ready)
            elif (topic := self.announced.topic_of(ready)) is None:
                self._await_table(ready)
            else:
                self._deliver(ready, topic)

    def _deliver(self, ready: Ready, topic: AnnouncedTopic) -> None:
        refusal = self.deliveries.refusal(ready, topic, self._now)
        if refusal is not None:
            self.give_up([ready], refusal)
            return
        new = self.deliveries.takes(ready, topic, self._now)
        for partial in self.reassembly.overtaken(ready.topic_id, ready.order[0]):
            self._lose(partial, passed_over(topic))
        if not new:
            self._stats.repeats += 1
            return
        if self._relaying is not None and for_all_in_order(topic) and not ready.carried:
            self.order.reached[ready.topic_id] = ready.order
            self._relaying.in_order(self, ready, max(topic.depth, 1) * topic.latched)
        try:
            payload = self.announced.decode(ready) if ready.coded else ready.payload
        except CodecError as error:
            self.give_up([ready], FATES[error.fate])
            return
        qos = ready.qos if ready.qos >= 0 else topic.qos
        key = Key(self.boot, ready.order[0], ready.order[1])
        self._outcomes.delivered(
            Delivered(
                self.src_id,
                ready.topic_id,
                payload,
                qos,
                key,
                ready.repaired,
                ready.hops,
                ready.over,
                self._now - ready.made,
            )
        )

    def _table(self, payload: bytes, order: tuple[int, int], *, direct: bool = True) -> None:
        try:
            topics = self.announced.take(payload, order, direct=direct)
        except WireError:
            self._stats.dropped["bad_table"] += 1
            return
        if topics is None:
            return
        for ready in self.order.without({*self.announced.topics, CARRIED_TOPIC}):
            self._await_table(ready)  # its topic is not offered any more
        self._outcomes.events.append(Announced(self.src_id, topics))
        for ready in self.announced.waiting():
            self._known(ready)

    def expire(self, now: float) -> None:
        """Give up incomplete messages that nothing came of for long."""
        if self.reassembly.next_timeout() is None:
            return
        for partial in self.reassembly.expired(now, self._incomplete_s, self._repaired_until_here):
            self._lose(partial, Fate.EXPIRED)

    def next_expiry(self) -> float | None:
        """When :meth:`expire` has something to do."""
        waiting = self.reassembly.next_timeout()
        return None if waiting is None else waiting + self._incomplete_s

    @property
    def _incomplete_s(self) -> float:
        return _INCOMPLETE_S * self._settings.slower

    def _repaired_until_here(self, partial: PartialMessage) -> bool:
        if partial.topic_id > TABLE_TOPIC:  # of another robot
            return self.order.told and self.order.wanted <= partial.newest[0]
        topic = self.announced.topics.get(partial.topic_id)
        return self.order.told and topic is not None and topic.reliable

    def close(self, reason: Fate) -> None:
        """Give up everything that is not delivered."""
        for partial in self.reassembly.clear():
            self._lose(partial, reason)
        self.give_up(self.order.without(()), reason)
        for ready in self.announced.waiting():
            self.give_up([ready], self.announced.unknown(ready))

    def _lose(self, partial: PartialMessage, reason: Fate) -> None:
        key = Key(self.boot, partial.begin, partial.place)
        self._outcomes.lost(Lost(self.src_id, partial.topic_id, reason, key))

    def give_up(self, messages: Iterable[Ready], reason: Fate) -> None:
        """Messages are not delivered."""
        for ready in messages:
            self._outcomes.lost(Lost(self.src_id, ready.topic_id, reason, Key(self.boot, *ready.order)))
