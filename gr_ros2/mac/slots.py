"""Slots that robots derive from the packets that they hear, hidden robots included.

Each packet says in which slot it stands and in which two slots its sender sends next (``wire.mac_block``). A robot
picks its slots among those that nobody it hears has announced, and that no neighbour expects to receive in: a neighbour
of a neighbour would destroy what that neighbour receives. Of two robots that want one slot, the lower id keeps it.

*Rate.* A robot's weight says how many packets it sends while others send one: 1, and more where it has much to relay. A
frame has a slot for each packet around the one of this robot and its neighbours that has most around it, one more, and
one for each newcomer: where some come, more are to be expected, and they need free slots. It lasts at least the period
of the messages.

*Video.* A robot whose frames (``link.frames``) fill whatever others leave takes more packets than its weight, one more
or less at a time and at random, as long as all that robots take so makes the frame longer by ``slots_filled`` at most.
Where there is no room for more, who takes most gives one back to who takes less.

*Choice.* The first free slot after an equal part of the frame. Slots go on from frame to frame, so one counts as free
only if nobody else is known to send in the slot one frame before (without this 6 instead of 2 % of the receptions in a
grid of 5 × 4 collide).

*Entry.* A robot listens first, for a moment where nobody is heard. Without slots it sends in a free slot with
probability 1 / v. v grows when neighbours have sent by its next send and none names the robot, and shrinks with each
newcomer that gets in. A neighbour names two robots a packet, newcomers first. A robot that was alone enters anew when
it hears somebody, even in other slots: until then it sends more and more seldom.

*Who is not heard.* Two robots that always collide at a third one are never heard by it: its map lacks their slots. A
robot whose next slot three maps in a row of a neighbour lack, or that nobody names for a while, picks at random among
the first free slots. So does a robot that hears nobody, and one that hears robots with other slots: a packet that
always falls between the same two slots of a group is never heard there.

*Who is not trusted.* A packet that may be a recording keeps its sender's announced slots free; its sender counts as one
robot and is named, so that it gets in, and may name this one. Of a packet that could not be checked only the announced
slots count, and nothing at all once a robot is heard that is trusted.

Invariants: sans-IO, the caller passes in times of its own clock, and the generator; the work for a packet heard is
bounded by the slots it names and, when clocks differ, the robots heard; equal calls give equal slots.
"""

from __future__ import annotations

import math
import random
from collections import deque

from gr_ros2.core.tuning import Tuning
from gr_ros2.mac.around import NEVER, Around, SlotOwner
from gr_ros2.mac.calendar import Calendar
from gr_ros2.mac.slot_clock import SlotClock
from gr_ros2.wire.mac_block import (
    LONGEST_AHEAD,
    MAP_SLOTS,
    MOST_WEIGHT,
    NOBODY,
    SLOT_NUMBERS,
    Block,
    announceable,
    write_block,
)

_SWEEP = 64
_SILENT = 4096
"""Slots after which a robot that does not send forgets what has passed."""


