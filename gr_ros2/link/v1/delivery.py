"""Which messages of one robot are delivered, once their topics are known and their turn has come.

Invariants: none is delivered twice, or after a later one of its topic; one that is older than its topic allows is not,
as far as that can be proven.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from zlib import crc32

from gr_ros2.link.fates import Fate
from gr_ros2.link.frames import MARK
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.order import Ready
from gr_ros2.relay.gain import EXPIRES_S
from gr_ros2.settings.config import NOBODY
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import CALLS_TYPE, options_of
from gr_ros2.wire.ages import NO_AGE, age_of
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import BROADCAST

_REACHED = 256
"""Arrivals remembered, from which the age of a command follows."""
_OVER = 256
"""Messages over other robots that are remembered, because the origin's own packets may bring them too."""
_NEVER = (-1, -1)
_MARKS = 64
"""Messages of a topic with several kept ones that may come between two hellos that name an older one."""
UNKNOWN_S = 2 * age_of(NO_AGE - 1)
"""s that are taken for an age that is unknown."""
SHORT_S = 5.0
"""s: of a topic with a shorter deadline the newest message is relayed."""
MAX_AGE_S = 15.0
"""Default of ``max_age_s``. How long ago a packet was sealed is known to the time from one hello to the echo of the
next: 2.7 s at most without loss, 7.6 s at 20 % and 14.7 s at 40 % of packets lost (in four minutes each)."""


@dataclass(frozen=True, slots=True)
class _Limits:
    """What holds for the messages of one row of a table of topics, by the settings here and by the row.

    :param withheld_s: s for which they may have been withheld; infinite for any time, None for ``DeliveryRules``'
    :param deadline_s: s for which they may be under way; infinite for any time
    """

    topic: AnnouncedTopic
    withheld_s: float | None
    deadline_s: float

    @classmethod
    def of(cls, topic: AnnouncedTopic, settings: Settings) -> _Limits:
        told = options_of(topic.name, settings.max_ages, settings.max_age_s)
        withheld_s = (None if topic.fresh else inf) if told == AUTO else told or inf
        return cls(topic, withheld_s, options_of(topic.name, settings.deadlines, topic.deadline_s) or inf)


