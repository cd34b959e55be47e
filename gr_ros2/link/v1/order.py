"""The order of delivery: how long a complete message waits for an earlier one.

A message of a topic with reliable publishers waits until every packet before the one in which it began is here or
given up, unless it is known that those packets carried other topics (``gap_contents``). A sender that gets reports
repairs a missing packet, or says that it does not any more, also after an outage. Only then it is given up, or when the
sender has started again, or when the messages that wait fill the memory. From a sender without reports a missing packet
is also given up ``hold_s`` after it was missed, or at once if hardly any missing packet comes back.

A message that came over other robots waits in the same way, as long as its sender is heard. Once that is silent, it
comes out when all up to the message are here that it tells to be before it, whatever packets are missing. Of a robot
that was never heard itself, it waits for these no longer than ``patience_s``, since nobody else may bring them.

Invariants: messages of one topic come out in the order in which they began; the bytes that wait are bounded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from math import inf

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.link.v1.gap_contents import GapContents
from gr_ros2.wire.control import MAP

_VOID = 256
"""Packets noted as left out of repairs before the notes about old ones are dropped."""
_COST = 430
"""Bytes beside its payload that a message takes which waits, one that came over others with all that is known of it
(measured with ``tracemalloc``)."""


@dataclass(slots=True)
class Ready:
    """A complete message.

    :param order: number of the packet in which it began, and its place among the entries there
    :param qos: QoS class of the packet that completed it; -1 if that packet was recovered
    :param hops: robots that have sent it on
    :param over: the last of them; None where it came from the robot that made it
    :param carried: it was handed on to this robot
    :param made: when it was made, s, as far as that is known: not later
    :param sealed: time in s after which its last packet was sealed, where that has to be proven and it came over others
    :param limit_s: age in s at which it is of no more use
    :param after: the order of a message of its topic, between which and this one there is no other; None if unknown
    :param came: when it began to wait for others, s
    """

    topic_id: int
    order: tuple[int, int]
    payload: bytes
    qos: int
    coded: bool
    repaired: bool
    hops: int = 0
    over: int | None = None
    carried: bool = False
    made: float = inf
    sealed: float = inf
    limit_s: float = inf
    after: tuple[int, int] | None = None
    came: float = -inf


def nobody(_since: float) -> bool:
    """Nobody brings anything."""
    return False


def nothing(_topic_id: int) -> tuple[int, int] | None:
    """No message is incomplete."""
    return None


ALL = 255
"""A place behind all messages that began in a packet."""


class Order:
    """Which packets of one sender are still waited for, and the messages that wait for them.

    :param decoder: knows which packets are here
    :param first: packets before this number are neither waited for nor needed
    :param hold_s: s that a message waits for an earlier one whose sender gets no reports
    :param sure: bytes of messages that may always wait
    :param fits: whether more of them may wait
    :param room: bytes of the longest body
    :param quiet_s: s after which what others say of a sender counts
    :param patience_s: s for which a message waits for those before it that others may bring, from when one of those
        was met
    :param incomplete: the order of the oldest message of a topic of which a part is missing
    :param brings: whether a robot that is heard still repairs something that was missing at this time, s: it may bring
        these, so they are waited for as long again
    :ivar contents: which topics missing packets can have carried
    :ivar told: whether the sender gets reports. It then says which packets it does not repair any more
    :ivar low: every packet before this number is here or given up
    :ivar wanted: every packet before this number is here, or is not repaired any more
    :ivar held: bytes of the messages that wait
    :ivar all_from: from this packet number on no message was given up for want of memory
    :ivar reached: the newest message of each topic that came out; all before it came out or are given up
    :ivar passed_on: the newest message of each topic that is kept for others
    """

    def __init__(
        self,
        decoder: RepairDecoder,
        first: int,
        hold_s: float,
        *,
        sure: int,
        fits: Callable[[int], bool],
        room: int,
        quiet_s: float = inf,
        patience_s: float = inf,
        incomplete: Callable[[int], tuple[int, int] | None] = nothing,
        brings: Callable[[float], bool] = nobody,
        tuning: Tuning = Tuning(),
    ) -> None:
        self._tuning = tuning
        self.told = False
        self.low = self.wanted = self.all_from = first
        self.held = 0
        self._heard = -inf
        """When the sender was heard last, s."""
        self.reached: dict[int, tuple[int, int]] = {}
        self.passed_on: dict[int, tuple[int, int]] = {}
        self._since: dict[int, float] = {}
        """When a message came out last in a topic in which others wait, or a robot came that may bring others, s."""
        self.contents = GapContents(decoder, room, tuning)
        self._passed: dict[int, int] = {}
        """By topic: no missing packet before this number can have carried something of it."""
        self._decoder = decoder
        self._hold_s, self._quiet_s, self._patience_s, self._brings = hold_s, quiet_s, patience_s, brings
        self._sure, self._fits, self._incomplete = sure, fits, incomplete
        self._dead = first
        """The sender does not repair packets before this number any more."""
        self._void: set[int] = set()
        """Packets that their sender has left out of a repair."""
        self._most_void = _VOID
        self._gaps: deque[tuple[float, int, int]] = deque()
        """Packets that are missing: since when (s), the first and the last of them."""
        self._recovery = 1.0
        """Share of missing packets that are recovered in time."""
        self._waiting: dict[int, list[Ready]] = {}
        self._asked = -inf
        """When it was looked last, s."""

    def hear(self, now: float) -> None:
        """The sender was heard."""
        self._heard = now

    def reported(self) -> None:
        """The sender gets reports, to the end of this start: it keeps what is lacked here."""
        self.told = True

    def missing(self, now: float, first: int, last: int) -> None:
        """Note that these packets had not arrived when the sender went on."""
        self._gaps.append((now, first, last))

    def repaired_from(self, number: int) -> None:
        """The sender does not repair packets before this number any more."""
        self._dead = max(self._dead, number)

    def left_out(self, number: int, mask: int) -> None:
        """Note the packets that a sender has left out of a repair with holes in its window: it does not repair them.

        :param mask: bit i says that packet ``number - i`` is part of it
        """
        for back in range(mask.bit_length()):
            if not mask >> back & 1 and number - back not in self._decoder and number - back >= self.wanted:
                self._void.add(number - back)
        if len(self._void) > self._most_void:
            self._void = {left_out for left_out in self._void if left_out >= self.wanted}
            self._most_void = len(self._void) + _VOID

    def wait(self, ready: Ready, now: float) -> None:
        """Keep a message until nothing before it is missing."""
        if self.told_again(ready):
            return
        line = self._waiting.setdefault(ready.topic_id, [])
        if not line:
            self._since[ready.topic_id] = now
        ready.came = now
        self.held += len(ready.payload) + _COST
        line.append(ready)

    def wait_anew(self, now: float) -> None:
        """A robot is heard, or is heard again, that may bring what is waited for. One at the edge of its range would be
        heard again and again, and bring nothing."""
        for topic_id, line in self._waiting.items():
            if line and now < min(ready.came for ready in line) + self._tuning.order_anew * self._patience_s:
                self._since[topic_id] = now

    def told_again(self, ready: Ready) -> bool:
        """Whether a message waits already; it may tell better now what is before it."""
        for other in self._waiting.get(ready.topic_id, ()):
            if other.order == ready.order:
                if ready.after is not None and (other.after is None or ready.after < other.after):
                    other.after = ready.after
                return True
        return False

    def passes(self, ready: Ready) -> bool:
        """Whether a message comes out at once; notes that it does. One that came over others did not bring the packet
        in which it began, which others may have begun or ended in before it."""
        reached = self.reached.get(ready.topic_id, (-1, 0))
        if (ready.order[0] > self.low or ready.over is not None) and ready.order > reached:
            return False
        self.reached[ready.topic_id] = max(reached, ready.order)
        return True

    def up_to(self, topic_id: int) -> tuple[int, int]:
        """All messages of a topic up to this one are here, or are given up."""
        here = self._pass(topic_id) - 1, ALL
        part = self._incomplete(topic_id)
        if part is not None and part <= here:  # it goes on in a packet that is missing
            begin, place = part
            here = (begin, place - 1) if place > 0 else (begin - 1, ALL)
        return max(here, self.reached.get(topic_id, (-1, 0)))

    def ahead(self, topic_id: int) -> bool:
        """Whether messages have come over others that began more than a report covers after the first packet that is
        waited for: its sender does not know that it repairs them in vain."""
        return self.reached.get(topic_id, (-1, 0))[0] > self.wanted + MAP

    def before(self, ready: Ready) -> tuple[int, int] | None:
        """Number and place of the message after which one that came out follows, as far as that is known."""
        since = self.all_from - 1, ALL
        last = max(self.passed_on.get(ready.topic_id, since), since)
        return min(last, ready.after or last) if last < ready.order else ready.after

    def _pass(self, topic_id: int) -> int:
        """No missing packet before this number can have carried something of a topic."""
        decoder, here, void, may_carry = self._decoder, self._decoder.bodies, self._void, self.contents.may_carry
        passed, newest = max(self.low, self._passed.get(topic_id, 0)), decoder.newest
        while passed <= newest and (passed in here or passed in void or not may_carry(passed, topic_id)):
            passed += 1
        self._passed[topic_id] = passed
        return passed

    def settle(self, now: float) -> list[Ready]:
        """Find up to which packet everything is here or given up; the messages that waited for that, topic by topic."""
        decoder, void, gaps = self._decoder, self._void, self._gaps
        self._asked = now
        newest, floor, here = decoder.newest, decoder.floor, decoder.bodies
        dead = self._dead if self._dead > floor else floor
        low = max(self.low, dead if dead <= newest else newest + 1)
        while gaps and gaps[0][2] < floor:
            gaps.popleft()
        waits = self.held <= self._sure or self._fits(self.held)
        if not waits:
            low = self.all_from = newest + 1
        elif gaps and not self.told:
            low = self._give_up(low, dead, now)
        while low <= newest and (low in here or low in void):
            low += 1
        wanted = self.wanted if self.wanted > dead else dead
        while wanted <= newest and (wanted in here or wanted in void):
            wanted += 1
        self.wanted = wanted
        self.low = low
        due: list[Ready] = []
        quiet = now >= self._heard + self._quiet_s
        for topic_id, line in self._waiting.items():
            if line:
                passed = self._pass(topic_id)
                line.sort(key=lambda ready: ready.order)
                over = False
                while line:
                    ready = line[0]
                    if waits and not self._next(ready, passed) and not (quiet and self._follows(ready)):
                        if not (quiet and self._waited(ready, now)):
                            break
                        over = True
                    due.append(line.pop(0))
                    self.reached[topic_id] = max(self.reached.get(topic_id, ready.order), ready.order)
                    if not over:  # what was missing has come, and more may; what is given up delays nothing else
                        self._since[topic_id] = now
                    self.held -= len(ready.payload) + _COST
        return due

    def _next(self, ready: Ready, passed: int) -> bool:
        """Whether nothing before a message is missing, where no packet before ``passed`` is."""
        if ready.over is None or ready.order[0] != passed:
            return ready.order[0] <= passed
        return ready.after is not None and ready.after <= self.up_to(ready.topic_id)

    def _follows(self, ready: Ready) -> bool:
        """Whether all messages are here before one that others may bring."""
        here = self.up_to(ready.topic_id)
        return ready.order <= here or (ready.after is not None and ready.after <= here)

    def _waited(self, ready: Ready, now: float) -> bool:
        """Whether a message has waited for so long that nobody brings those before it any more."""
        if ready.over is None or now < self._until(ready):
            return False
        if self._brings(self._since[ready.topic_id]):
            self._since[ready.topic_id] = now
            return False
        return True

    def _until(self, ready: Ready) -> float:
        """Until when a message waits for others to bring those before it, s."""
        return max(self._since[ready.topic_id], ready.came) + self._patience_s

    def missing_since(self) -> float:
        """When the packet that its sender repairs first was found to be missing, s; inf for none."""
        if not self.told or self.wanted > self._decoder.newest:
            return inf
        return next((since for since, first, last in self._gaps if first <= self.wanted <= last), inf)

    def next_timeout(self) -> float | None:
        """Time in s at which missing packets are given up for which messages wait, or what others say counts."""
        soonest = inf
        for line in self._waiting.values():
            if line and line[0].over is not None:
                soonest = min(soonest, max(self._until(line[0]), self._heard + self._quiet_s))
                if self._asked < self._heard + self._quiet_s:
                    soonest = min(soonest, self._heard + self._quiet_s)
            if line and self._gaps and not self.told:
                soonest = min(soonest, self._gaps[0][0] + self._hold_s)
        return None if soonest == inf else soonest

    def beyond(self, number: int) -> list[Ready]:
        """Give up messages that wait, came over others, and began in a later packet than this one."""
        for newest in (self.reached, self.passed_on):
            for topic_id in [topic_id for topic_id, order in newest.items() if order[0] > number]:
                del newest[topic_id]
        given_up: list[Ready] = []
        for line in self._waiting.values():
            given_up += [ready for ready in line if ready.over is not None and ready.order[0] > number]
            line[:] = [ready for ready in line if ready.over is None or ready.order[0] <= number]
        self.held -= sum(len(ready.payload) + _COST for ready in given_up)
        return given_up

    def without(self, topic_ids: Collection[int]) -> list[Ready]:
        """The messages that wait, in their order, except those of these topics; they do not wait any more."""
        given_up: list[Ready] = []
        for topic_id in [topic_id for topic_id in self._waiting if topic_id not in topic_ids]:
            given_up += sorted(self._waiting.pop(topic_id), key=lambda ready: ready.order)
        self.held -= sum(len(ready.payload) + _COST for ready in given_up)
        return given_up

    def _give_up(self, low: int, dead: int, now: float) -> int:
        """The number up to which missing packets are given up; also updates the share of packets that are recovered."""
        gaps, decoder = self._gaps, self._decoder
        while gaps and gaps[0][0] + self._hold_s <= now:
            _, first, last = gaps.popleft()
            for number in range(max(first, last + 1 - MAP), last + 1):  # earlier ones hardly count
                if number in decoder:
                    self._recovery += (1 - self._recovery) * self._tuning.order_smoothing
                elif number >= dead and number not in self._void:
                    self._recovery -= self._recovery * self._tuning.order_smoothing
            low = max(low, last + 1)
        if gaps and self._recovery < 0.5:
            low = max(low, gaps[-1][2] + 1)
        return low
