"""What the reports of other robots tell: which packets each of them has, lacks, or waits for in vain.

Invariant: what is told about a packet that was never sent changes nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterable
from dataclasses import dataclass, field
from heapq import heappop, heappush
from math import inf, ldexp

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.link.v1.receipts import Receipts
from gr_ros2.link.v1.sent_packets import Sent, SentPackets
from gr_ros2.link.v1.shared import SharedRepairs, newest_of
from gr_ros2.link.v1.unreported import Unreported
from gr_ros2.wire.control import MAP
from gr_ros2.wire.v1 import MAX_WINDOW

START = 64
"""If a robot is first heard within this number of packets of its start, its packets count from its start on."""
REACH = MAX_WINDOW - 2
"""How many packets before the last one that a peer may take for a replay a combination brings back, which stands at a
later number. A peer needs no older ones."""
_TIMES = 512


@dataclass(slots=True, eq=False)
class Peer:
    """What is known from the reports of one peer."""

    tuning: Tuning
    bit: int
    heard: float
    interval: float
    """Mean time in s until it reports, while there is something to report and it loses something."""
    loss: float = 0.0
    joins: bool = True
    """Whether it has not reported since it came, or came back."""
    newest: int = -1
    proven: int = 0
    """It may take packets up to this number for replays. A combination that stands at a later one brings them back."""
    settled: int = 0
    """It needs no packet before this number."""
    calm: float = 0.0
    """Longest time in s of late between two reports, while there is something to report and it loses nothing."""
    reports_soon: bool = False
    """Whether it reports every packet, so soon that it is better to wait for a report than to expect losses."""
    asked: float = inf
    """Time in s at which the first repair left that no report has followed."""
    waits: int = -1
    """The oldest packet that reports miss and that the sender does not repair any more; -1 for none."""
    waits_since: float = inf
    """Time in s since which reports miss such packets."""
    delays: deque[float] = field(init=False)
    answers: deque[float] = field(init=False)
    """Times in s from the departure of packets that were sent once to the report that covers them."""
    lost: set[int] = field(default_factory=set)
    urgent: list[tuple[bool, int]] = field(default_factory=list)
    """Heap of those of them for which later messages wait, or may wait soon: whether all in it are long, its number."""
    turn: int = 0
    """Which of all packets that were urgent was for it last."""

    rough: float = inf
    """Shortest time in s from the first departure of packets that were sent again to the report that covers them."""
    roughs: int = 0
    """Reports of such packets in a row."""
    repairs: int = 0
    """Repairs that have left since its last report."""
    has: dict[int, tuple[int, int]] = field(default_factory=dict)
    """By topic: it has all messages up to this one, as it says."""

    def __post_init__(self) -> None:
        self.delays = deque(maxlen=self.tuning.peer_delays)
        self.answers = deque(maxlen=self.tuning.peer_delays)

    @property
    def delay(self) -> float:
        """Shortest time in s from a packet's departure to the report that covers it. While it is known of packets only
        that were sent again, as losses make it longer, each repair that no report follows halves it."""
        if self.delays:
            return min(self.delays)
        return 0.0 if self.rough == inf else ldexp(self.rough, -self.repairs)

    @property
    def answer(self) -> float:
        """Time in s after which a report about a packet is to be expected."""
        return max(self.answers) if self.reports_soon else self.delay + self.interval

    def under_way(self, now: float) -> float:
        """Time in s for which a repair may be on its way; ever longer where no report follows. Otherwise a robot that
        is heard and does not hear would have all air that is free for as long as it is there."""
        return max(self.answer, self.tuning.peer_under_way_s, (now - self.asked) / self.tuning.peer_silence)

    @property
    def patience(self) -> float:
        """Time in s after which a packet that no report covers counts as lost, with ``doubt``."""
        return max(self.answer if self.reports_soon else 2 * self.answer, self.tuning.peer_under_way_s)

    @property
    def doubt(self) -> float:
        """Probability that a packet is lost if its report does not come: it or the report was lost."""
        return 1 / (2 - self.loss) if self.reports_soon else max(self.loss, 0.5)

    def overdue(self) -> tuple[float, float, float]:
        """When the report about a packet is overdue: so long after the packet left, and, for one that left after a
        time, not before another time; all in s.

        A peer that loses nothing reports the first packet after a rest at once, and keeps the report about those that
        follow back. What had arrived before a report left is in that report.
        """
        return self.patience, self.heard - self.delay, self.heard + self.tuning.peer_later * self.calm


class Peers:
    """The robots that report what they have of one sender's packets.

    What one that is out of range lacks of messages in order is kept for it and repaired when it is back, however long
    that takes.

    :param packets: the packets that they confirm
    :param unreported: what holds while there are none
    :param shared: on a channel that others share
    :param slower: see ``Settings``
    :ivar all: the peers, by robot id
    :ivar loss: share of packets that the peer with the most losses loses, as far as it is known or expected
    :ivar proven: some peer may take packets up to this number for replays
    :ivar provens: the same of each peer, the highest first
    :ivar joined: how often a peer that has come, or has come back, has reported for the first time
    :ivar receipts: the packets that any of them has; None while nobody asks for them
    :ivar in_vain: whether a peer waits for a packet in vain
    :ivar any_urgent: whether a packet may be urgent for some peer
    :ivar once: the newest packets that were neither sent again nor combined: what a report says arrived when it was
        sent
    """

    def __init__(
        self,
        packets: SentPackets,
        unreported: Unreported,
        tuning: Tuning,
        shared: SharedRepairs | None = None,
        *,
        slower: float = 1.0,
    ) -> None:
        self._tuning = tuning
        self.all: dict[int, Peer] = {}
        self._interval = self._tuning.peer_interval_s * slower
        self._away: dict[int, Peer] = {}
        self.loss = unreported.loss
        self.proven, self.provens = 0, [0]
        self.in_vain = False
        self.joined = 0
        self.receipts: Receipts | None = None
        self.once: set[int] = set()
        self._packets, self._unreported, self._shared = packets, unreported, shared
        self._resend: list[int] = []
        """Negated numbers of the packets that the only peer lacks."""
        self.any_urgent = False
        self._turn = 0
        self._times: dict[int, float] = {}
        """When the newest packets left, s."""
        self._ordered: float = -1 if shared is None else inf
        """The newest packet of a message that is delivered in order. A peer cannot know what a missing packet carried:
        this message waits for every packet before it. Infinite on a shared channel, where repairs are few: there only
        packets with a part of such a message are urgent."""
        self._served: set[int] = set()
        """Peers that lack the packet that was urgent last."""
        self._period = 0.0
        """Mean time between two of them, s."""

    def __bool__(self) -> bool:
        """Whether any peer reports."""
        return bool(self.all)

    @property
    def gone(self) -> bool:
        """Whether peers have reported, and all are out of range."""
        return bool(self._away) and not self.all

    def sent(self, number: int, lifetimes: tuple[Lifetime, ...], now: float) -> None:
        """A source packet leaves, after ``SentPackets.newest``."""
        for lifetime in lifetimes:
            if lifetime.in_order:
                self._ordered = number if number > self._ordered else self._ordered
                break
        before = self._times.get(self._packets.newest)
        if before is not None:
            self._period += (now - before - self._period) / 8
        self._times[number] = now
        self._times.pop(number - _TIMES, None)
        self.once.add(number)
        self.once.discard(number - _TIMES)

    def meet(self, src_id: int, now: float) -> Peer:
        """A peer that reports is known; from now on, a packet is confirmed only after this one confirmed it too."""
        self._unreported.end()
        peer = self.all.get(src_id)
        if peer is None:
            packets = self._packets
            if src_id in self._away:
                peer = self._away.pop(src_id)
                peer.heard = now
            else:
                free = next(bit for bit in range(256) if not (packets.everybody | packets.away) >> bit & 1)
                peer = Peer(self._tuning, 1 << free, now, self._interval)
            self.all[src_id], peer.joins = peer, True
            packets.here(peer.bit)
            self._note()
        return peer

    def leave(self, src_id: int) -> None:
        """A peer is out of range, until it is met again or forgotten."""
        peer = self.all.pop(src_id, None)
        if peer is not None:
            peer.waits, peer.waits_since = -1, inf
            peer.lost.clear()  # its next reports name anew what it lacks, and make that urgent
            peer.urgent.clear()
            self._away[src_id] = peer
            self._packets.leave(peer.bit)
            self._note()

    def forget(self, src_id: int) -> None:
        """A peer has ended."""
        for peers in (self.all, self._away):
            if src_id in peers:
                self._packets.forget(peers.pop(src_id).bit)
                self._note()

    def confirm(self, *, in_order: bool) -> bool:
        """Whether some peer will say that it has a message: for one that is delivered in order, also if all are out of
        range."""
        return bool(self.all or (in_order and self._away))

    def prove(self, src_id: int, number: int, *, wanted: bool = False) -> None:
        """A peer is told that packets above a number were sealed after it had started.

        :param wanted: it says that it lacks such a proof
        """
        peer = self.all.get(src_id)
        if peer is not None and (wanted or peer.newest < 0):  # a report shows that it knows
            peer.proven = number
            if number <= START and peer.newest < 0:  # later its reports name what it lacks, and make that urgent
                records = self._packets.records
                peer.lost.update(older for older, record in records.items() if older <= number and record.lifetimes)
            self._note()

    def report(self, src_id: int, number: int, arrived: int, *, settled: bool, loss: float, now: float) -> None:
        """A peer says what it has.

        :param number: newest number that the report covers
        :param arrived: bit i says that the peer has ``number - i``
        :param settled: the peer needs no packet older than those 64
        :param loss: recent share of packets that it lost
        """
        if number > self._packets.newest:
            return
        peer = self.meet(src_id, now)
        self.joined += peer.joins
        peer.joins = False
        if peer.newest < 0:
            peer.lost.clear()  # what it was expected to lack
        self._note_times(peer, number, loss, now)
        records, bit, delay = self._packets.records, peer.bit, peer.delay
        if self.receipts is not None:
            alive = lambda older: older in records and records[older].alive(now)  # noqa: E731
            self.receipts.report(src_id, number, arrived, alive, self._packets.told)
        if settled:
            lacks = ~arrived & (1 << MAP) - 1
            needs = number - lacks.bit_length() + 1
            if peer.proven > needs + REACH:  # it has taken an earlier proof than the last one that was sent
                peer.proven = needs + REACH
                peer.lost.clear()
        missing: list[Sent] = []
        # A report of newer packets says nothing about an older one.
        waits = [peer.waits] * (not settled and 0 <= peer.waits <= number - MAP)
        for back in range(MAP):
            record = records.get(number - back)
            if arrived >> back & 1:
                if record is not None and not (record.skipped & bit and record.number <= self._packets.told):
                    record.confirmed |= bit
                    record.skipped &= ~bit
                    peer.lost.discard(record.number)
            elif record is None or not self._packets.repaired(record, now):
                older = number - back
                if older > 0 and self._waits(older, number, now):
                    waits.append(older)
            elif (record.confirmed | record.skipped) & bit:
                continue
            elif now - record.at >= delay:
                if record.parted & bit:
                    record.skipped |= bit
                else:
                    missing.append(record)
        self._lacks(peer, missing)
        peer.waits = min(waits, default=-1)
        peer.waits_since = min(peer.waits_since, now) if peer.waits >= 0 else inf
        self._note()
        if settled:
            self._settle(peer, number - MAP, needs)
        self._packets.retire(now)

    def has(self, src_id: int, topic_id: int, order: tuple[int, int], now: float) -> None:
        """A peer says that all messages of a topic up to one have come, over others: it needs no packet with nothing
        else."""
        peer, records = self.all.get(src_id), self._packets.records
        before = (-1, 0) if peer is None else peer.has.get(topic_id, (-1, 0))
        if peer is None or order <= before:
            return
        peer.has[topic_id] = order
        for number in range(max(before[0], self._packets.oldest), order[0] + 1):
            alive = [one for one in records[number].lifetimes if now < one.expires] if number in records else []
            if alive and all(one.in_order and one.order <= peer.has.get(one.topic_id, (-1, 0)) for one in alive):
                records[number].confirmed |= peer.bit
                peer.lost.discard(number)
        self._packets.retire(now)

    def _waits(self, older: int, number: int, now: float) -> bool:
        """Whether a peer may wait for a packet that is not repaired.

        :param number: newest number that its report covers
        """
        if self._shared is not None:
            return self._shared.waits(older, now, self._period)
        # The next message in order tells it of what was not sent to all.
        return older not in self._packets.parted or older <= min(self._ordered, number - MAP // 2)

    def _settle(self, peer: Peer, number: int, needs: int) -> None:
        """A peer has all packets up to a number that are worth something, and needs none before another one."""
        records = self._packets.records
        for older in range(max(self._packets.oldest, peer.settled), number + 1):
            if older in records and not records[older].skipped & peer.bit:
                records[older].confirmed |= peer.bit
        peer.settled = max(peer.settled, needs)
        peer.lost = {lost for lost in peer.lost if lost >= peer.settled}

    def _lacks(self, peer: Peer, missing: list[Sent]) -> None:
        """A report names these packets, the newest first, as lost."""
        for record in missing:
            if record.number not in peer.lost:
                peer.lost.add(record.number)
                heappush(self._resend, -record.number)
                if record.number in self._packets.parted:
                    continue  # nothing waits for it
                if self._ordered < inf or any(lifetime.in_order for lifetime in record.lifetimes):
                    heappush(peer.urgent, (all(lifetime.long for lifetime in record.lifetimes), record.number))
                    self.any_urgent = True
        records = self._packets.records
        if len(peer.urgent) + len(self._resend) > 4 * len(records) + MAP:  # most of these are over
            peer.urgent = sorted({entry for entry in peer.urgent if entry[1] in records})
            self._resend = sorted({resend for resend in self._resend if -resend in records})

    def urgent(self, now: float) -> Sent | None:
        """The oldest packet that a report of a peer names as lost and for which later messages wait; packets of long
        messages go after others: otherwise odometry beside 1 MB is 5 to 11 % older at 20 % loss. It is returned once.

        The peers take turns: one that comes back after minutes lacks hundreds of packets, which keep nothing back from
        another one that lacks a newer one.
        """
        waiting = [peer for peer in self.all.values() if peer.urgent]
        for peer in sorted(waiting, key=_turn) if len(waiting) > 1 else waiting:
            record = self._oldest_urge(peer, now)
            if record is not None:
                lacking = [other for other in self.all.values() if record.number in other.lost]
                self._turn += 1
                for other in lacking:
                    other.lost.discard(record.number)
                    other.turn = self._turn
                self._served = {id(other) for other in lacking}
                return record
        self.any_urgent = any(peer.urgent for peer in waiting)
        self._served = set()
        return None

    def _oldest_urge(self, peer: Peer, now: float) -> Sent | None:
        while peer.urgent and peer.urgent[0][1] <= self._ordered:
            _, number = heappop(peer.urgent)
            record = self._packets.records.get(number)
            if number in peer.lost and record is not None and record.alive(now):
                return record
        return None

    @property
    def needed_from(self) -> int:
        """What those need that lack the packet that was urgent last, and may take it for no replay, begins with this
        one: a peer that has come after an older packet could never use a combination with it. 0 where none was urgent.
        """
        lacking = [peer for peer in self.all.values() if id(peer) in self._served]
        return max((max(peer.settled, peer.proven + 1) for peer in lacking), default=0)

    def served(self, window: list[Sent]) -> None:
        """A combination brings one packet back to each peer, beside those to whom ``urgent`` was due."""
        for peer in self.all.values():
            lost = None if id(peer) in self._served else newest_of(window, peer.lost)
            if lost is not None:
                peer.lost.discard(lost)

    def lost(self, now: float) -> Sent | None:
        """The newest live packet that the only peer lacks and that has not been sent again since; that some peer lacks,
        where not all packets are for all of them, so that combinations are of no use."""
        if not self._resend or not (len(self.all) == 1 or self._packets.parts):
            return None
        while self._resend:
            number = -heappop(self._resend)
            record = self._packets.records.get(number)
            lacking = [peer for peer in self.all.values() if number in peer.lost and number > peer.proven]
            for peer in lacking:
                peer.lost.discard(number)
            if record is not None and record.alive(now) and any(not record.confirmed & peer.bit for peer in lacking):
                return record
        return None

    def lacking(self, record: Sent) -> list[int]:
        """The peers that a packet was sent to and that have not confirmed it."""
        have = record.confirmed | record.skipped
        return [src_id for src_id, peer in self.all.items() if not have & peer.bit]

    def bits(self, src_ids: Iterable[int]) -> int:
        """The bits of some peers."""
        return sum(self.all[src_id].bit for src_id in src_ids if src_id in self.all)

    def replayed(self, number: int) -> bool:
        """Whether a peer that may need a packet may take it for a replay."""
        return any(peer.settled <= number <= peer.proven for peer in self.all.values())

    def lack(self, packets: list[Sent]) -> bool:
        """Whether a report names one of these packets as lost."""
        return any(record.number in peer.lost for peer in self.all.values() if peer.lost for record in packets)

    def given_up(self, now: float, patience_s: float = 0.0) -> int:
        """The oldest packet that a peer has waited for longer than so many s in vain: it is not repaired any more.
        -1 for none."""
        if not self.in_vain:
            return -1
        waits = [p.waits for p in self.all.values() if p.waits >= 0 and p.waits_since + patience_s <= now]
        return min(waits, default=-1)

    def announced(self, numbers: Container[int]) -> None:
        """The peers are told which of these packets are not repaired any more."""
        for peer in self.all.values():
            if peer.waits in numbers:
                peer.waits, peer.waits_since = -1, inf
        self.in_vain = any(peer.waits >= 0 for peer in self.all.values())

    def _note(self) -> None:
        """Take together what is known of the peers; every new packet asks for that."""
        peers = self.all.values()
        self.provens = sorted({peer.proven for peer in peers}, reverse=True) or [0]
        self.proven = self.provens[0]
        self.in_vain = any(peer.waits >= 0 for peer in peers)
        self.loss = max((peer.loss for peer in peers), default=self._unreported.loss)

    def _note_times(self, peer: Peer, number: int, loss: float, now: float) -> None:
        """Note how often and how soon a peer reports."""
        # Of a packet that was sent again it is not known which departure is reported, nor how many reports were lost.
        # And before the first packet since its last report, there was nothing to report.
        once, since = number in self.once, max(peer.heard, self._times.get(peer.newest + 1, -inf))
        between = now - peer.heard
        if loss or self._shared is not None:
            peer.calm = 0.0
        if not loss and self._shared is None and since < peer.heard + max(peer.interval, peer.calm):  # it was kept back
            peer.calm = max(between, peer.calm + (between - peer.calm) / 8)
        elif once or now - since < peer.interval:
            peer.interval += (now - since - peer.interval) / 8
        peer.heard, peer.loss, peer.asked, peer.repairs = now, loss, inf, 0
        sent_at = self._times.get(number)
        if sent_at is not None and number > peer.newest:  # a report that is repeated says nothing about the way
            took = now - sent_at
            peer.roughs = 0 if once else peer.roughs + 1
            if peer.roughs > self._tuning.peer_delays:
                peer.delays.clear()
            if once or (peer.delays and took < peer.delay):
                peer.delays.append(took)
            else:
                peer.rough = min(peer.rough, took) if peer.roughs % self._tuning.peer_delays else took
            if loss >= self._tuning.report_prompt_loss and once:
                peer.answers.append(took)
        peer.newest = max(peer.newest, number)
        soon = bool(peer.answers) and max(peer.answers) <= self._tuning.peer_soon * self._period
        peer.reports_soon = loss >= self._tuning.report_prompt_loss and soon


def _turn(peer: Peer) -> int:
    return peer.turn
