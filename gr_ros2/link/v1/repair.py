"""What an idle slot carries: the sender's side of repair.

*The rule.* New packets go first, except that a packet which a report names as lost, and for which later messages wait,
goes before them. In a slot without a new packet:

1. if there is one peer and its reports name a lost packet that is still alive, that packet is sent again unchanged;
   the newest such packet goes first;
2. otherwise the slot carries a linear combination over GF(256) of the newest live packets, up to ``GROUP``. If more
   packets are alive, the combination is taken from windows of 127 numbers, which move over all of them and overlap.

A packet is *alive* until every peer that reports has confirmed it, or until all messages in it are over: late, or
replaced by newer ones. Where no peer reports, it is also over after as many repairs as the expected losses need, so
that a robot that nobody hears falls silent. With one live packet the rule is repetition, which is age-optimal. Windows
that overlap even out the losses of their packets: 676 packets at 20 % loss are complete after 1.24 times as many on
average, and after 1.36 times as many in separate groups of 64.

*Thrifty.* A peer that loses packets reports every packet at once if that takes no slot from anything. The sender
then knows when a report is overdue: the packet or its report was lost, and a repair is due. From other peers, whose
reports are rare or take long, it cannot know that so soon: it sends about as many repairs as losses are to be expected,
before a report names them. Where reports come at once, the sender may also repair before it knows of a loss, as often
as ``AHEAD`` allows: a message that waits for a repair delays all later ones of its topic.

Invariants: a repair packet's row is used once per number; no two repairs of the same packets have the same
coefficients; no live packet is more than ``span`` numbers old.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush
from math import inf, sqrt
from typing import Literal, NamedTuple

from gr_ros2.link.v1.gf256 import combine
from gr_ros2.wire.v1 import MAX_WINDOW, ROWS

RepairMode = Literal["idle", "thrifty", "off"]

GROUP = 64
"""Number of packets that a repair combines, as long as no more are alive. Where repair cannot keep up with the losses,
no smaller number does better (55 messages/s of 75 slots, 20 to 40 % lost)."""
SPAN = 30_000
"""Numbers that a sender repairs and a peer remembers, if its memory allows; numbers are mod 65,536."""
START = 64
"""If a robot is first heard within this number of packets of its start, its packets count from its start on."""
MAP = 64
"""Number of packets that a report covers."""

PROMPT = 1 / 64
"""Share of packets lost from which on a peer reports every packet at once, if that takes no slot from anything. The
sender then notices a missing report as soon as it is overdue, and repairs without waiting for the next packet."""
AHEAD = 1.2
"""Most repairs per new packet that are sent before a report calls for them, divided by ``loss / (1 - loss)^3``: a
packet, its repair and the report that would call for another one are all lost with that probability. Without them,
odometry in order is 9.5 % older (± 2.6 %) at 20 % loss, for 5 % fewer packets."""
TURN = 3
"""While a long message is alive, one repair in this many is for short messages."""
_GOLDEN = (5**0.5 - 1) / 2
_DELAYS = 16
_ENOUGH = 0.05
"""Expected number of lost packets that is too small for a repair (thrifty). With 0, odometry takes 8 % more packets at
1 % loss and is no younger."""
_TIMES = 512
_INTERVAL_S = 0.1
"""s between two reports of a peer, until its reports tell. With 0, a sender repairs packets before the first report can
come: three of 141 on ``paper-ofdm-paced`` without losses."""
_MOST_AHEAD = 2.0
_MOST_LOSS = 0.5
_UNDER_WAY_S = 1e-3
"""s for which a repair is under way at least. Without it, a sender with no pace would repair without end where a report
comes at once."""
_SOON = 2
"""Mean times between two new packets within which a report must come to be waited for."""


@dataclass(slots=True, eq=False)
class Lifetime:
    """How long a message is worth repairing.

    :param expires: time in s at which it is of no more use
    :param in_order: whether later messages wait for it
    :param long: whether it takes many packets, so that others go before it
    :param awaited: whether a later message of its topic waits already
    """

    expires: float = inf
    in_order: bool = False
    long: bool = False
    awaited: bool = False

    def end(self) -> None:
        """It was replaced by a newer message, or needs no repair."""
        self.expires = -inf


@dataclass(slots=True, eq=False)
class Sent:
    """A source packet that left.

    :param at: when it was last sent, s
    :param confirmed: one bit per peer
    :param covered: number of repairs of it while nobody reported, divided by the number that is enough
    """

    number: int
    body: bytes
    data: bytes
    lifetimes: tuple[Lifetime, ...]
    at: float
    confirmed: int = 0
    covered: float = 0.0

    def alive(self, now: float) -> bool:
        """Whether a message in it is still worth something."""
        for lifetime in self.lifetimes:  # noqa: SIM110 - any() with a generator takes three times as long
            if now < lifetime.expires:
                return True
        return False


class Repair(NamedTuple):
    """A combination to be sent.

    :param number: the newest number of its window
    :param mask: bit i says that packet ``number - i`` is part of it
    :param row: row of its coefficients
    :param oldest: no packet older than the window is alive
    """

    number: int
    mask: int
    row: int
    oldest: bool
    combined: bytes


@dataclass(slots=True, eq=False)
class Peer:
    """What is known from the reports of one peer."""

    bit: int
    heard: float
    loss: float = 0.0
    newest: int = -1
    proven: int = 0
    """It may take packets up to this number for replays. A combination that stands at a later one brings them back."""
    settled: int = 0
    """It needs no packet before this number."""
    interval: float = _INTERVAL_S
    """Mean time in s between its reports."""
    prompt: bool = False
    """Whether it reports every packet, so soon that it is better to wait for a report than to expect losses."""
    waits: int = -1
    """The oldest packet that the last report misses and that the sender does not repair any more; -1 for none."""
    waits_since: float = inf
    """Time in s since which reports miss such packets."""
    delays: deque[float] = field(default_factory=lambda: deque(maxlen=_DELAYS))
    answers: deque[float] = field(default_factory=lambda: deque(maxlen=_DELAYS))
    """Times in s from the departure of packets that were sent once to the report that covers them."""
    lost: set[int] = field(default_factory=set)

    @property
    def delay(self) -> float:
        """Shortest time in s from a packet's departure to the report that covers it."""
        return min(self.delays) if self.delays else 0.0

    @property
    def answer(self) -> float:
        """Time in s after which a report about a packet is to be expected."""
        return max(self.answers) if self.prompt else self.delay + self.interval

    @property
    def patience(self) -> float:
        """Time in s after which a packet that no report covers counts as lost, with ``doubt``."""
        return self.answer if self.prompt else 2 * self.answer

    @property
    def doubt(self) -> float:
        """Probability that a packet is lost if its report does not come: it or the report was lost."""
        return 1 / (2 - self.loss) if self.prompt else max(self.loss, 0.5)