class Slots:
    """The slots in which this robot and those that it hears send.

    :param src_id: of this robot
    :param slot_s: s that a slot lasts: the airtime of the longest packet and the guard
    :param period_s: s from one message to the next
    :param lead_s: s before its slot at which a packet is composed. What is heard from then on comes too late for it
    :ivar calendar: the slots that others want
    :ivar around: who they are
    :ivar reserved: whether the block before had announced the slot of the newest one
    """

    def __init__(
        self,
        src_id: int,
        slot_s: float,
        rng: random.Random,
        *,
        period_s: float,
        lead_s: float = 0.0,
        tuning: Tuning = Tuning(),
    ) -> None:
        self._tuning = tuning
        self.src_id, self.lead_s = src_id, lead_s
        self._ahead = math.ceil(lead_s / slot_s)
        """Whole slots by which packets are composed ahead."""
        self._every = 3.0
        """Slots from one packet of this robot to the next, in the mean."""
        self.clock = SlotClock(slot_s, tuning)
        self.reserved = False
        self._weight = 1
        self._filling = 0
        """How much of its weight is for video."""
        self._behind = 0.0
        """Slots by which its packets for video are late, since others have the slots between."""
        self._rng = rng
        self._period = period_s / slot_s
        self._mine: list[int] = []
        self._announced: tuple[int, ...] = ()
        self._said: deque[tuple[int, tuple[int, ...]]] = deque(maxlen=1 + self._ahead)
        """The slots of the newest packets, and what they announced."""
        self.calendar = Calendar()
        self.around = Around(tuning)
        self._named_at = self._confirmed_at = NEVER
        """Slots: a neighbour last named another robot; this robot."""
        self._swept = NEVER
        """The slot at which what had passed was forgotten."""
        self._entered_at: int | None = None
        """The slot of the first send since the entry; None outside."""
        self._rate = self._tuning.slots_first_rate
        """v; see the module."""
        self._since: float | None = None

    def unheard(self, now: float) -> bool:
        """Whether robots are heard, of which none has named this one for so long that none can hear it."""
        if not self.clock.runs:
            return False
        slot = self.clock.slot(now)
        named = self._confirmed_at + 2 * self.around.memory, self.around.heard_since + 3 * self._tuning.slots_heard
        return not self.around.nobody(slot) and max(named) < slot

    # ---- sending

    @property
    def turn_s(self) -> float:
        return self._every * self.clock.slot_s

    @property
    def named(self) -> bool:
        return self._entered_at is not None and self._confirmed_at >= self._entered_at

    def departure(self, now: float) -> float:
        """When the next own slot begins, s. A host that is too late for a slot takes the next one."""
        if self._since is None:
            self._since = now
        ready = now + self.lead_s
        if not self.clock.runs:
            if ready < (listened := self._listened):
                return listened
            self.clock.start(ready)
        while self._mine:
            begin = self.clock.begin(self._mine[0])
            slot_s, tuning = self.clock.slot_s, self._tuning
            if begin >= ready - max(min(slot_s, tuning.slots_late_s), tuning.slots_late * slot_s):
                return begin
            self._mine.pop(0)
        self._mine.append(self._entry(self.clock.slot(max(ready, self._listened)) + 1))
        return self.clock.begin(self._mine[0])

    @property
    def _listened(self) -> float:
        """s, when it has listened for long enough."""
        assert self._since is not None
        frame = max(self.around.loads(NEVER, self._weight)) + 2 if self.around.robots else 0
        tuning = self._tuning
        slots = min(max(tuning.slots_listen_frames * frame, tuning.slots_quiet), tuning.slots_listen)
        return self._since + slots * self.clock.slot_s

    def block(self, weight: int = 1, *, fills: bool = False) -> bytes | None:
        if not self._mine:  # asked ahead of the end of its silence: nobody is there whose slots it could take
            self.clock.start(self._listened)
            return None
        slot = self._mine.pop(0)
        self._sweep(slot - 1)  # who has announced this slot is still needed
        now = slot - self._ahead
        alone = self.around.nobody(now)
        if self._entered_at is None:
            if not self.calendar.free(slot):
                return None
            self._entered_at = slot
            self.clock.said()
        elif not alone and self._unwelcome(now):
            self._leave()
            self._rate = min(self._tuning.slots_vain * self._rate, self._tuning.slots_most_rate)
            return None
        self.reserved = slot in self._announced
        if alone:
            self._rate = min(2 * self._rate, self._tuning.slots_deaf_rate)
        self._filling = self._filled(now) if fills else 0
        self._weight = min(weight + self._filling, MOST_WEIGHT)
        loads = self.around.loads(now, self._weight)
        frame = self._frame(now, loads)
        self._every = max(frame / self._weight, 1)
        kept: list[int] = []
        for mine in self._mine:
            base = kept[-1] if kept else slot
            if announceable(mine - base) == mine - base:
                kept.append(mine)
        self._mine = kept
        while len(kept) < 2:
            kept.append(self._pick(kept[-1] if kept else slot, now, frame))
        self._announced = tuple(kept)
        self._said.append((slot, self._announced))
        return write_block(self._content(slot, frame, loads))

    def _filled(self, now: int) -> int:
        """Packets beyond its weight that this robot sends in a frame, for video."""
        others = [robot.weight - 1 for robot in self.around.present(now)]
        mine, taken, most = self._filling, sum(others), int(self._tuning.slots_filled * (len(others) + 2))
        if not others:
            return 0
        if mine + taken > most and mine >= max(others):
            return max(mine - 1, 0)
        if mine < most and (mine + taken < most or mine + 1 < max(others)):
            return mine + self._rng.randrange(2)
        return mine

    def _unwelcome(self, now: int) -> bool:
        """Whether neighbours that can know of this robot's entry have sent, and none has named it; or none for long."""
        entered, named = self._entered_at, self._confirmed_at
        assert entered is not None
        answered = self.around.heard_at > entered + 2 * self._ahead
        return (answered and named < entered) or max(named, entered) < now - 2 * self.around.memory

    def _leave(self) -> None:
        self._mine.clear()
        self._announced = ()
        self._entered_at = None

    def _entry(self, first: int) -> int:
        """A free slot at random, from ``first`` on."""
        for slot in range(first, first + LONGEST_AHEAD):
            if self.calendar.free(slot):
                if self._rng.random() < 1 / self._rate:
                    return slot
                self._rate = max(1.0, self._rate * self._tuning.slots_eased)
        return first + LONGEST_AHEAD

    def _pick(self, base: int, now: int, frame: int) -> int:
        """The slot to send in after ``base``."""
        alone = self.around.nobody(now)
        step = max(round(frame / self._weight - self._behind), 1)
        if alone:
            step = round(max(step, self._rate) * self._rng.uniform(0.5, 1.5))
        ahead = announceable(step)
        places: list[int] = []
        free = self.calendar.free
        unnamed = self._confirmed_at < now - max(self._tuning.slots_unsure * frame, self._tuning.slots_known_late)
        unsure = alone or unnamed or self.around.deaf(now) or self.around.elsewhere
        wanted = self._tuning.slots_choice if unsure or self._rng.random() < self._tuning.slots_mixed else 1
        while ahead <= LONGEST_AHEAD and len(places) < wanted:
            at, before = base + ahead, base + ahead - frame
            followed = before <= now or before == base or free(before)
            if free(at) and at not in self._mine and followed:
                places.append(at)
            ahead = announceable(ahead + 1) if ahead < LONGEST_AHEAD else ahead + 1
        picked = self._rng.choice(places) if places else base + announceable(step)
        behind = self._behind + picked - base - frame / self._weight
        self._behind = min(max(behind, 0.0), frame) if self._filling else 0.0
        return picked

    def _frame(self, now: int, loads: list[int]) -> int:
        """Slots in which every robot around sends as often as its weight says, and newcomers find room. With the first
        newcomer in the slot that is free in any case, two of nine lines of four robots carry nothing over two hops in
        their first 8 s."""
        known = max(loads) + 1
        oldest = now - min(self._tuning.slots_newcomer, self._tuning.slots_newcomer_frames * known)
        return max(math.ceil(self._period - 1e-9), known + self.around.newcomers(oldest))

    def _content(self, slot: int, frame: int, loads: list[int]) -> Block:
        now = slot - self._ahead
        oldest = now - self.around.memory
        lately = max(self._tuning.slots_named * frame, self._tuning.slots_known_late)
        names = self.around.unnamed(max(oldest, now - lately))
        for _, robot in names:
            robot.named = self._turn(slot) if robot.named == NEVER else slot
        first, second = [*(name for name, _ in names), NOBODY, NOBODY][:2]
        ahead = self._mine[0] - slot, self._mine[1] - self._mine[0]
        short = Block(slot % SLOT_NUMBERS, ahead, loads[0] - self._weight, (first, second))
        if self._weight == 1 and self._named_at < oldest and len(set(loads)) == 1:
            return short
        calendar = self.calendar
        return short._replace(expected=calendar.map(slot), conflict=calendar.conflict(slot), weight=self._weight)

    def _turn(self, now: int) -> int:
        """When a newcomer counts as named: at random, or all robots would name the same ones at the same time."""
        return now - self._rng.randrange(LONGEST_AHEAD)

    def _sweep(self, now: int) -> None:
        """Forget what has passed."""
        if now < self._swept + _SWEEP:
            return
        self._swept = now
        self.calendar.forget(now)
        self.around.forget(now, self.clock.begin(now - self.around.memory))

    # ---- what is heard

    def hear(
        self, src_id: int, block: Block | None, began: float, *, trusted: bool = True, checked: bool = False
    ) -> None:
        """Note a burst. Who says nothing about slots cannot be avoided."""
        if block is None or src_id == self.src_id or not (trusted or checked or not self.clock.agreeing(began)):
            return
        joins = block.heard > 0 and not self.around.robots
        slot = self._placed(src_id, block.slot, began, trusted=trusted, checked=checked, joins=joins)
        if slot is None:
            return
        first, second = block.ahead
        ahead = (slot + first, slot + first + second) if first and second else (slot + first,) if first else ()
        if not trusted:
            for at in ahead:
                self.calendar.announce(at, src_id)
            if not checked:
                return
        robot = self._present(src_id, slot, ahead)
        if not trusted:
            self._named(tuple([name for name in block.names if name == self.src_id]), slot)
            return
        robot.heard, robot.weight = block.heard, block.weight
        for at in ahead:
            if not self.calendar.announce(at, src_id) or at in self._mine:
                self._claim(at, src_id)
        self._named(block.names, slot)
        if block.expected is None:
            robot.deaf = 0 if self.src_id in block.names else self._tuning.slots_deaf
        else:
            self._mapped(robot, block.expected, block.conflict)

    def _present(self, src_id: int, slot: int, ahead: tuple[int, ...]) -> SlotOwner:
        """A robot sends in a slot, and has announced others."""
        robot = self.around.robots.get(src_id)
        if robot is None:
            robot = self.around.robots[src_id] = SlotOwner(slot)
            self._rate = max(1.0, self._rate - 1)
        elif slot not in robot.ahead:
            robot.named = NEVER
        self._answer(slot)
        self.around.heard(slot)
        if slot > self.calendar.base + _SILENT:
            self._sweep(slot)
        self.calendar.withdraw(src_id, [at for at in robot.ahead if at not in ahead])
        robot.last, robot.ahead = slot, ahead
        return robot

    def _answer(self, slot: int) -> None:
        """Somebody is heard: who was alone lets itself be heard soon."""
        if self._entered_at is not None and self.around.nobody(slot):
            self._leave()
            self._rate = min(self._rate, self._tuning.slots_entry_rate)

    def _placed(
        self, src_id: int, number: int, began: float, *, trusted: bool, checked: bool, joins: bool
    ) -> int | None:
        """The slot of a packet; None where its sender has other slots."""
        jumps = self.clock.jumps
        slot = self.clock.heard(src_id, number, began, trusted=trusted, checked=checked, joins=joins)
        if self.clock.jumps > jumps:
            assert slot is not None
            self._start_over(slot, began)
        if slot is None and (trusted or checked) and not self.around.elsewhere:
            self._answer(self.clock.slot(began))
        if trusted and slot is None:
            self.around.elsewhere[src_id] = began
        elif trusted and self.around.elsewhere:
            self.around.elsewhere.pop(src_id, None)
        return slot

    def _claim(self, slot: int, src_id: int) -> None:
        self.calendar.claim(slot, src_id)
        if slot in self._mine:
            if src_id < self.src_id or slot not in self._announced:
                self._mine.remove(slot)
            else:
                self.calendar.give_up(slot, src_id)

    def _named(self, names: tuple[int, ...], slot: int) -> None:
        for name in names:
            other = self.around.robots.get(name)
            if name == self.src_id:
                self._confirmed_at = max(self._confirmed_at, slot)
                self._rate = (
                    self._tuning.slots_named_rate if self._entered_at is None else self._tuning.slots_entry_rate
                )
            elif other is not None and other.named == NEVER:
                other.named = self._turn(slot)  # one confirmation is enough
            elif name != NOBODY:
                self._named_at = slot

    def _mapped(self, robot: SlotOwner, expected: int, conflict: tuple[int, int]) -> None:
        slot = robot.last
        at = slot + 1
        known = next((ahead for sent, ahead in reversed(self._said) if sent < slot - 1 - self._ahead), ())
        mine = next((mine for mine in known if mine >= at), slot)
        if 0 <= mine - at < MAP_SLOTS:
            robot.deaf = 0 if expected >> mine - at & 1 else robot.deaf + 1
        self.calendar.expect(at, expected, self._mine)
        ahead, loser = conflict
        if ahead and loser == self.src_id and slot + ahead in self._mine:
            self._mine.remove(slot + ahead)

    def _start_over(self, slot: int, began: float) -> None:
        """The clock has moved to a slot: what was known by slot is void."""
        self._leave()
        self.around.part(began)
        self.calendar.clear(slot)
        self._confirmed_at = self._named_at = self._swept = NEVER
        self._rate = self._tuning.slots_entry_rate
