"""Which slots others want: those that they have announced, and those in which neighbours expect to receive.

Invariants: sans-IO; a slot that two robots want stays with the lower id; what has passed is forgotten when the caller
says so, and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable

from gr_ros2.wire.mac_block import MAP_SLOTS, NOBODY, SLOT_NUMBERS


class Calendar:
    """The slots from now on, as far as a robot knows them. All slots are counted by its own clock."""

    def __init__(self) -> None:
        self._taken: dict[int, int] = {}
        """Slot -> the robot that has announced it."""
        self._conflicts: dict[int, int] = {}
        """Slot that two robots want -> the one of them that gives it up."""
        self._expected = 0
        """Bit i: a neighbour expects to receive in slot ``base`` + i."""
        self.base = 0
        """The slot up to which all is forgotten."""

    def free(self, slot: int) -> bool:
        """Whether nobody wants a slot."""
        return slot not in self._taken and not (slot > self.base and self._expected >> slot - self.base & 1)

    def announce(self, slot: int, robot: int) -> bool:
        """A robot announces a slot; returns whether nobody else had before."""
        return self._taken.setdefault(slot, robot) == robot

    def claim(self, slot: int, robot: int) -> None:
        """A robot whose packet is trusted wants a slot that somebody has announced."""
        owner = self._taken[slot]
        if owner != robot:
            self._conflicts[slot] = max(owner, robot)
        self._taken[slot] = min(owner, robot)

    def give_up(self, slot: int, robot: int) -> None:
        """This robot and another one want a slot, and the other one has to give it up."""
        self._conflicts[slot] = robot

    def withdraw(self, robot: int, slots: Iterable[int]) -> None:
        """A robot wants these slots no more."""
        for slot in slots:
            for known in (self._taken, self._conflicts):
                if known.get(slot) == robot:
                    del known[slot]

    def expect(self, first: int, expected: int, mine: Iterable[int]) -> None:
        """A neighbour expects to receive in slots: those of this robot, or others.

        :param first: the slot of bit 0 of ``expected``
        """
        skip = first - self.base
        expected = expected << skip if skip > 0 else expected >> -skip
        for slot in mine:
            if slot > self.base:
                expected &= ~(1 << slot - self.base)
        self._expected |= expected

    def map(self, slot: int) -> int:
        """The map of a packet that is sent in a slot."""
        return sum([1 << at - slot - 1 for at in self._taken if slot < at <= slot + MAP_SLOTS])

    def conflict(self, slot: int) -> tuple[int, int]:
        """A conflict that a packet in a slot says, once: slots from there, and who gives way; (0, 255) for none."""
        wanted = min((at for at in self._conflicts if slot + 1 < at < slot + SLOT_NUMBERS), default=None)
        return (0, NOBODY) if wanted is None else (wanted - slot, self._conflicts.pop(wanted))

    def forget(self, slot: int) -> None:
        """Forget all up to a slot."""
        self._expected >>= max(slot - self.base, 0)
        self.base = slot
        self._taken = {at: owner for at, owner in self._taken.items() if at > slot}
        self._conflicts = {at: loser for at, loser in self._conflicts.items() if at > slot}

    def clear(self, slot: int) -> None:
        """Slots are counted otherwise, and this one comes next: forget all."""
        self._taken.clear()
        self._conflicts.clear()
        self._expected = 0
        self.base = slot - 1
