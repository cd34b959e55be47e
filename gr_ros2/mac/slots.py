"""Slots that robots derive from the packets that they hear, hidden robots included.

Each packet says in which slot it stands and in which two slots its sender sends next (``wire.mac_block``). A robot
picks its slots among those that nobody it hears has announced, and that no neighbour expects to receive in: a neighbour
of a neighbour would destroy what that neighbour receives. Of two robots that want one slot, the lower id keeps it.

*Rate.* A robot's weight says how many packets it sends while others send one: 1, and more where it has much to relay. A
frame has a slot for each packet around the one of this robot and its neighbours that has most around it, one more, and
one for each newcomer: where some come, more are to be expected, and they need free slots. It lasts at least the period
of the messages.

*Video.* A robot whose frames (``link.frames``) fill whatever others leave takes more packets than its weight, one more
or less at a time and at random, as long as all that robots take so makes the frame longer by ``FILLED`` at most. Where
there is no room for more, who takes most gives one back to who takes less.

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

LISTEN, QUIET, FRAMES = 24, 4, 2
"""Slots for which a robot listens before it enters: two frames of those it hears, since each has announced its slots
in one, but ``LISTEN`` at most; ``QUIET`` at least, and where nobody is heard. With a ``LISTEN`` of 12, one of 20 whose
clock has jumped by 1 s may collide with others 5 s later; with a ``QUIET`` of 24, two robots hear each other after 31
slots instead of 15 (median), 50 from cold after 521 instead of 548. With 3, it is the same as with 4."""
HEARD = 210
"""Slots for which a robot that was heard counts as heard; more where robots send less than three times in them."""
FILLED = 0.5
"""Part by which the frame may be longer for video: no robot's turn comes 1.5 times as late as without it."""
CHOICE = 4
"""Free slots among which a robot picks at random where it does so."""
MIXED = 0.02
"""Share of picks at random where nothing calls for it: of two neighbours in step each may be heard by all others."""
NAMED = 2.2
"""Frames for which a robot that was heard is named: one packet of it may be lost."""
UNSURE = 1.75
"""Frames without being named, of which each has two names for each robot, after which a robot may be in step with
another one."""
DEAF = 3
"""Maps in a row of a neighbour that lack this robot, after which it may be in step with another one. With 1 a lost
packet is enough: a fourth of the picks in a grid of 5 × 4 at 10 % loss are at random, which leaves slots empty."""
KNOWN_LATE = 9
"""Slots that this is at least: a host knows a packet some slots after it began, and composes its own ahead. Without it
two links on one computer (6 ms a slot) picked at random half of the time, and sent 27 instead of 41 packets/s each."""
NEWCOMER, NEWCOMER_FRAMES = 140, 8
"""Slots for which a robot is a newcomer; in a small cell so many frames, as they are without newcomers. Without slots
for them, 50 robots need 18 s instead of 9 to get in from cold at 14 ms a slot, and a robot between two full cells may
be heard by nobody for a minute. 70 slots take two seconds longer, 210 no less."""
LATELY = 70
"""Slots within which somebody who is there has sent; more where there are many robots."""
LATE_S = 0.01
"""s by which a host may be late at most for a packet to be sent all the same, and a slot."""
EASED = 0.97
"""What v is multiplied by in a free slot."""
VAIN = 4
"""What v is multiplied by after an entry in vain. With 2, v stays near 2 while 50 robots enter from cold, most entries
collide, and it takes 10 instead of 7.5 s on average; with 3 to 8 it is the same."""
_FIRST_RATE, _NAMED_RATE, _ENTRY_RATE, _DEAF_RATE, _LEAST_RATE = 4.0, 2.0, 4.0, 64.0, 64.0
"""v at the start; of one that is named, and has no slots; after an entry (with 8 a grid of 5 × 4 is 3 % older); and the
most that entries in vain make. For one that is named: with 4, the first message of two robots with a key comes after
15.7 s where packets take half a second (``python -m bench first``); with 1, the ends of a line of three, which do not
hear each other, begin at once, and one that comes back gets a message too late for a deadline of 4 s in 4 of 14 starts,
as in one with 2. At the start it is the same with 3 or 2."""
_NEVER = -1 << 40
_SWEEP = 64
_SILENT = 4096
"""Slots after which a robot that does not send forgets what has passed."""


class _HeardRobot:
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
        self.named = _NEVER
        """The slot in which this robot has last named it."""
        self.deaf = 0
        """Maps in a row that lack the next slot of this robot; ``DEAF`` if a packet without a map does not name it."""