def _never(_now: float) -> bool:
    return False


class RepairWindow:
    """The source packets of one sender that are still worth repairing.

    :param mode: ``idle`` uses every slot it is offered; ``thrifty`` uses only as many as losses are known or expected;
        ``off`` uses none
    :param room: bytes of the longest body
    :param expected_loss: share of packets lost, used until a report arrives
    """

    def __init__(self, mode: RepairMode, room: int, expected_loss: float = 0.0, span: int = SPAN) -> None:
        self.mode = mode
        self.counts: Counter[str] = Counter()
        """Repair packets by kind: ``resent``, ``combined``."""
        self._room = room
        self._expected = expected_loss
        self._span = span
        self._records: dict[int, Sent] = {}
        """All packets from the oldest one that can still be repaired, by number and in this order."""
        self._oldest = 0
        """No older packet is recorded."""
        self.newest = 0
        """Number of the last source packet; 0 before the first."""
        self._peers: dict[int, Peer] = {}
        self._everybody = 0
        self._proven = 0
        """The highest ``proven`` of all peers."""
        self._in_vain = False
        """Whether a peer waits for a packet in vain."""
        self.loss = expected_loss
        """Share of packets that the peer with the most losses loses, as far as it is known or expected."""
        self._resend: list[int] = []
        """Negated numbers of the packets that the only peer lacks."""
        self._urgent: list[tuple[bool, int]] = []
        """The packets that some peer lacks and for which later messages wait: whether all in it are long, and its
        number."""
        self._owed = 0.0
        """Number of repairs of long messages that are due, because no report will call for them."""
        self._awaited = -1
        """Up to this number, they go before new packets: other messages wait for what was lost."""
        self._rows: dict[int, int] = {}
        """Rows already used, as bits, by number."""
        self._row = 0
        self._turn = 0
        self._place = 0.0
        self._flight: deque[tuple[float, int, int]] = deque()
        """The time until which a repair may be on its way without a report about it, and its window."""
        self._times: dict[int, float] = {}
        """When the newest packets left, s."""
        self._period = 0.0
        """Mean time between two of them, s."""
        self._once: set[int] = set()
        """Those of them that were neither sent again nor combined: what a report says arrived when it was sent."""
        self._ahead = 0.0
        """Number of repairs that may be sent before a report calls for them."""
        self._share = 0.0
        """How much each new packet adds to that number."""

    def sent(self, number: int, body: bytes, data: bytes, lifetimes: tuple[Lifetime, ...], now: float) -> None:
        """A source packet left.

        :param body: its entries, without padding
        :param data: the packet as it was sent
        :param lifetimes: lifetimes of the messages in it; () for a packet that is not worth repairing
        """
        if self.newest in self._times:
            self._period += (now - self._times[self.newest] - self._period) / 8
        self.newest = number
        self._times[number] = now
        self._times.pop(number - _TIMES, None)
        self._once.add(number)
        self._once.discard(number - _TIMES)
        ordered = () if self._peers else [lifetime for lifetime in lifetimes if lifetime.in_order]
        if any(lifetime.long for lifetime in ordered):
            self._owed += self._enough(MAX_WINDOW) / MAX_WINDOW
        if any(lifetime.awaited or not lifetime.long for lifetime in ordered):
            self._awaited = number + MAX_WINDOW
        if lifetimes:
            self._ahead = min(self._ahead + self._share, _MOST_AHEAD)
        if self._records or lifetimes:
            if not self._records:
                self._oldest = number
            self._records[number] = Sent(number, body, data, lifetimes, now)
            if number - self._oldest >= self._span:
                self._trim(number - self._span + 1)

    def meet(self, src_id: int, now: float) -> Peer:
        """A peer that reports is known; from now on, a packet is confirmed only after this one confirmed it too."""
        self._owed = 0.0
        peer = self._peers.get(src_id)
        if peer is None:
            free = next(bit for bit in range(256) if not self._everybody >> bit & 1)
            peer = self._peers[src_id] = Peer(1 << free, now)
            self._everybody |= peer.bit
            self._note_peers()
        return peer

    def proven(self, src_id: int, number: int) -> None:
        """A peer is told that packets above a number were sealed after it had started."""
        peer = self._peers.get(src_id)
        if peer is not None and peer.newest < 0:  # a report shows that it knows
            peer.proven = number
            if number <= START:
                peer.lost.update(
                    older for older, record in self._records.items() if older <= number and record.lifetimes
                )
            self._note_peers()

    def report(self, src_id: int, number: int, arrived: int, *, settled: bool, loss: float, now: float) -> None:
        """A peer says what it has.

        :param number: newest number that the report covers
        :param arrived: bit i says that the peer has ``number - i``
        :param settled: the peer needs no packet older than those 64
        :param loss: recent share of packets that it lost
        """
        if number > self.newest:
            return
        peer = self.meet(src_id, now)
        gap = now - peer.heard
        peer.interval += (gap - peer.interval) / 8
        peer.heard, peer.loss = now, loss
        sent_at = self._times.get(number)
        if sent_at is not None and number >= peer.newest:
            peer.delays.append(now - sent_at)
            if loss >= PROMPT and number > peer.newest and number in self._once:
                peer.answers.append(now - sent_at)
        peer.newest = max(peer.newest, number)
        soon = bool(peer.answers) and max(peer.answers) <= _SOON * self._period
        peer.prompt = loss >= PROMPT and soon
        records, bit, delay = self._records, peer.bit, peer.delay
        peer.waits = -1
        for back in range(MAP):
            record = records.get(number - back)
            if arrived >> back & 1:
                if record is not None:
                    record.confirmed |= bit
                    peer.lost.discard(record.number)
            elif record is None or not record.alive(now):
                if number > back:
                    peer.waits = number - back
            elif record.confirmed & bit:
                continue
            elif now - record.at >= delay and record.number not in peer.lost:
                peer.lost.add(record.number)
                heappush(self._resend, -record.number)
                if any(lifetime.in_order for lifetime in record.lifetimes):
                    heappush(self._urgent, (all(lifetime.long for lifetime in record.lifetimes), record.number))
        peer.waits_since = min(peer.waits_since, now) if peer.waits >= 0 else inf
        self._note_peers()
        if settled:
            for older in range(max(self._oldest, peer.settled), number - MAP + 1):
                record = records.get(older)
                if record is not None:
                    record.confirmed |= bit
                    peer.lost.discard(older)
            peer.settled = max(peer.settled, number - MAP + 1)
        self._retire(now)

    def forget(self, src_id: int) -> None:
        """A peer is gone."""
        peer = self._peers.pop(src_id, None)
        if peer is not None:
            self._everybody &= ~peer.bit
            self._note_peers()
            for record in self._records.values():
                record.confirmed &= ~peer.bit

    @property
    def reported(self) -> bool:
        """Whether any peer reports."""
        return bool(self._peers)

    def take_row(self, number: int) -> int | None:
        """A row that no repair packet at this number has used; None if all are used."""
        used = self._rows.get(number, 0)
        if used == (1 << ROWS) - 1:
            return None
        row = self._row
        while used >> row & 1:
            row = (row + 1) % ROWS
        self._rows[number] = used | 1 << row
        self._row = (row + 1) % ROWS
        if len(self._rows) > 2 * self._span:
            for old in [old for old in self._rows if old < number - self._span]:
                del self._rows[old]
        return row

    def unconfirmed(self, now: float) -> bool:
        """Whether anything is alive."""
        self._retire(now)
        return bool(self._records)

    def _note_peers(self) -> None:
        """Take together what is known of the peers; every new packet asks for that."""
        peers = self._peers.values()
        self._proven = max((peer.proven for peer in peers), default=0)
        self._in_vain = any(peer.waits >= 0 for peer in peers)
        self.loss = max((peer.loss for peer in peers), default=self._expected)
        loss = min(self.loss, _MOST_LOSS)
        self._share = AHEAD * loss / (1 - loss) ** 3

    def next(self, now: float, held: Callable[[float], bool] = _never) -> Sent | Repair | None:
        """What an idle slot carries: a packet sent again unchanged, a combination, or nothing.

        :param held: whether a repair has to wait, at this time in s; only asked if there is one. A thrifty sender has
            few repairs under way: what a report names as lost does not wait then
        """
        if self.mode == "off":
            return None
        self._retire(now)
        if not self._records:
            return None
        thrifty = self.mode == "thrifty"
        if thrifty and (again := self._lost(now)) is not None:
            return again
        window = self._window(now)
        if not window or (thrifty and not self._worth(window, now)):
            return None
        if held(now) and not (thrifty and self._named(window)):
            return None
        if not thrifty and (again := self._lost(now)) is not None:
            return again
        return self._combination(window, now)

    def urgent(self, now: float) -> Sent | Repair | None:
        """What goes before new packets, because later messages wait for it.

        Where there are reports, this is the oldest packet that one of them names as lost; packets of long messages go
        after others. Where there are none, a long message has its repairs while it is sent, if anything waits for it:
        as many as are enough for the expected losses, over the newest packets.
        """
        if self.mode == "off":
            return None
        while self._urgent:
            _, number = heappop(self._urgent)
            record = self._records.get(number)
            lacking = [peer for peer in self._peers.values() if number in peer.lost]
            if record is None or not lacking or not record.alive(now):
                continue
            for peer in lacking:
                peer.lost.discard(number)
            return self._again(record, now)
        if not self._due:
            return None
        self._retire(now)
        if self._owed > GROUP:  # it began before anything waited
            window = self._in_turn(now)
        else:
            window = list(self._live(max(self._oldest, self.newest - MAX_WINDOW + 1), self.newest, now))[::-1]
        if not window:
            self._owed = 0.0
            return None
        return self._combination(window, now)

    @property
    def pressing(self) -> bool:
        """Whether ``urgent`` or ``over`` may have something."""
        return bool(self._urgent) or self._in_vain or self._due

    @property
    def _due(self) -> bool:
        """Whether a repair of a long message goes before new packets."""
        return self._owed >= 1 and self.newest <= self._awaited

    def over(self, now: float, patience_s: float = 0.0) -> int:
        """The oldest packet that a peer has waited for longer than so many s in vain: it is not repaired any more.
        -1 for none."""
        if not self._in_vain:
            return -1
        waits = [p.waits for p in self._peers.values() if p.waits >= 0 and p.waits_since + patience_s <= now]
        return min(waits, default=-1)

    def tell(self, number: int, now: float) -> Repair | None:
        """A repair from which peers learn that a packet is not repaired any more; None if there is none."""
        for peer in self._peers.values():
            peer.waits, peer.waits_since = -1, inf
        self._in_vain = False
        self._retire(now)
        if number < self._oldest:
            window = list(self._live(self._oldest, self._oldest, now))
        else:
            half = MAX_WINDOW // 2
            window = list(self._live(max(number - half, self._oldest), min(number + half, self.newest), now))[::-1]
        return self._combination(window, now) if window else None

    def _again(self, record: Sent, now: float) -> Sent:
        record.at = now
        self.counts["resent"] += 1
        self._ahead = max(self._ahead - 1, -_MOST_AHEAD)
        self._once.discard(record.number)
        return record

    def _named(self, window: list[Sent]) -> bool:
        """Whether a report names a packet of this window that is lost."""
        return any(record.number in peer.lost for peer in self._peers.values() if peer.lost for record in window)

    def next_doubt(self, now: float) -> float:
        """When a report about one of the newest packets, or about a repair, is overdue next (thrifty), s; inf if none
        is expected."""
        soonest = next((at for at, _, _ in self._flight if at > now), inf)
        waits = [(peer.bit, peer.patience) for peer in self._peers.values()]
        for record in reversed(self._records.values()):
            if record.number <= self.newest - GROUP:
                break
            for bit, patience in waits:
                if not record.confirmed & bit and now < record.at + patience < soonest:
                    soonest = record.at + patience
        return soonest

    def exhausted(self, now: float) -> tuple[Lifetime, ...]:
        """The lifetimes of the newest live packet, if no further repair can stand at the newest number and something is
        alive; otherwise (). A packet with these lifetimes and no content makes room for repairs."""
        if self._rows.get(self.newest, 0) == (1 << ROWS) - 1 or self.newest <= self._proven:
            for number in range(self.newest, self._oldest - 1, -1):
                record = self._records.get(number)
                if record is not None and record.alive(now):
                    return record.lifetimes
        return ()

    def _lost(self, now: float) -> Sent | None:
        """The newest live packet that the only peer lacks and that has not been sent again since."""
        if not self._resend or len(self._peers) != 1:
            return None
        (peer,) = self._peers.values()
        while self._resend:
            number = -heappop(self._resend)
            record = self._records.get(number)
            if number in peer.lost and number > peer.proven:
                peer.lost.discard(number)
                if record is not None and not record.confirmed & peer.bit and record.alive(now):
                    return self._again(record, now)
        return None

    def _window(self, now: float) -> list[Sent]:
        """The packets to combine, newest first."""
        found: list[Sent] = []
        everybody = self._everybody
        before = -1
        for record in reversed(self._records.values()):
            if record.number <= before:
                break
            if everybody and record.confirmed & everybody == everybody:
                continue
            for lifetime in record.lifetimes:  # ``alive``, whose call would take half of this loop's time
                if now < lifetime.expires:
                    break
            else:
                continue
            if not found:
                before = record.number - MAX_WINDOW
            found.append(record)
            if len(found) == GROUP:
                break
        if not self._long(now):
            return found
        # A long message must not delay the repair of short ones, and short ones must not prevent that of a long one.
        self._turn += 1
        counts = Counter(lifetime for record in found for lifetime in record.lifetimes)
        longest = max(counts, key=lambda lifetime: counts[lifetime])
        short = [record for record in found if record.lifetimes != (longest,)]
        if short and self._turn % TURN == 0:
            return short
        return self._in_turn(now)

    def _long(self, now: float) -> bool:
        """Whether more packets are alive than one repair can name."""
        if self.newest - self._oldest < GROUP:
            return False
        for count, record in enumerate(self._live(self._oldest, self.newest, now)):
            if count == GROUP or self.newest - record.number >= MAX_WINDOW:
                return True
        return False

    def _live(self, first: int, last: int, now: float) -> Iterator[Sent]:
        everybody = self._everybody
        for number in range(first, last + 1):
            record = self._records.get(number)
            if record is None or (everybody and record.confirmed & everybody == everybody):
                continue
            if record.alive(now):
                yield record

    def _in_turn(self, now: float) -> list[Sent]:
        """The next of the windows over all live packets, newest first.

        The positions of the windows follow the golden section, which spreads any number of them evenly. Windows that
        would reach beyond the ends are moved to the ends, so that the packets there are in as many windows as others.
        """
        self._place = (self._place + _GOLDEN) % 1
        span = self.newest - self._oldest + 1
        first = self._oldest + min(max(int(self._place * span) - MAX_WINDOW // 2, 0), max(span - MAX_WINDOW, 0))
        found = list(self._live(first, min(first + MAX_WINDOW - 1, self.newest), now))
        if not found:  # no live packet there: continue at the next live one
            for record in self._live(first, self.newest, now):
                found = list(self._live(record.number, min(record.number + MAX_WINDOW - 1, self.newest), now))
                break
        return found[::-1]

    def _worth(self, window: list[Sent], now: float) -> bool:
        """Whether more packets are missing, or expected to be missing, than repairs are on their way (thrifty)."""
        flight = self._flight
        while flight and (flight[0][0] <= now or flight[0][2] < self._oldest):
            flight.popleft()
        first, last = window[-1].number, window[0].number
        under_way = sum(1 for _, low, high in flight if low <= last and high >= first)
        if not self._peers:
            return len(window) * self._expected > under_way * (1 - self._expected) + _ENOUGH
        for peer in self._peers.values():
            expected = 0.0 if peer.prompt and self._ahead < 1 else peer.loss
            patience, doubt = peer.patience, peer.doubt
            need = 0.0
            for record in window:
                if not record.confirmed & peer.bit:
                    if record.number in peer.lost:
                        need += 1
                    else:
                        need += doubt if now - record.at > patience else expected
            if need > under_way * (1 - peer.loss) + _ENOUGH:
                return True
        return False

    def _combination(self, window: list[Sent], now: float) -> Repair | None:
        """The combination of a window; of all packets in its span if a mask does not fit beside the bodies."""
        window = self._anchored(window)
        if not window:
            return None
        newest, first = window[0].number, window[-1].number
        size = newest - first + 1
        if len(window) < size:
            longest = max(len(record.body) for record in window)
            if longest + (size + 7) // 8 > self._room:
                window = [self._records[number] for number in range(newest, first - 1, -1)]
        full = len(window) == size
        mask = (1 << size) - 1 if full else sum(1 << newest - record.number for record in window)
        row = self.take_row(newest)
        assert row is not None
        if not self._peers:
            share = 1 / self._enough(len(window))
            for record in window:
                record.covered += share
                if record.covered >= 1:
                    record.lifetimes = ()
        self._owed = max(self._owed - 1, 0.0)
        combined = combine([(record.number, record.body) for record in window], row)
        self._note_in_flight(now, first, newest)
        self._once.difference_update(range(first, newest + 1))
        self.counts["combined"] += 1
        self._ahead = max(self._ahead - 1, -_MOST_AHEAD)
        oldest = first == self._oldest
        return Repair(newest, mask, row, oldest, combined)

    def _enough(self, count: int) -> float:
        """Number of repairs after which so many packets are complete at a peer with the expected loss, all but
        surely (five standard deviations)."""
        lost = count * self._expected
        return (lost + 5 * sqrt(lost) + 3) / (1 - min(self._expected, _MOST_LOSS))

    def _anchored(self, window: list[Sent]) -> list[Sent]:
        """The window, changed so that a repair can stand at its newest packet.

        A later packet is added, or the newest ones are left out.
        """
        full, proven = (1 << ROWS) - 1, self._proven
        newest = window[0].number
        if self._rows.get(newest, 0) != full and newest > proven:
            return window
        for number in range(max(newest, proven) + 1, min(self.newest, window[-1].number + MAX_WINDOW - 1) + 1):
            record = self._records.get(number)
            if record is not None and self._rows.get(number, 0) != full:
                return [record, *window]
        while window and self._rows.get(window[0].number, 0) == full:
            window = window[1:]
        return window if window and window[0].number > proven else []

    def _note_in_flight(self, now: float, first: int, last: int) -> None:
        if self.mode == "thrifty":
            wait = max((peer.answer for peer in self._peers.values()), default=inf)
            wait = max(wait, _UNDER_WAY_S)
            self._flight.append((now + wait, first, last))

    def _retire(self, now: float) -> None:
        """Forget the oldest packets that are not alive."""
        records, everybody = self._records, self._everybody
        oldest = self._oldest
        while oldest <= self.newest:
            record = records.get(oldest)
            if record is not None:
                done = everybody and record.confirmed & everybody == everybody
                if not done and record.alive(now):
                    break
                del records[oldest]
            oldest += 1
        self._oldest = oldest

    def _trim(self, first: int) -> None:
        """Forget all packets older than ``first``."""
        for number in range(self._oldest, first):
            self._records.pop(number, None)
        self._oldest = first
