"""Which messages of one robot are delivered, once their topics are known and their turn has come.

Invariants: none is delivered twice, or after a later one of its topic; one that is older than its topic allows is not,
as far as that can be proven.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from zlib import crc32

from gr_ros2.link.fates import Fate
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.order import Ready
from gr_ros2.settings.commands import COMMAND_DEADLINE_S, is_command
from gr_ros2.settings.config import NOBODY
from gr_ros2.settings.fields import AUTO
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import BROADCAST

_REACHED = 256
"""Arrivals remembered, from which the age of a command follows."""
_OVER = 256
"""Messages over other robots that are remembered, because the origin's own packets may bring them too."""
MAX_AGE_S = 15.0
"""Default of ``max_age_s``. How long ago a packet was sealed is known to the time from one hello to the echo of the
next: 2.7 s at most without loss, 7.6 s at 20 % and 14.7 s at 40 % of packets lost (in four minutes each)."""


class DeliveryRules:
    """See the module.

    :param marks: CRC-32 of the newest messages of each latched topic, in the form in which they were transmitted: as
        many as its depth
    :ivar sealed_after: tells the time in s after which a packet was sealed; None where this cannot be proven
    :ivar newest: the newest message that was delivered, by topic
    """

    def __init__(self, settings: Settings, marks: dict[int, tuple[int, ...]]) -> None:
        self.marks = marks
        self.sealed_after: Callable[[int], float] | None = None
        self.newest: dict[int, tuple[int, int]] = {}
        self._own = settings.src_id
        self._max_age_s, self._max_ages = settings.max_age_s, settings.max_ages
        self._commands, self._deadlines = settings.commands, settings.deadlines
        self._reached: deque[tuple[int, float]] = deque(maxlen=_REACHED)
        """Numbers that the robot's packets have reached, and when, s."""
        self._over: deque[tuple[int, tuple[int, int]]] = deque(maxlen=_OVER)
        """Messages that came over other robots, by topic id and order: they may come again."""

    def reached(self, number: int, now: float) -> None:
        """The robot's packets have reached a number, s."""
        self._reached.append((number, now))

    def came_over(self, ready: Ready) -> None:
        """A message has come over another robot."""
        self._over.append((ready.topic_id, ready.order))

    def adopt(self, far: DeliveryRules) -> None:
        """Go on from what has come over other robots."""
        self.newest.update(far.newest)
        self._over.extend(far._over)

    def lacks(self, mark: tuple[int, int], number: int) -> bool:
        """Whether a latched message, named at a packet number, is not here, nor a newer one of its topic."""
        topic_id, value = mark
        return value not in self.marks.get(topic_id, ()) and self.newest.get(topic_id, (-1, -1))[0] <= number

    def is_for_us(self, topic: AnnouncedTopic) -> bool:
        """Whether messages of a topic are for this robot."""
        return topic.dst_id in (BROADCAST, self._own)

    def refusal(self, ready: Ready, topic: AnnouncedTopic, now: float) -> Fate | None:
        """Why a message is not delivered; None for one that is, or that is here already."""
        if not self.is_for_us(topic) and self._own != NOBODY:
            return Fate.NOT_FOR_US
        if self._old(ready.order[0], topic, now):
            return Fate.NOT_FRESH
        if topic.fresh and self._late(ready.order[0], topic, now):
            return Fate.LATE
        passed = ready.order <= self.newest.get(ready.topic_id, (-1, -1))
        return passed_over(topic) if passed and (ready.topic_id, ready.order) not in self._over else None

    def takes(self, ready: Ready, topic: AnnouncedTopic) -> bool:
        """Note a message that nothing refuses; returns whether it is new."""
        if ready.order <= self.newest.get(ready.topic_id, (-1, -1)):
            return False
        self.newest[ready.topic_id] = ready.order
        if topic.latched:
            mark, marks = crc32(ready.payload), self.marks.get(ready.topic_id, ())
            if mark in marks:
                return False
            self.marks[ready.topic_id] = (*marks, mark)[-max(topic.depth, 1) :]
        return True

    def _old(self, number: int, topic: AnnouncedTopic, now: float) -> bool:
        """Whether a message may be older than its topic allows, because nothing proves that it is not."""
        if self.sealed_after is None:
            return False
        most = self._max_ages.get(topic.name.lstrip("/"), self._max_age_s) if self._max_ages else self._max_age_s
        if most == AUTO:
            most = MAX_AGE_S if topic.fresh else 0.0
        return 0 < most < now - self.sealed_after(number)

    def _late(self, number: int, topic: AnnouncedTopic, now: float) -> bool:
        """Whether a command has been under way for longer than it is good for: at least since a packet arrived that
        left after it."""
        name = topic.name.lstrip("/")
        deadline = self._deadlines.get(name, 0.0)
        if name not in self._deadlines and is_command(name, topic.type_name, self._commands):
            deadline = COMMAND_DEADLINE_S
        since = next((at for reached, at in self._reached if reached >= number), now)
        return 0 < deadline < now - since


def passed_over(topic: AnnouncedTopic) -> Fate:
    """The fate of a message that is not delivered because a later one of its topic was."""
    return Fate.GIVEN_UP if topic.reliable else Fate.OVERTAKEN
