"""The robots that one hears in its slots.

Invariants: sans-IO; a robot counts as heard for a number of slots, more where there are many; what is older is
forgotten when the caller says so.
"""

from __future__ import annotations

from gr_ros2.core.tuning import Tuning

NEVER = -1 << 40


class SlotOwner:
    """What is known of a robot that is heard."""

    __slots__ = ("ahead", "deaf", "first", "heard", "last", "named", "weight")

    def __init__(self, slot: int) -> None:
        self.first = slot
        """The slot in which it came."""
        self.last = slot
        """The slot of its newest packet."""
        self.heard = 0
        """Sum of the weights of the robots that it hears."""
        self.weight = 1
        self.ahead: tuple[int, ...] = ()
        """The slots that it has announced."""
        self.named = NEVER
        """The slot in which this robot has last named it."""
        self.deaf = 0
        """Maps in a row that lack the next slot of this robot; ``slots_deaf`` if a packet without a map does not name
        it."""


class Around:
    """The robots around one.

    :ivar robots: those with the same slots, by id
    :ivar elsewhere: those with other slots, and when each was last heard, s
    :ivar heard_at: the slot in which anybody was heard last
    :ivar heard_since: the slot since which somebody has been heard
    """

    def __init__(self, tuning: Tuning) -> None:
        self._tuning = tuning
        self.robots: dict[int, SlotOwner] = {}
        self.elsewhere: dict[int, float] = {}
        self.heard_at = self.heard_since = NEVER

    @property
    def memory(self) -> int:
        """Slots for which a robot that was heard counts as heard."""
        return max(self._tuning.slots_heard, 4 * len(self.robots))

    @property
    def lately(self) -> int:
        """Slots within which somebody who is there has sent."""
        return max(self._tuning.slots_lately, 3 * len(self.robots))

    def nobody(self, slot: int) -> bool:
        """Whether nobody was heard lately."""
        return self.heard_at < slot - self.lately

    def deaf(self, slot: int) -> bool:
        """Whether a neighbour has not expected this robot in its next slot for a while."""
        oldest = slot - self.lately
        return any(robot.last >= oldest and robot.deaf >= self._tuning.slots_deaf for robot in self.robots.values())

    def present(self, slot: int) -> list[SlotOwner]:
        """The robots that count as heard."""
        oldest = slot - self.memory
        return [robot for robot in self.robots.values() if robot.last >= oldest]

    def loads(self, slot: int, weight: int) -> list[int]:
        """The sum of the weights of this robot and those it hears, and the same of each robot that it hears. Robots of
        another group count too, see ``SlotClock``.

        :param weight: of this robot
        """
        heard = self.present(slot)
        others = sum([src_id not in self.robots for src_id in self.elsewhere])
        return [weight + others + sum([robot.weight for robot in heard]), *[one.heard + one.weight for one in heard]]

    def newcomers(self, oldest: int) -> int:
        """How many have come in a slot or since."""
        return sum([robot.first >= oldest for robot in self.robots.values()])

    def unnamed(self, lately: float) -> list[tuple[int, SlotOwner]]:
        """Ids of the two that were named the longest time ago, of those heard in a slot or since."""
        fresh = [(src_id, robot) for src_id, robot in self.robots.items() if robot.last >= lately]
        return sorted(fresh, key=lambda one: one[1].named)[:2]

    def heard(self, slot: int) -> None:
        """Somebody sends in a slot."""
        if self.heard_at < slot - 2 * self.memory:
            self.heard_since = slot
        self.heard_at = max(self.heard_at, slot)

    def forget(self, slot: int, elsewhere_before: float) -> None:
        """Forget who was heard long before a slot, or elsewhere before a time."""
        oldest = slot - 2 * self.memory
        self.robots = {src_id: robot for src_id, robot in self.robots.items() if robot.last >= oldest}
        self.elsewhere = {src_id: at for src_id, at in self.elsewhere.items() if at >= elsewhere_before}

    def part(self, now: float) -> None:
        """Slots are counted otherwise: those heard so far have other ones."""
        self.elsewhere = dict.fromkeys(self.robots, now)
        self.robots.clear()
        self.heard_at = NEVER