class Slots:
    """The slots in which this robot and those that it hears send.

    :param src_id: of this robot
    :param slot_s: s that a slot lasts: the airtime of the longest packet and the guard
    :param period_s: s from one message to the next
    :param lead_s: s before its slot at which a packet is composed. What is heard from then on comes too late for it
    :ivar reserved: whether the block before had announced the slot of the newest one
    """

    def __init__(self, src_id: int, slot_s: float, rng: random.Random, *, period_s: float, lead_s: float = 0.0) -> None:
        self.src_id, self.lead_s = src_id, lead_s
        self._ahead = math.ceil(lead_s / slot_s)
        """Whole slots by which packets are composed ahead."""
        self._every = 3.0
        """Slots from one packet of this robot to the next, in the mean."""
        self.clock = SlotClock(slot_s)
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
        self._taken: dict[int, int] = {}
        """Slot -> the robot that has announced it."""
        self._expected = 0
        """Bit i: a neighbour expects to receive in slot ``_base`` + i."""
        self._base = 0
        self._conflicts: dict[int, int] = {}
        """Slot that two robots want -> the one of them that gives it up."""
        self._robots: dict[int, _HeardRobot] = {}
        self._elsewhere: dict[int, float] = {}
        """Robot with other slots than this one -> when it was last heard, s."""
        self._named_at = self._confirmed_at = self._heard_at = _NEVER
        """Slots: a neighbour last named another robot; this robot; anybody was heard."""
        self._heard_since = _NEVER
        """The slot since which somebody has been heard."""
        self._swept = _NEVER
        """The slot at which what had passed was forgotten."""
        self._entered_at: int | None = None
        """The slot of the first send since the entry; None outside."""
        self._rate = _FIRST_RATE
        """v; see the module."""
        self._since: float | None = None

    def unheard(self, now: float) -> bool:
        """Whether robots are heard, of which none has named this one for so long that none can hear it."""
        if not self.clock.runs:
            return False
        slot = self.clock.slot(now)
        named = self._confirmed_at + 2 * self._memory(), self._heard_since + 3 * HEARD
        return not self._alone(slot) and max(named) < slot

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
            if begin >= ready - min(self.clock.slot_s, LATE_S):
                return begin
            self._mine.pop(0)
        self._mine.append(self._entry(self.clock.slot(max(ready, self._listened)) + 1))
        return self.clock.begin(self._mine[0])

    @property
    def _listened(self) -> float:
        """s, when it has listened for long enough."""
        assert self._since is not None
        frame = max(self._loads(_NEVER)) + 2 if self._robots else 0
        return self._since + min(max(FRAMES * frame, QUIET), LISTEN) * self.clock.slot_s

    def block(self, weight: int = 1, *, fills: bool = False) -> bytes | None:
        if not self._mine:  # asked ahead of the end of its silence: nobody is there whose slots it could take
            self.clock.start(self._listened)
            return None
        slot = self._mine.pop(0)
        self._sweep(slot - 1)  # who has announced this slot is still needed
        now = slot - self._ahead
        alone = self._alone(now)
        if self._entered_at is None:
            if not self._free(slot):
                return None
            self._entered_at = slot
            self.clock.said()
        elif not alone and self._unwelcome(now):
            self._leave()
            self._rate = min(VAIN * self._rate, _LEAST_RATE)
            return None
        self.reserved = slot in self._announced
        if alone:
            self._rate = min(2 * self._rate, _DEAF_RATE)
        self._filling = self._filled(now) if fills else 0
        self._weight = min(weight + self._filling, MOST_WEIGHT)
        loads = self._loads(now)
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
        oldest = now - self._memory()
        others = [robot.weight - 1 for robot in self._robots.values() if robot.last >= oldest]
        mine, taken, most = self._filling, sum(others), int(FILLED * (len(others) + 2))
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
        answered = self._heard_at > entered + 2 * self._ahead
        return (answered and named < entered) or max(named, entered) < now - 2 * self._memory()

    def _leave(self) -> None:
        self._mine.clear()
        self._announced = ()
        self._entered_at = None

    def _entry(self, first: int) -> int:
        """A free slot at random, from ``first`` on."""
        for slot in range(first, first + LONGEST_AHEAD):
            if self._free(slot):
                if self._rng.random() < 1 / self._rate:
                    return slot
                self._rate = max(1.0, self._rate * EASED)
        return first + LONGEST_AHEAD

    def _free(self, slot: int) -> bool:
        return slot not in self._taken and not (slot > self._base and self._expected >> slot - self._base & 1)

    def _pick(self, base: int, now: int, frame: int) -> int:
        """The slot to send in after ``base``."""
        alone = self._alone(now)
        step = max(round(frame / self._weight - self._behind), 1)
        if alone:
            step = round(max(step, self._rate) * self._rng.uniform(0.5, 1.5))
        ahead = announceable(step)
        places: list[int] = []
        unnamed = self._confirmed_at < now - max(UNSURE * frame, KNOWN_LATE)
        unsure = alone or unnamed or self._unheard(now) or self._elsewhere
        wanted = CHOICE if unsure or self._rng.random() < MIXED else 1
        while ahead <= LONGEST_AHEAD and len(places) < wanted:
            at, before = base + ahead, base + ahead - frame
            if self._free(at) and at not in self._mine and (before <= now or before == base or self._free(before)):
                places.append(at)
            ahead = announceable(ahead + 1) if ahead < LONGEST_AHEAD else ahead + 1
        picked = self._rng.choice(places) if places else base + announceable(step)
        behind = self._behind + picked - base - frame / self._weight
        self._behind = min(max(behind, 0.0), frame) if self._filling else 0.0
        return picked

    def _loads(self, now: int) -> list[int]:
        """The sum of the weights of this robot and those it hears, and the same of each robot that it hears. Robots of
        another group count too, see ``SlotClock``."""
        oldest = now - self._memory()
        heard = [robot for robot in self._robots.values() if robot.last >= oldest]
        others = sum([src_id not in self._robots for src_id in self._elsewhere])
        own = self._weight + others + sum([robot.weight for robot in heard])
        return [own, *[robot.heard + robot.weight for robot in heard]]

    def _frame(self, now: int, loads: list[int]) -> int:
        """Slots in which every robot around sends as often as its weight says, and newcomers find room. With the first
        newcomer in the slot that is free in any case, two of nine lines of four robots carry nothing over two hops in
        their first 8 s."""
        known = max(loads) + 1
        oldest = now - min(NEWCOMER, NEWCOMER_FRAMES * known)
        newcomers = sum([robot.first >= oldest for robot in self._robots.values()])
        return max(math.ceil(self._period - 1e-9), known + newcomers)

    def _memory(self) -> int:
        """Slots for which a robot that was heard counts as heard."""
        return max(HEARD, 4 * len(self._robots))

    def _lately(self) -> int:
        """Slots within which somebody who is there has sent."""
        return max(LATELY, 3 * len(self._robots))

    def _alone(self, now: int) -> bool:
        return self._heard_at < now - self._lately()

    def _unheard(self, now: int) -> bool:
        """Whether a neighbour has not expected this robot in its next slot for a while."""
        oldest = now - self._lately()
        return any(robot.last >= oldest and robot.deaf >= DEAF for robot in self._robots.values())

    def _content(self, slot: int, frame: int, loads: list[int]) -> Block:
        now = slot - self._ahead
        oldest = now - self._memory()
        lately = max(oldest, now - max(NAMED * frame, KNOWN_LATE))
        fresh = {src_id: robot for src_id, robot in self._robots.items() if robot.last >= lately}
        names = sorted(fresh, key=lambda src_id: fresh[src_id].named)[:2]
        for src_id in names:
            fresh[src_id].named = self._turn(slot) if fresh[src_id].named == _NEVER else slot
        first, second = [*names, NOBODY, NOBODY][:2]
        ahead = self._mine[0] - slot, self._mine[1] - self._mine[0]
        short = Block(slot % SLOT_NUMBERS, ahead, loads[0] - self._weight, (first, second))
        if self._weight == 1 and self._named_at < oldest and len(set(loads)) == 1:
            return short
        expected = sum([1 << at - slot - 1 for at in self._taken if slot < at <= slot + MAP_SLOTS])
        wanted = min((at for at in self._conflicts if slot + 1 < at < slot + SLOT_NUMBERS), default=None)
        conflict = (0, NOBODY) if wanted is None else (wanted - slot, self._conflicts.pop(wanted))
        return short._replace(expected=expected, conflict=conflict, weight=self._weight)

    def _turn(self, now: int) -> int:
        """When a newcomer counts as named: at random, or all robots would name the same ones at the same time."""
        return now - self._rng.randrange(LONGEST_AHEAD)

    def _sweep(self, now: int) -> None:
        """Forget what has passed."""
        if now < self._swept + _SWEEP:
            return
        self._expected >>= max(now - self._base, 0)
        self._swept = self._base = now
        self._taken = {slot: owner for slot, owner in self._taken.items() if slot > now}
        self._conflicts = {slot: loser for slot, loser in self._conflicts.items() if slot > now}
        memory = self._memory()
        self._robots = {src_id: robot for src_id, robot in self._robots.items() if robot.last >= now - 2 * memory}
        oldest = self.clock.begin(now - memory)
        self._elsewhere = {src_id: at for src_id, at in self._elsewhere.items() if at >= oldest}

    # ---- what is heard

    def hear(
        self, src_id: int, block: Block | None, began: float, *, trusted: bool = True, checked: bool = False
    ) -> None:
        """Note a burst. Who says nothing about slots cannot be avoided."""
        if block is None or src_id == self.src_id or not (trusted or checked or not self.clock.agreeing(began)):
            return
        joins = block.heard > 0 and not self._robots
        slot = self._placed(src_id, block.slot, began, trusted=trusted, checked=checked, joins=joins)
        if slot is None:
            return
        first, second = block.ahead
        ahead = (slot + first, slot + first + second) if first and second else (slot + first,) if first else ()
        if not trusted:
            for at in ahead:
                self._taken.setdefault(at, src_id)
            if not checked:
                return
        robot = self._present(src_id, slot, ahead)
        if not trusted:
            self._named(tuple([name for name in block.names if name == self.src_id]), slot)
            return
        robot.heard, robot.weight = block.heard, block.weight
        for at in ahead:
            if self._taken.setdefault(at, src_id) != src_id or at in self._mine:
                self._claim(at, src_id)
        self._named(block.names, slot)
        if block.expected is None:
            robot.deaf = 0 if self.src_id in block.names else DEAF
        else:
            self._mapped(robot, block.expected, block.conflict)

    def _present(self, src_id: int, slot: int, ahead: tuple[int, ...]) -> _HeardRobot:
        """A robot sends in a slot, and has announced others."""
        robot = self._robots.get(src_id)
        if robot is None:
            robot = self._robots[src_id] = _HeardRobot(slot)
            self._rate = max(1.0, self._rate - 1)
        elif slot not in robot.ahead:
            robot.named = _NEVER
        self._answer(slot)
        if self._heard_at < slot - 2 * self._memory():
            self._heard_since = slot
        self._heard_at = max(self._heard_at, slot)
        if slot > self._base + _SILENT:
            self._sweep(slot)
        for at in robot.ahead:
            for known in (self._taken, self._conflicts):
                if at not in ahead and known.get(at) == src_id:
                    del known[at]
        robot.last, robot.ahead = slot, ahead
        return robot

    def _answer(self, slot: int) -> None:
        """Somebody is heard: who was alone lets itself be heard soon."""
        if self._entered_at is not None and self._alone(slot):
            self._leave()
            self._rate = min(self._rate, _ENTRY_RATE)

    def _placed(
        self, src_id: int, number: int, began: float, *, trusted: bool, checked: bool, joins: bool
    ) -> int | None:
        """The slot of a packet; None where its sender has other slots."""
        jumps = self.clock.jumps
        slot = self.clock.heard(src_id, number, began, trusted=trusted, checked=checked, joins=joins)
        if self.clock.jumps > jumps:
            assert slot is not None
            self._elsewhere = dict.fromkeys(self._robots, began)
            self._start_over(slot)
        if slot is None and (trusted or checked) and not self._elsewhere:
            self._answer(self.clock.slot(began))
        if trusted and slot is None:
            self._elsewhere[src_id] = began
        elif trusted and self._elsewhere:
            self._elsewhere.pop(src_id, None)
        return slot

    def _claim(self, slot: int, src_id: int) -> None:
        owner = self._taken[slot]
        if owner != src_id:
            self._conflicts[slot] = max(owner, src_id)
        self._taken[slot] = min(owner, src_id)
        if slot in self._mine:
            if src_id < self.src_id or slot not in self._announced:
                self._mine.remove(slot)
            else:
                self._conflicts[slot] = src_id

    def _named(self, names: tuple[int, ...], slot: int) -> None:
        for name in names:
            other = self._robots.get(name)
            if name == self.src_id:
                self._confirmed_at = max(self._confirmed_at, slot)
                self._rate = _NAMED_RATE if self._entered_at is None else _ENTRY_RATE
            elif other is not None and other.named == _NEVER:
                other.named = self._turn(slot)  # one confirmation is enough
            elif name != NOBODY:
                self._named_at = slot

    def _mapped(self, robot: _HeardRobot, expected: int, conflict: tuple[int, int]) -> None:
        slot = robot.last
        at = slot + 1
        known = next((ahead for sent, ahead in reversed(self._said) if sent < slot - 1 - self._ahead), ())
        mine = next((mine for mine in known if mine >= at), slot)
        if 0 <= mine - at < MAP_SLOTS:
            robot.deaf = 0 if expected >> mine - at & 1 else robot.deaf + 1
        skip = at - self._base
        expected = expected << skip if skip > 0 else expected >> -skip
        for mine in self._mine:
            if mine > self._base:
                expected &= ~(1 << mine - self._base)
        self._expected |= expected
        ahead, loser = conflict
        if ahead and loser == self.src_id and slot + ahead in self._mine:
            self._mine.remove(slot + ahead)

    def _start_over(self, slot: int) -> None:
        """The clock has moved to a slot: what was known by slot is void."""
        self._leave()
        self._taken.clear()
        self._expected = 0
        self._conflicts.clear()
        self._robots.clear()
        self._heard_at = self._confirmed_at = self._named_at = _NEVER
        self._swept, self._base = _NEVER, slot - 1
        self._rate = _ENTRY_RATE
