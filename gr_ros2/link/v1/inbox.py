"""The receiving side for one robot: it turns packets into messages, in order.

*Order.* A message of a topic with reliable publishers waits until every packet before the one in which it began is here
or given up, because it is not known which messages those packets carried. A sender that gets reports repairs a missing
packet, or says that it does not any more. Only then it is given up, or when the sender is gone, or when the messages
that wait fill the memory. From a sender without reports a missing packet is also given up ``hold_s`` after it was
missed, or at once if hardly any missing packet comes back. Messages of other topics are delivered as they arrive, but
never after a later message of the same topic.

Invariants: no message is delivered twice, or after a later message of its topic; every message of which a part arrived
ends in one Delivered or Lost; memory is bounded.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from zlib import crc32

from gr_ros2.core.errors import CodecError, WireError
from gr_ros2.link.events import Announced, Delivered, Lost
from gr_ros2.link.ledger_rows import ROWS, LedgerRow
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.stats import ReceiverStats
from gr_ros2.link.v1.decoder import MOST_EQUATIONS, RepairDecoder
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.key import Key
from gr_ros2.link.v1.reassembly import Partial, Reassembly
from gr_ros2.link.v1.repair import MAP, PROMPT, SPAN
from gr_ros2.settings.fields import AUTO
from gr_ros2.wire.control import REPORT_LEN, Control, Report, reportable
from gr_ros2.wire.table import Row as TableRow
from gr_ros2.wire.table import read_table
from gr_ros2.wire.v1 import TABLE_TOPIC, Entry, Part, read_body

Events = list[Delivered | Lost | Announced]

_PACKET_COST, _EQUATION_COST = 250, 350
"""Bytes beside the body that a packet held and an equation take (``sys.getsizeof`` and their share of dictionaries and
of the list of gaps)."""
_VOID = 1024
"""Packets noted as left out of repairs before the notes about old ones are dropped."""
_INCOMPLETE_S = 60.0
"""s that an incomplete message waits for its next fragment."""
_REPORT_EVERY = 5
"""Packets received from one report to the next; more while none is lost."""
_SMOOTHING = 1 / 32
_HOPE = 1 / 16
_REPORT_S, _CALM_S = 0.1, 0.5
"""s after which a report is due, even about a single packet: at first and after a loss, and at most."""
_CALM = 1 / 128
"""Share of lost packets up to which reports become rarer: a report costs both ends as much as a message."""
_SLOWER = 1.1
"""By how much the time between two reports grows then. The sender expects reports at their recent interval, so that it
must not grow faster."""
_SNR_ERROR = 1.3
"""Mean square of the error of an SNR that one preamble gives, dB^2, with a margin."""
_LEAST_SHARE, _MOST_SHARE = 0.2, 0.8
"""Limits of the share of a new packet in the reported SNR. The more the SNRs of packets differ from the reported one,
the greater is the share (a Kalman filter whose channel noise is estimated)."""
_SQUARE_SMOOTHING = 0.125
_SNR_CHANGE_DB = 1.5
"""Change of the SNR that is reported at once."""
MAX_AGE_S = 15.0
"""Default of ``max_age_s``. How long ago a packet was sealed is known to the time from one hello to the echo of the
next: 2.7 s at most without loss, 7.6 s at 20 % and 14.7 s at 40 % of packets lost (in four minutes each)."""
_WAITING = 256
"""Number of messages of unknown topics, or coded in an unknown way, that are kept until the table arrives."""


@dataclass(slots=True)
class _Ready:
    """A complete message that waits for its turn."""

    topic_id: int
    order: tuple[int, int]
    payload: bytes
    qos: int
    coded: bool
    repaired: bool


class Inbox:
    """What arrives from one start of one robot.

    :param first: number of the first packet that may be needed
    :param room: bytes of its longest body
    :param rows: its topics, where they are known beforehand
    :param decoder_for: makes the decoder for its messages from its table of topics
    :param stats: receiver statistics, shared with other inboxes
    :param control: called with entries that are not messages
    """

    def __init__(
        self,
        src_id: int,
        boot: int,
        first: int,
        room: int,
        settings: Settings,
        *,
        rows: tuple[TableRow, ...],
        decoder_for: Callable[[tuple[TableRow, ...]], MessageCodec] | None,
        marks: dict[int, tuple[int, ...]],
        stats: ReceiverStats,
        control: Callable[[Control], None],
    ) -> None:
        self.src_id, self.boot = src_id, boot
        self.counts: Counter[str] = Counter()
        """Packets by result: ``packets``, ``duplicate``, ``late``, ``missing``, ``repaired``."""
        self.rows: dict[int, TableRow] = {}
        self.digest = 0
        """CRC-32 of the table of topics that is known."""
        self.loss = 0.0
        """Recent share of lost packets."""
        self.snr_db: float | None = None
        """SNR of the newest packets, dB; None where it is not measured."""
        self._square = _SNR_ERROR
        """Mean square of the differences of new SNRs from the reported one, dB^2."""
        self._reported_db: float | None = None
        self._settings = settings
        self._room = room
        self._control = control
        self._stats = stats
        self._decoder_for = decoder_for
        self._codec: MessageCodec | None = None
        memory = settings.max_source_bytes // 2  # for packets, and as much for messages
        equations = max(min(MOST_EQUATIONS, memory // 4 // (room + _EQUATION_COST)), MAP)
        rest = memory - equations * (room + _EQUATION_COST)
        span = max(min(SPAN, rest // (room + _PACKET_COST)), MAP)
        self.decoder = RepairDecoder(room, self._plausible, span, equations)
        self.decoder.begin(first)
        self.decoder.newest = first - 1
        self._first = self._low = self._wanted = first
        """Packets before this number are neither waited for nor needed."""
        self._dead = first
        """The sender does not repair packets before this number any more."""
        self._void: set[int] = set()
        """Packets that their sender has left out of a repair."""
        self._most_void = _VOID
        self._gaps: deque[tuple[float, int, int]] = deque()
        """Packets that are missing: since when (s), the first and the last of them."""
        self.told = False
        """Whether the sender gets reports. It then says which packets it does not repair any more."""
        self._hope = 1.0
        """Share of missing packets that are recovered in time."""
        self._reassembly = Reassembly(memory // 2)
        self._kept_back = 0
        """Bytes of the complete messages that wait for an earlier one."""
        self._ready: dict[int, list[_Ready]] = {}
        """Messages waiting for their turn, by topic."""
        self._unknown: deque[_Ready] = deque()
        self._waiting = 0
        """Bytes of the messages that wait for their turn."""
        self._last: dict[int, tuple[int, int]] = {}
        """The newest message that was delivered, by topic."""
        self.marks = marks
        """CRC-32 of the newest messages of each latched topic, in the form in which they were transmitted: as many as
        its depth."""
        self._events: Events = []
        self._now = 0.0
        self.unreported = 0
        """Packets since the last report."""
        self._missed = False
        """Whether a packet went missing since the last report."""
        self._reported_at = 0.0
        self._pause = _REPORT_S
        """s after which the next report is due."""
        self._old_turn = False
        self.sealed_after: Callable[[int], float] | None = None
        """Tells the time in s after which a packet was sealed; None where this cannot be proven."""
        if rows:
            self._know(rows)

    @property
    def newest(self) -> int:
        """The newest packet number seen."""
        return self.decoder.newest

    def source(self, number: int, body: bytes, entries: Sequence[Entry], qos: int, now: float) -> Events:
        """Take a source packet.

        :param body: as it stood in the packet, padding included
        :param entries: the entries of the packet
        """
        if number in self.decoder:
            self.counts["duplicate"] += 1
            self._stats.dropped["duplicate"] += 1
            return []
        if number < self.decoder.floor:
            self.counts["late"] += 1
            return []
        self.unreported += 1
        self._now = now
        self.counts["packets"] += 1
        late = number < self.decoder.newest
        self._stats.packet_loss_est -= late
        self._advance(number, now, here=True)
        if not late:
            self.loss -= self.loss * _SMOOTHING
        for found in self.decoder.source(number, body[: self._room]):
            if found[0] == number:
                self._take(number, entries, qos, repaired=late)
            else:
                self._recovered(found)
        self._settle()
        return self._given()

    def lacks_packet(self, number: int) -> bool:
        """Whether a source packet is neither here nor too old."""
        return number not in self.decoder and number >= self.decoder.floor

    def repair(
        self, number: int, mask: int, row: int, combined: bytes, *, oldest: bool, now: float, new: bool = True
    ) -> Events:
        """Take a repair; only one that was not here before calls for a report."""
        self.unreported += new
        self._advance(number, now, here=False)
        window = mask.bit_length()
        if oldest and number - window + 1 > self._dead:
            self._dead = number - window + 1
        for found in self.decoder.repair(number, mask, row, combined):
            self._recovered(found)
        if mask + 1 != 1 << window:
            for back in range(window):
                if not mask >> back & 1 and number - back not in self.decoder and number - back >= self._wanted:
                    self._void.add(number - back)
            if len(self._void) > self._most_void:
                self._void = {left_out for left_out in self._void if left_out >= self._wanted}
                self._most_void = 2 * len(self._void) + _VOID
        self._settle()
        return self._given()

    def heard(self, number: int, now: float, *, over: bool = False) -> Events:
        """Note the number at which a packet stands that is neither a source packet nor a repair.

        :param over: the sender repairs no packet up to that number
        """
        self._advance(number, now, here=False)
        if over:
            self._dead = max(self._dead, number + 1)
        self._settle()
        return self._given()

    def handle_timeout(self, now: float) -> Events:
        """Go on without packets that have been waited for long enough."""
        self._now = now
        self._settle()
        for partial in self._reassembly.expired(now, _INCOMPLETE_S):
            self._lose(partial, LedgerRow.EXPIRED)
        return self._given()

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do."""
        times = []
        if not self.told and self._gaps and any(self._ready.values()):
            times.append(self._gaps[0][0] + self._settings.hold_s)
        waiting = self._reassembly.next_timeout()
        if waiting is not None:
            times.append(waiting + _INCOMPLETE_S)
        return min(times) if times else None

    def close(self, reason: LedgerRow) -> Events:
        """Give up everything that is not delivered."""
        for partial in self._reassembly.clear():
            self._lose(partial, reason)
        for waiting in [ready for line in self._ready.values() for ready in line]:
            self._events.append(Lost(self.src_id, waiting.topic_id, reason, self._key(waiting.order)))
        for waiting in self._unknown:
            self._never_known(waiting)
        self._ready.clear()
        self._kept_back = 0
        self._unknown.clear()
        return self._given()

    def lacks(self, mark: tuple[int, int], now: float) -> bool:
        """Whether a latched message is not here and is not arriving either."""
        topic_id, value = mark
        return value not in self.marks.get(topic_id, ()) and not self._reassembly.growing(topic_id, now - 1.0)

    def report_due(self, now: float) -> float:
        """When the next report is due, s; infinite if there is nothing to report.

        While messages wait for an earlier one, reports go on: the last one may be lost, and with it that they wait.
        """
        if not self.unreported:
            return self._reported_at + _CALM_S if self.told and self._kept_back else inf
        half = self._settings.half_duplex
        every = _REPORT_EVERY * (4 if half else 1)
        most = min(every * self._pause / _REPORT_S, max(every, MAP // 2))
        if ((self._missed or self._snr_changed) and not half) or self.unreported >= most:
            return now
        return self._reported_at + self._pause

    @property
    def report_helps(self) -> bool:
        """Whether to send a report early, in a slot that nothing else needs, so that losses are noticed sooner."""
        return self.unreported > 0 and self.loss >= PROMPT and not self._settings.half_duplex

    def report(self, now: float) -> Report:
        """What has arrived. Reports alternate between the newest part and the oldest part with missing packets."""
        calm = not self._missed and self.loss < _CALM and self.counts["packets"] > MAP
        self._pause = min(self._pause * _SLOWER, _CALM_S) if calm else _REPORT_S
        self.unreported = 0
        self._missed = False
        self._reported_at = now
        decoder = self.decoder
        newest = decoder.newest
        base = newest
        self._old_turn = not self._old_turn
        if self._old_turn and self._wanted < newest - MAP + 1:
            base = self._wanted + MAP - 1
        arrived = 0
        for back in range(MAP):
            number = base - back
            if number in decoder or number < self._wanted:
                arrived |= 1 << back
        settled = self._wanted > base - MAP
        loss = min(round(self.loss * 128), 127)
        snr_db = self._reported_db = None if self.snr_db is None else reportable(self.snr_db)
        return Report(self.src_id, self.boot & 0xFFFF, max(base, 0) & 0xFFFF, arrived, settled, loss, snr_db)

    @property
    def report_len(self) -> int:
        """Bytes of a report."""
        return REPORT_LEN + (self.snr_db is not None)

    @property
    def _snr_changed(self) -> bool:
        """Whether the SNR differs so much from the last one reported that the sender should know."""
        if self.snr_db is None:
            return False
        return self._reported_db is None or abs(self.snr_db - self._reported_db) > _SNR_CHANGE_DB

    def measured(self, snr_db: float) -> None:
        """Note the SNR of a packet, dB."""
        if self.snr_db is None:
            self.snr_db = snr_db
        new = snr_db - self.snr_db
        self._square += _SQUARE_SMOOTHING * (new * new - self._square)
        share = min(max(1 - _SNR_ERROR / max(self._square, _SNR_ERROR), _LEAST_SHARE), _MOST_SHARE)
        self.snr_db += share * new

    @property
    def held(self) -> int:
        """Bytes of incomplete messages, bookkeeping included."""
        return self._reassembly.held

    def _given(self) -> Events:
        events, self._events = self._events, []
        return events

    def _plausible(self, body: bytes) -> bool:
        try:
            read_body(body, self._room)
        except WireError:
            return False
        return True

    def _advance(self, number: int, now: float, *, here: bool) -> None:
        """The sender has reached this number: the packets between the newest one and this one are missing for now."""
        self._now = now
        newest = self.decoder.newest
        if number <= newest:
            return
        gone = number - newest - here
        if gone:
            self.counts["missing"] += gone
            self._stats.packet_loss_est += gone
            self._missed = True
            if newest >= self._first:  # earlier ones are missing because nobody listened
                self.loss = 1 - (1 - self.loss) * (1 - _SMOOTHING) ** min(gone, 1000)
        self.decoder.advance(number)
        gaps, floor = self._gaps, self.decoder.floor
        if gone:
            gaps.append((now, newest + 1, newest + gone))
        while gaps and gaps[0][2] < floor:
            gaps.popleft()

    def _recovered(self, found: tuple[int, bytes]) -> None:
        number, body = found
        self.counts["repaired"] += 1
        self._take(number, read_body(body, self._room), -1, repaired=True)

    def _take(self, number: int, entries: Sequence[Entry], qos: int, *, repaired: bool) -> None:
        """Process the entries of a packet that is known now."""
        for place, entry in enumerate(entries):
            if not isinstance(entry, Part):
                self._control(entry)
            elif entry.last and not entry.offset:
                ready = _Ready(entry.topic_id, (number, place), entry.payload, qos, entry.coded, repaired)
                self._arrived(ready)
            else:
                self._fragment(entry, number, place, qos, repaired=repaired)

    def _fragment(self, part: Part, number: int, place: int, qos: int, *, repaired: bool) -> None:
        begin = number - part.back
        if begin < self._last.get(part.topic_id, (0, 0))[0] or begin < 0:
            self.counts["overtaken"] += 1
            return
        whole = self._reassembly.add(part, number, place, repaired=repaired, now=self._now)
        for partial in self._reassembly.overflowing():
            self._lose(partial, LedgerRow.MEMORY)
        if whole is None:
            return
        payload = whole.payload()
        if payload is None:
            self._lose(whole, LedgerRow.DAMAGED)
            return
        order = (whole.begin, whole.place)
        self._arrived(_Ready(whole.topic_id, order, payload, qos, whole.coded, whole.repaired))

    def _arrived(self, ready: _Ready) -> None:
        """A message is complete."""
        if ready.topic_id == TABLE_TOPIC:
            self._table(ready.payload)
            return
        row = self.rows.get(ready.topic_id)
        if row is None or self._awaits_table(ready):
            self._unknown.append(ready)
            self._waiting += len(ready.payload)
            while len(self._unknown) > _WAITING or self._waiting > self._settings.max_source_bytes // 4:
                lost = self._unknown.popleft()
                self._waiting -= len(lost.payload)
                self._never_known(lost)
        elif row.reliable and ready.order[0] > self._low:
            self._kept_back += len(ready.payload) + _PACKET_COST
            self._ready.setdefault(ready.topic_id, []).append(ready)
        else:
            self._deliver(ready, row)

    def _awaits_table(self, ready: _Ready) -> bool:
        """Whether a message cannot be decoded before a newer table is here."""
        return ready.coded and self._codec is not None and self._codec.lacks(ready.topic_id, ready.payload)

    def _never_known(self, ready: _Ready) -> None:
        """A message is given up for which the table did not arrive."""
        reason = LedgerRow.UNKNOWN_DICTIONARY if ready.topic_id in self.rows else LedgerRow.UNKNOWN_TOPIC
        self._events.append(Lost(self.src_id, ready.topic_id, reason, self._key(ready.order)))

    def _settle(self) -> None:
        """Find up to which packet everything is here or given up, and deliver the messages that waited for that."""
        decoder, dead, void = self.decoder, max(self._dead, self.decoder.floor), self._void
        newest, low = decoder.newest, max(self._low, min(dead, decoder.newest + 1))
        if self._kept_back > self._settings.max_source_bytes:
            low = newest + 1
        elif self._gaps and not self.told:
            low = self._give_up(low, dead)
        while low <= newest and (low in decoder or low in void):
            low += 1
        wanted = max(self._wanted, dead)
        while wanted <= newest and (wanted in decoder or wanted in void):
            wanted += 1
        self._wanted = wanted
        if low > self._low:
            self._low = low
            for topic_id, line in self._ready.items():
                if line:
                    self._release(self.rows[topic_id], line)

    def _give_up(self, low: int, dead: int) -> int:
        """The number up to which missing packets are given up; also updates the share of packets that are recovered."""
        gaps, decoder, hold_s = self._gaps, self.decoder, self._settings.hold_s
        while gaps and gaps[0][0] + hold_s <= self._now:
            _, first, last = gaps.popleft()
            for number in range(max(first, last + 1 - MAP), last + 1):  # earlier ones hardly count
                if number in decoder:
                    self._hope += (1 - self._hope) * _HOPE
                elif number >= dead and number not in self._void:
                    self._hope -= self._hope * _HOPE
            low = max(low, last + 1)
        if gaps and self._hope < 0.5:
            low = max(low, gaps[-1][2] + 1)
        return low

    def _release(self, row: TableRow, line: list[_Ready]) -> None:
        line.sort(key=lambda ready: ready.order)
        while line and line[0].order[0] <= self._low:
            ready = line.pop(0)
            self._kept_back -= len(ready.payload) + _PACKET_COST
            self._deliver(ready, row)

    def _deliver(self, ready: _Ready, row: TableRow) -> None:
        topic_id, key = ready.topic_id, self._key(ready.order)
        if self._old(ready, row):
            self._events.append(Lost(self.src_id, topic_id, LedgerRow.NOT_FRESH, key))
            return
        if ready.order <= self._last.get(topic_id, (-1, -1)):
            self._events.append(Lost(self.src_id, topic_id, _passed_over(row), key))
            return
        self._last[topic_id] = ready.order
        for partial in self._reassembly.overtaken(topic_id, ready.order[0]):
            self._lose(partial, _passed_over(row))
        payload = ready.payload
        if row.latched:
            mark, marks = crc32(payload), self.marks.get(topic_id, ())
            if mark in marks:
                self._stats.repeats += 1
                return
            self.marks[topic_id] = (*marks, mark)[-max(row.depth, 1) :]
        if ready.coded:
            try:
                if self._codec is None:
                    raise CodecError("coded, and no codec is configured here")
                payload = self._codec.decode(topic_id, payload)
            except CodecError as error:
                self._events.append(Lost(self.src_id, topic_id, ROWS[error.row], key))
                return
        qos = ready.qos if ready.qos >= 0 else row.qos
        self._events.append(Delivered(self.src_id, topic_id, payload, qos, key, ready.repaired))

    def _old(self, ready: _Ready, row: TableRow) -> bool:
        """Whether a message may be older than its topic allows, because nothing proves that it is not."""
        most = self._settings.max_age_s
        if most == AUTO:
            most = MAX_AGE_S if row.fresh else 0.0
        return most > 0 and self.sealed_after is not None and self._now - self.sealed_after(ready.order[0]) > most

    def _table(self, payload: bytes) -> None:
        try:
            rows = read_table(payload)
        except WireError:
            self.counts["bad_table"] += 1
            return
        digest = crc32(payload)
        if digest == self.digest:
            return
        self.digest = digest
        self._know(rows)
        self._events.append(Announced(self.src_id, rows))
        waiting, self._unknown, self._waiting = self._unknown, deque(), 0
        for ready in sorted(waiting, key=lambda item: item.order):
            self._arrived(ready)

    def _know(self, rows: tuple[TableRow, ...]) -> None:
        self.rows = {row.topic_id: row for row in rows}
        for topic_id in [topic_id for topic_id in self._ready if topic_id not in self.rows]:
            for ready in self._ready.pop(topic_id):
                self._kept_back -= len(ready.payload) + _PACKET_COST
                self._events.append(Lost(self.src_id, topic_id, LedgerRow.UNKNOWN_TOPIC, self._key(ready.order)))
        if self._decoder_for is not None:
            self._codec = self._decoder_for(rows)

    def _lose(self, partial: Partial, reason: LedgerRow) -> None:
        key = self._key((partial.begin, partial.place))
        self._events.append(Lost(self.src_id, partial.topic_id, reason, key))

    def _key(self, order: tuple[int, int]) -> Key:
        return Key(self.boot, *order)


def _passed_over(row: TableRow) -> LedgerRow:
    """The ledger row of a message that is not delivered because a later one of its topic was."""
    return LedgerRow.GIVEN_UP if row.reliable else LedgerRow.OVERTAKEN
