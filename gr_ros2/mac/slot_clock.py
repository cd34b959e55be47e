"""Where the slots lie on a robot's own clock. There is no master: the robots follow the packets that they hear.

Each packet names the number of its slot mod 256 and begins when this slot begins. A packet that differs from what this
clock expects by less than ``clock_tolerance`` moves it by ``clock_gain`` of the difference, so clocks of ±50 ppm stay
together. A greater difference means that the other robot belongs to another group, or that a clock has jumped:

- *Nobody can have followed this clock yet*: move.
- *Nobody is heard in these slots, and the other robot hears somebody in its own*: move.
- *A robot that did not agree before is ahead* (numbers are compared as on a circle): move to its slots, so that one of
  two groups moves and the other stays.
- *Two robots that agreed before differ by the same, and nobody has agreed since*: this clock has jumped. Move.
- *A robot that agreed before is ahead*: its clock has jumped. Move if it has not noticed after ``clock_patience``.
- *A robot is behind*: if it still is after ``clock_behind``, it does not hear this robot. A group whose slots are all
  in use hears nobody whose packets begin between two of them. Move there, and stay for ``clock_stays``: told in its own
  slots that there are more robots, the group leaves room, and then hears the one that is ahead. Sooner, or more often,
  robots of a large network move back as fast as others move on. Where nobody agrees there is no group to keep, and
  ``clock_patience`` is enough.

Invariants: all times are those of the caller's clock; a robot that is heard can move this clock only as above; the work
for a packet is bounded by the number of robots heard.
"""

from __future__ import annotations

from typing import NamedTuple

from gr_ros2.core.tuning import Tuning
from gr_ros2.wire.mac_block import SLOT_NUMBERS


class _Odd(NamedTuple):
    """A robot that differs: the difference in slots, and the time in s at which it was noticed."""

    error: float
    since: float


class SlotClock:
    """The robot's own clock of slots, which follows the packets that it hears.

    :param slot_s: s that a slot lasts
    :ivar jumps: how often this clock has moved to other slots
    """

    def __init__(self, slot_s: float, tuning: Tuning) -> None:
        self.slot_s, self._tuning = slot_s, tuning
        self.jumps = 0
        self._zero: float | None = None
        self._doubtful = False
        """Whether only packets that were not checked have said where the slots are."""
        self._unsaid = False
        """Whether this robot has begun these slots itself, and no packet of it has named one yet."""
        self._agreed: dict[int, float] = {}
        self._agreed_at = float("-inf")
        self._odd: dict[int, _Odd] = {}
        self._stays_until = float("-inf")
        """s, until which this clock does not move, because it has moved to a group that is behind."""

    @property
    def runs(self) -> bool:
        """Whether there are slots yet."""
        return self._zero is not None

    def start(self, now: float) -> None:
        """Let slot 0 begin now, because nobody is heard."""
        self._zero, self._unsaid = now, True

    def said(self) -> None:
        """A packet of this robot names its slot: others may follow it."""
        self._unsaid = False

    def begin(self, slot: int) -> float:
        """s, when a slot begins."""
        assert self._zero is not None
        return self._zero + slot * self.slot_s

    def slot(self, now: float) -> int:
        """The slot at a time."""
        assert self._zero is not None
        return int((now - self._zero) // self.slot_s)

    def heard(
        self, src_id: int, number: int, began: float, *, trusted: bool, checked: bool = False, joins: bool = False
    ) -> int | None:
        """Follow a packet of slot ``number`` mod 256 whose burst began at ``began`` s.

        :param trusted: it is no recording. Other packets move nobody who hears a robot that agrees
        :param checked: its trailer has been checked. A packet of which nothing is known only starts a clock that
            stands, which the first one that was checked moves
        :param joins: it hears others, and this robot hears nobody in its own slots
        :return: its slot as this clock counts, None where it does not agree
        """
        checked = checked or trusted
        if self._zero is None:
            self._zero = began - number * self.slot_s
            self._doubtful = not checked
        exact = (began - self._zero) / self.slot_s
        error = (exact - number + SLOT_NUMBERS / 2) % SLOT_NUMBERS - SLOT_NUMBERS / 2
        slot = round(exact - error)
        if -self._tuning.clock_tolerance <= error <= self._tuning.clock_tolerance:
            agreeing, guessed = self.agreeing(began), self._doubtful or self._unsaid
            self._doubtful = self._doubtful and not checked
            if trusted or (checked and not agreeing):
                share = self._tuning.clock_gain if agreeing else self._tuning.clock_first_gain
                self._zero += (1 if guessed else share) * error * self.slot_s
                self._unsaid = False
            if trusted:
                self._agreed[src_id] = self._agreed_at = began
                self._odd.pop(src_id, None)
            return slot
        if not checked or began < self._stays_until:
            return None
        doubtful = self._doubtful or self._unsaid
        if not (doubtful or joins) and not self._moves(src_id, error, began, trusted=trusted):
            return None
        if error > 0 and not (doubtful or joins):
            self._stays_until = began + self._tuning.clock_stays * self.slot_s
        self._zero += error * self.slot_s
        self.jumps += 1
        self._agreed = {src_id: began} if trusted else {}
        self._agreed_at = began if trusted else float("-inf")
        self._odd.clear()
        self._doubtful = self._unsaid = False
        return slot

    def agreeing(self, now: float) -> bool:
        """Whether a robot that is trusted has been heard lately, and agrees."""
        return now - self._agreed_at < self._tuning.clock_memory * self.slot_s

    def _moves(self, src_id: int, error: float, now: float, *, trusted: bool) -> bool:
        """Whether to move to the slots of a robot that differs by ``error`` slots: below 0 if it is ahead."""
        if not trusted:
            return not self.agreeing(now) and error < 0
        memory_s = self._tuning.clock_memory * self.slot_s
        odd = self._odd.get(src_id)
        if odd is None or now - odd.since > 2 * memory_s or abs(odd.error - error) > 2 * self._tuning.clock_tolerance:
            odd = self._odd[src_id] = _Odd(error, now)
        if error < 0 and now - self._agreed.get(src_id, float("-inf")) >= memory_s:
            return True
        alike = [
            other
            for other, (by, since) in self._odd.items()
            if abs(by - error) <= self._tuning.clock_tolerance and since > self._agreed_at and other in self._agreed
        ]
        patience = self._tuning.clock_behind if error > 0 and self.agreeing(now) else self._tuning.clock_patience
        return len(alike) > 1 or now - odd.since > patience * self.slot_s