class DeliveryRules:
    """The rules by which messages of one robot are delivered, wait, or are dropped.

    :param marks: CRC-32 of the newest messages of each latched topic, in the form in which they were transmitted: as
        many as its depth, or where that is more than 1, ``_MARKS`` more; what a hello has named counts as new again
    :param sealed_after: tells the time in s after which a packet was sealed; None where this cannot be proven
    :ivar newest: the newest message that was delivered, by topic
    """

    def __init__(
        self,
        settings: Settings,
        marks: dict[int, tuple[int, ...]],
        sealed_after: Callable[[int], float] | None = None,
    ) -> None:
        self.marks, self.sealed_after = marks, sealed_after
        self.newest: dict[int, tuple[int, int]] = {}
        self._own, self._settings = settings.src_id, settings
        self._silent_before = 0
        self._relays = settings.relay
        self._limits: dict[int, _Limits] = {}
        self._reached: deque[tuple[int, float, float]] = deque(maxlen=_REACHED)
        """Numbers that the robot's packets have reached, when, s, and the last time at which it is known to have stood
        there; -inf where it may have gone on long before."""
        self._over: dict[tuple[int, tuple[int, int]], None] = {}
        """Messages that came over other robots, by topic id and order: they may come again."""
        self._came: dict[int, float] = {}
        """When the newest message of a topic came, s, where it came over others."""
        self._direct: dict[int, tuple[int, int]] = {}
        """The newest message of a topic that its maker's own packets brought."""

    def reached(self, number: int, now: float, *, late: bool = False) -> None:
        """The robot has reached a number, as a packet shows that arrived at a time, s.

        :param late: it may have reached it long before
        """
        self._reached.append((number, now, -inf if late else now))

    def stands(self, number: int, now: float) -> None:
        """The newest number of the robot is still this one, as a packet shows that has no number of its own."""
        if self._reached and self._reached[-1][0] == number:
            self._reached[-1] = number, self._reached[-1][1], now
        else:
            self._reached.append((number, now, now))

    def made(self, number: int, now: float, repaired_s: float = inf, *, repaired: bool) -> float:
        """When what began in a packet of this robot was made at the latest, s: before a packet arrived that left after
        it. One that had to be repaired may have left right after the robot stood at the number before it, unless its
        robot repairs it no longer than it is of use: then it came in time if it came soon after it was missed. What it
        had waited at its robot is not counted.

        :param number: of the packet
        :param repaired_s: s for which its robot repairs the packet
        :param repaired: whether a packet with a part of it had to be repaired
        """
        before, after = now - UNKNOWN_S, now
        for reached, at, stood in reversed(self._reached):
            if reached >= number:
                after = at
            elif stood > -inf:
                before = stood
                break
        made = before if repaired and repaired_s == inf else after
        if repaired and self.sealed_after is not None:
            made = max(made, self.sealed_after(number))
        return made if made < now else now

    @property
    def withheld_s(self) -> float:
        """s for which packets may be held back before what they bring of other robots is refused."""
        return MAX_AGE_S * self._settings.slower

    def sealed(self, ready: Ready) -> float:
        """Time in s after which a message of this robot was sealed; infinite where that needs no proof."""
        return inf if self.sealed_after is None else self.sealed_after(ready.order[0])

    def overrule(self, number: int, now: float) -> bool:
        """The robot itself has reached a number: forget the messages with greater ones that came over others before.

        :param now: when that packet arrived, s; where it can be proven when it was sealed, that counts
        :return: whether none is left
        """
        since, doubted = now if self.sealed_after is None else self.sealed_after(number), False
        for topic_id in [topic_id for topic_id, order in self.newest.items() if order[0] > number]:
            if self._came.get(topic_id, -inf) > since:
                doubted = True
                continue
            for false in [(of, order) for of, order in self._over if of == topic_id and order[0] > number]:
                del self._over[false]
            over = (order for of, order in self._over if of == topic_id)
            self.newest[topic_id] = max(self._direct.get(topic_id, _NEVER), max(over, default=_NEVER))
            self._came.pop(topic_id, None)
        return not doubted

    def begin_anew(self, topic_id: int) -> None:
        """What came over others of a topic was false: what it put off is not passed over."""
        self._came.pop(topic_id, None)
        self.newest.pop(topic_id, None)
        if topic_id in self._direct:
            self.newest[topic_id] = self._direct[topic_id]

    def silent_before(self, number: int) -> None:
        """The robot was silent for long before its packets reached a number: what comes of earlier ones is that old."""
        self._silent_before = number

    def came_over(self, ready: Ready) -> bool:
        """A message has come over another robot; returns whether it is not known to have come so before."""
        name = ready.topic_id, ready.order
        if name in self._over:
            return False
        self._over[name] = None
        if len(self._over) > _OVER:
            del self._over[next(iter(self._over))]
        return True

    def adopt(self, far: DeliveryRules) -> None:
        """Go on from what has come over other robots."""
        self.newest.update(far.newest)
        self._came.update(far._came)
        self._over.update(far._over)

    def lacks(self, mark: tuple[int, int], number: int) -> bool:
        """Whether a latched message, named at a packet number, is not here, nor a newer one of its topic."""
        topic_id, value = mark
        held = self.marks.get(topic_id, ())
        if value in held:
            self.marks[topic_id] = (*(other for other in held if other != value), value)
            return False
        return self.newest.get(topic_id, (-1, -1))[0] <= number

    def is_for_us(self, topic: AnnouncedTopic) -> bool:
        """Whether messages of a topic are for this robot."""
        return topic.dst_id in (BROADCAST, self._own)

    def refusal(self, ready: Ready, topic: AnnouncedTopic, now: float) -> Fate | None:
        """Why a message is not delivered; None for one that is, or that is here already."""
        if topic.dst_id != BROADCAST and self._own not in (topic.dst_id, NOBODY):
            return Fate.NOT_FOR_US
        limits = self._limits_of(topic)
        withheld_s = self._withheld_s(limits, over=ready.over is not None)
        if withheld_s < inf:
            oldest = self.sealed(ready) if ready.over is None else min(ready.sealed, ready.made)
            if now - oldest > withheld_s:
                return Fate.NOT_FRESH
        under_way_s = now - ready.made
        if under_way_s > limits.deadline_s or under_way_s > ready.limit_s:
            return Fate.LATE
        before = ready.over is None and ready.order[0] < self._silent_before
        if before and (topic.fresh or not (topic.reliable or topic.latched)):
            return Fate.LATE
        if ready.order > self.newest.get(ready.topic_id, _NEVER) or (ready.topic_id, ready.order) in self._over:
            return None
        return passed_over(topic) if self._passed(ready) else None

    def takes(self, ready: Ready, topic: AnnouncedTopic, now: float) -> bool:
        """Note a message that nothing refuses; returns whether it is new."""
        if ready.order <= self.newest.get(ready.topic_id, _NEVER) and self._passed(ready):
            return False
        self.newest[ready.topic_id] = ready.order
        if ready.over is not None:
            self._came[ready.topic_id] = now
        elif self._relays:
            self._direct[ready.topic_id] = ready.order
            self._came.pop(ready.topic_id, None)
        if topic.latched:
            mark, marks = crc32(ready.payload), self.marks.get(ready.topic_id, ())
            if mark in marks and not topic.codec.startswith(MARK):  # a frame may be needed again
                return False
            most = topic.depth + _MARKS if topic.depth > 1 else 1
            self.marks[ready.topic_id] = (*marks, mark)[-most:]
        return True

    def limit_s(self, topic: AnnouncedTopic) -> float:
        """Age in s at which a message of a topic that came over others is of no more use."""
        limits = self._limits_of(topic)
        return min(self._withheld_s(limits, over=True), limits.deadline_s)

    def deadline_s(self, topic: AnnouncedTopic) -> float:
        """s for which a message of a topic may be under way, as this robot or else the one that sends it says; infinite
        for any time."""
        return self._limits_of(topic).deadline_s

    def _withheld_s(self, limits: _Limits, *, over: bool) -> float:
        """s for which messages may have been withheld. The age of one that came over others also has what it waited at
        its origin, which its deadline allows.

        :param over: whether they came over others
        """
        if limits.withheld_s is not None:
            return limits.withheld_s
        most_s = self.withheld_s
        return max(most_s, limits.deadline_s) if over and limits.deadline_s < inf else most_s

    def _limits_of(self, topic: AnnouncedTopic) -> _Limits:
        limits = self._limits.get(topic.topic_id)
        if limits is None or limits.topic is not topic:
            limits = self._limits[topic.topic_id] = _Limits.of(topic, self._settings)
        return limits

    def _passed(self, ready: Ready) -> bool:
        """Whether a message whose order is not the newest of its topic comes after a later one."""
        return ready.over is None or min(ready.made, ready.sealed) <= self._came.get(ready.topic_id, inf) + EXPIRES_S


def for_all_in_order(topic: AnnouncedTopic) -> bool:
    """Whether all messages of a topic are to reach all robots, each after all earlier ones. Of one whose messages are
    of no use soon, the newest counts."""
    whole = topic.reliable and topic.dst_id == BROADCAST and topic.type_name != CALLS_TYPE
    return whole and not 0 < topic.deadline_s < SHORT_S


def passed_over(topic: AnnouncedTopic) -> Fate:
    """The fate of a message that is not delivered because a later one of its topic was."""
    return Fate.GIVEN_UP if topic.reliable else Fate.OVERTAKEN
