"""What a robot keeps to send later, when nobody heard it or a newer message had to go first; and its bytes.

Whether messages are heard is what reports say, by the numbers of packets. Where packets leave and no report of newer
ones comes for several times as long as usual, nobody seems to hear, and filling pauses. What left before a silence of
``GONE_S`` fills gaps whatever the next report says: a robot does not wait for what was sent before it came back.

Invariants: there is no clock and no IO here, the caller passes in the time; memory is bounded by bytes and by age, of
more the oldest goes and is counted; a message is kept once; none that nobody has is given up silently.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from heapq import heappop, heappush
from math import inf
from struct import Struct
from typing import NamedTuple, Protocol

from gr_ros2.core.errors import EntryBoundsError, EntryKindError

_MESSAGE, _ACCOUNT = 1, 3
_HEAD = Struct(">BBIQQBI")
_COUNT = Struct(">BBQQ")
ACCOUNT_LEN = _COUNT.size
"""Bytes of an account."""
_LATEST_US = ((1 << 63) - 1) // 1000
"""The last time that a bag can hold."""
_SERIALS = (1 << 32) - 1
_OVERHEAD = 400
"""bytes of memory counted for each message, in addition to its payload."""
PIECE = 8192
"""bytes of messages that cross as one message: similar ones compress each other."""
_PATIENCE_S, _TIMES = 1.0, 4
"""s, and mean times from a packet to its report, after which nobody seems to hear."""
_FIRST_S, _MOST_S = 0.5, 1.25
"""s from a packet to its report, until reports tell, and in their mean at most."""
GONE_S = 8.0
"""s without a report, shorter than those after which robots take each other for gone."""
UNKNOWN_PLACE, NO_PLACE = 0xFF, 0xFE
"""Place of a message in its packet, where only the packet is known in which it began; and of one that never began."""
REPAIRED = 64
"""Newer packets that a report covers, after which one that was lost is not repaired any more in time."""


class Later(NamedTuple):
    """A message that crosses later.

    :param serial: its number among all messages that its sender has submitted since it started
    :param made_us: when it was submitted, by its sender's clock, us since 1970
    :param at: see :func:`began_at`: number of the packet in which it has begun to leave before, and its place there;
        of one that never began the number of the packet that followed when it was dropped, and ``NO_PLACE``
    """

    topic_id: int
    serial: int
    made_us: int
    payload: bytes
    at: tuple[int, int]

    @property
    def began(self) -> tuple[int, int] | None:
        """``at`` of a message that has begun to leave before; None of another one."""
        return None if self.at[1] == NO_PLACE else self.at


def began_at(number: int, place: int) -> tuple[int, int]:
    """Where a message began, as :class:`Later` says it.

    :param place: -1 is unknown
    """
    return number, place & UNKNOWN_PLACE


class Account(NamedTuple):
    """How many messages of a topic have begun to leave, or were dropped before, in front of a packet, since the start
    of their sender. Who has an earlier account too and counts what came knows what is missing."""

    topic_id: int
    number: int
    count: int  # type: ignore[assignment]


def write_later(messages: Iterable[Later | Account]) -> bytes:
    """The bytes of a message that fills gaps."""
    parts = []
    for message in messages:
        if isinstance(message, Account):
            parts.append(_COUNT.pack(_ACCOUNT, *message))
        else:
            topic_id, serial, made_us, payload, (number, place) = message
            head = _HEAD.pack(_MESSAGE, topic_id, serial & _SERIALS, made_us, number, place, len(payload))
            parts += [head, payload]
    return b"".join(parts)


def read_later(data: bytes) -> list[Later | Account]:
    """The messages of these bytes.

    :raises WireError: EntryBoundsError (cut off) or EntryKindError (of another kind)
    """
    found: list[Later | Account] = []
    at = 0
    while at < len(data):
        head = {_MESSAGE: _HEAD, _ACCOUNT: _COUNT}.get(data[at])
        if head is None:
            raise EntryKindError(f"kind {data[at]} in what fills a gap")
        if at + head.size > len(data):
            raise EntryBoundsError(f"what fills a gap ends at byte {len(data)}")
        _, topic_id, *values = head.unpack_from(data, at)
        at += head.size
        if head is _COUNT:
            found.append(Account(topic_id, *values))
            continue
        serial, made_us, number, place, size = values
        if made_us > _LATEST_US:
            raise EntryBoundsError(f"a message that fills a gap and was made {made_us} us after 1970")
        if at + size > len(data):
            raise EntryBoundsError(f"a message of {size} bytes that fills a gap ends at byte {len(data)}")
        found.append(Later(topic_id, serial, made_us, data[at : at + size], (number, place)))
        at += size
    return found


class _Kept(NamedTuple):
    """A message that may have to cross later: when it was submitted, s, and see :class:`Later`. There is no ``payload``
    where memory was short; ``began`` is its ``at``, None while it has neither begun nor been dropped."""

    at: float
    topic_id: int
    serial: int
    payload: bytes | None
    began: tuple[int, int] | None = None

    @property
    def size(self) -> int:
        return 0 if self.payload is None else len(self.payload) + _OVERHEAD


class _Left(NamedTuple):
    """Messages that have left whole under one serial: when, s, and the packets that must have come."""

    at: float
    first: int
    last: int
    kept: Sequence[_Kept]

    @property
    def topic_id(self) -> int:
        return self.kept[0].topic_id


class HeardPackets(Protocol):
    """Which packets others have: see :class:`gr_ros2.link.v1.receipts.Receipts`."""

    newest: int

    def have(self, first: int, last: int) -> bool:
        """Whether somebody has each packet from one to another."""


class MessagesForLater:
    """The messages of one robot that may have to cross later.

    :param for_s: s for which one is kept
    :param most_bytes: of them all
    :param overtakes: whether messages of a topic come out that overtake earlier ones, which do not come out any more
        when they are repaired
    :ivar lost: how many were kept in vain so far
    :ivar filled: how many have filled gaps
    :ivar unheard: whether nobody seems to hear this robot
    """

    def __init__(self, for_s: float, most_bytes: int, overtakes: Callable[[int], bool] = lambda _: False) -> None:
        self._for_s, self._most, self._bytes, self._overtakes = for_s, most_bytes, 0, overtakes
        self._waiting: OrderedDict[int, Sequence[_Kept]] = OrderedDict()
        """Messages that have not left whole, by serial."""
        self._left: OrderedDict[int, _Left] = OrderedDict()
        """Those that have, the newest departure last, until it is known whether somebody hears them."""
        self._whole: OrderedDict[int, None] = OrderedDict()
        """The serials of both, as far as there was memory, the oldest first."""
        self._gaps: list[_Kept] = []
        """Heap of those that fill gaps."""
        self._taken: Sequence[_Kept] = ()
        self._filling: dict[int, int] = {}
        """How many messages are under way to fill gaps, by the serial under which they are."""
        self._missing = 0
        """Messages that have left and may have to cross later: those that a report names as lost, and that may still be
        repaired, and all while nobody seems to hear."""
        self._told = self._doubted = -1
        self._mean_s, self._since = _FIRST_S, inf
        """The mean time from a packet to its report, and since when none has come of what has left, s."""
        self._newest = -1
        """The newest packet with messages."""
        self._decided: dict[int, tuple[int, int, int]] = {}
        """By topic: the newest packet at which one of its messages began, or was dropped; how many did before it, and
        how many there."""
        self._heard: dict[int, Account] = {}
        """The accounts when the newest report came."""
        self.lost = self.filled = 0
        self.unheard = False

    def accepted(self, topic_id: int, serial: int, payload: bytes, now: float) -> None:
        """A message was submitted."""
        kept = _Kept(now, topic_id, serial, payload)
        self._waiting[serial] = (kept,)
        self._bytes += kept.size
        self._whole[serial] = None
        while self._bytes > self._most and (self._gaps or self._whole):
            self._make_room()

    def refused(self, serial: int, *, ever: bool = True) -> None:
        """It will not be sent, or not all of it.

        :param ever: whether it may be sent later
        """
        next_packet = self._newest + 1, NO_PLACE
        kept = [each if each.began else self._decide(each, next_packet) for each in self._take_back(serial)]
        if ever:
            self._gap(kept)
        else:
            for each in kept:
                self._give_up(each)

    def left(self, serial: int, began: tuple[int, int], number: int, now: float, *, last: bool) -> None:
        """A part of it leaves.

        :param began: see :class:`Later`
        :param number: of the packet
        :param last: whether it is the last part
        """
        self._newest = number
        kept = self._waiting.get(serial, ())
        if kept and kept[0].began is None:
            kept = self._waiting[serial] = [self._decide(kept[0], began)]
        if kept and last:
            del self._waiting[serial]
            # What fills gaps comes in order: it is repaired until it is there, if its last packet was for somebody.
            first = number if serial in self._filling or kept[0].began is None else kept[0].began[0]
            self._left[serial] = _Left(now, first, number, kept)
            self._since = min(self._since, now)

    def doubt(self) -> None:
        """A robot has started anew: of what is under way it may have had a part before."""
        self._doubted = max([self._doubted, *self._waiting, *self._left])

    def heard(self, receipts: HeardPackets, now: float) -> None:
        """Decide what has become of what has left, and give up what is too old."""
        newest, told, gone = receipts.newest, self._told, now - self._since > GONE_S
        before = now - self.patience_s if gone else -inf
        self._missing = 0
        lacking: dict[int, list[int]] = {}
        """By topic: messages that have not come, and do not come out any more once a later one has."""
        for serial, left in list(self._left.items()):
            if left.last > newest and left.at > before:
                break
            if serial <= self._doubted or (gone and (newest > told or left.at <= before)):
                self._fill_later(serial)
            elif receipts.have(left.first, left.last):
                for overtaken in lacking.pop(left.topic_id, ()):
                    self._fill_later(overtaken)
                self.filled += self._filling.get(serial, 0)
                self._bytes -= sum(kept.size for kept in self._take_back(serial))
            elif left.last <= newest - REPAIRED or now - left.at > GONE_S:
                self._fill_later(serial)
            else:
                self._missing += serial not in self._filling
                if serial not in self._filling and self._overtakes(left.topic_id):
                    lacking.setdefault(left.topic_id, []).append(serial)
        if newest > told:
            if self._since < inf:
                self._mean_s += (min(now - self._since, _MOST_S) - self._mean_s) / 8
            self._told, self.unheard = newest, False
            self._heard = self.accounts()
            self._since = next((left.at for left in self._left.values() if left.last > newest), inf)
        elif now - self._since > self.patience_s:
            self.unheard = True
            self._missing = sum(serial not in self._filling for serial in self._left)
        while self._gaps and self._gaps[0].at < now - self._for_s:
            self._give_up(heappop(self._gaps))

    @property
    def patience_s(self) -> float:
        """s after which nobody seems to hear."""
        return max(_PATIENCE_S, _TIMES * self._mean_s)

    @property
    def tries(self) -> bool:
        """Whether something that fills a gap waits or is under way."""
        return bool(self._filling)

    def take(self, wall_ahead: float, most: int = PIECE) -> list[Later]:
        """The oldest messages that fill gaps, so many bytes of them, or one; :meth:`taken` says under which serial they
        are submitted.

        :param wall_ahead: s by which the clock of the wall is ahead of ``now`` at present: it may have been set in the
            outage
        """
        if self.unheard and not self._gaps and self._left:
            self._fill_later(next(iter(self._left)))
        taken: list[_Kept] = []
        size = 0
        found: list[Later] = []
        while self._gaps:
            at, topic_id, serial, payload, began = self._gaps[0]
            assert began is not None
            size += _HEAD.size + len(payload or b"")
            if taken and size > most:
                break
            taken.append(heappop(self._gaps))
            found.append(Later(topic_id, serial, max(round((at + wall_ahead) * 1e6), 0), payload or b"", began))
        self._taken = taken
        return found

    def taken(self, serial: int) -> None:
        """The messages taken last were submitted, as what fills gaps."""
        if self._taken:
            self._filling[serial] = len(self._taken)
            self._waiting[serial], self._taken = self._taken, ()
            self._whole[serial] = None

    def accounts(self) -> dict[int, Account]:
        """Of each topic, how many messages there were."""
        number = self._newest + 1
        return {
            topic_id: Account(topic_id, number, before + there * (newest < number))
            for topic_id, (newest, before, there) in self._decided.items()
        }

    def accounts_heard(self) -> dict[int, Account]:
        """The same when somebody was heard to hear for the last time."""
        return self._heard

    def _decide(self, kept: _Kept, began: tuple[int, int]) -> _Kept:
        """A message begins to leave, or never will: from then on it counts."""
        newest, before, there = self._decided.get(kept.topic_id, (began[0], 0, 0))
        if began[0] > newest:
            newest, before, there = began[0], before + there, 0
        self._decided[kept.topic_id] = newest, before, there + 1
        return kept._replace(began=began)

    def __len__(self) -> int:
        return len(self._gaps) + sum(self._filling.values()) + self._missing

    def _take_back(self, serial: int) -> Sequence[_Kept]:
        """The messages of a serial, which waits or is under way no more."""
        self._filling.pop(serial, None)
        self._whole.pop(serial, None)
        waiting = self._waiting.pop(serial, ())
        if waiting or serial not in self._left:
            return waiting
        return self._left.pop(serial).kept

    def _fill_later(self, serial: int) -> None:
        """What has left fills gaps later."""
        self._gap(self._take_back(serial))

    def _gap(self, kept: Iterable[_Kept]) -> None:
        """These messages fill gaps, as far as there was memory for them."""
        for each in kept:
            if each.payload is None:
                self._give_up(each)
            else:
                heappush(self._gaps, each)

    def _make_room(self) -> None:
        """Give up the oldest message that fills a gap; where there is none, forget what the oldest one says that may
        still be heard: it is given up only if it is not."""
        if self._gaps:
            self._give_up(heappop(self._gaps))
            return
        serial, _ = self._whole.popitem(last=False)
        if serial in self._filling:
            for each in self._take_back(serial):
                self._give_up(each)
            return
        left = self._left.get(serial)
        kept = self._waiting[serial] if left is None else left.kept
        self._bytes -= sum(each.size for each in kept)
        kept = [each._replace(payload=None) for each in kept]
        if left is None:
            self._waiting[serial] = kept
        else:
            self._left[serial] = left._replace(kept=kept)

    def _give_up(self, kept: _Kept) -> None:
        self._bytes -= kept.size
        self.lost += 1
