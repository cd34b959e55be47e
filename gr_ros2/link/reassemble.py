"""Fragments of one source and topic back to messages, and never to a message made of two.

The 8-bit entry id comes round after 256 messages, a restarted sender starts anywhere, and a sender of random ids (the
paper's) repeats itself soon. What protects a message, besides its id:

- *Contradiction*: another ``total``, other flags, or the same index with other bytes begins a new message.
- *Overtaking*: 64 newer ids seen, or 64 that would have passed unseen at the topic's recent rate, end a message.
- *Order*: a sender sends a topic's messages one after the other, each in index order. Once packets have been missed,
  an entry whose place among the topic's recent ones does not agree with its packet's sequence number is of another
  time: held messages end and it begins a new one. While no packet has been missed this is not asked, so messages of
  a topic may interleave on a clean link.
- *Rules broken*: between two entries with no packet missed, an orderly sender goes on with a message or begins one at
  index 0, and uses no id for two messages. Of a sender that does otherwise nothing is held across a missed packet, and
  a message takes its next fragment only. So messages of a topic may still interleave on a clean link; fragments in
  another order, and two messages under one id, are refused.
- *Reset* (see ``sequence``): a restart or outage seen in the packet numbers ends everything held of the source.

Invariants: each message that began ends exactly once, in a Delivered or a Lost; completed ids are not remembered.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from gr_ros2.link.partials import Partial, Partials
from gr_ros2.link.sequence import Pace
from gr_ros2.wire import unwrap
from gr_ros2.wire.v0 import V0, Entry

OVERTAKEN = 64
_PATIENT = 192
"""Ids that must have passed unseen where the packet numbers show no loss: a sender that paused, most likely."""
_STALL_S = 0.5
"""s that a sender or receiver may hang between packets, however fast it is: at 30,000 packets/s 192 ids take 0.1 s."""
_HISTORY = 128
_RESTART_JUMP = 4096
_NOWHERE = (-1, -1)


@dataclass(slots=True)
class Context:
    """What the packet of an entry says about it.

    :param position: unwrapped sequence number
    :param epoch: counts the breaks in the order of this source's packets: at a gap, before and after a late one, at a
        reset. Between two packets of one epoch none was missed
    :param steady: the packet directly follows the one before
    :param flags: C and E bits, the same for all fragments of a message
    """

    position: int
    epoch: int
    steady: bool
    flags: int
    now: float


class TopicReassembler:
    """Decides which entries of one source and topic are of one message.

    :param partials: holds the incomplete ones
    """

    def __init__(self, src_id: int, topic_id: int, partials: Partials) -> None:
        self.missed_ids = 0
        self._src_id, self._topic_id = src_id, topic_id
        self._partials = partials
        self._mine = partials.of(src_id, topic_id)
        self._newest: int | None = None
        self._history: deque[tuple[int, int, int, int]] = deque(maxlen=_HISTORY)
        """(packet position, message number, index, epoch) of the last entries."""
        self._latest = self._settled = _NOWHERE
        """The furthest (message number, index) seen at all, and before the last packet that was missed."""
        self._orderly = True
        """Whether the sender has kept to the rules since the last reset."""
        self._epoch = 0
        self._top = -1
        """The furthest packet position that had an entry of this topic."""
        self._pace = Pace(window=16, least=8)

    def accept(self, entry: Entry, context: Context) -> tuple[bytes | None, list[Partial]]:
        """Take one entry.

        :returns: the message it completed, if any, and the incomplete messages it ended
        """
        ended: list[Partial] = []
        number = self._number(entry.entry_id)
        clean = bool(self._history) and self._history[-1][3] == context.epoch
        if entry.index and clean and self._orderly:
            _, last, last_index, _ = self._history[-1]
            self._orderly = number == last and last_index <= entry.index <= last_index + 1
        if self._mine and not (clean or self._orderly):
            ended += self.clear()
        if self._out_of_order(number, entry.index, context):
            ended += self.clear()
            self._history.clear()
            number += _RESTART_JUMP
            self._latest = self._settled = _NOWHERE
        self._advance(number, entry.entry_id, entry.index, context.now)
        self._history.append((context.position, number, entry.index, context.epoch))
        self._latest = max(self._latest, (number, entry.index))
        self._top = max(self._top, context.position)
        doubtful = False
        if self._mine:
            ended += self._overtaken(context)
            held = self._mine.get(entry.entry_id)
            if held is not None:
                contradicts = held.contradicts(entry, context.flags)
                self._orderly &= not (contradicts and clean)
                if contradicts or not (self._orderly or held.goes_on_with(entry)):
                    ended.append(self._partials.take(held))
                    doubtful = not self._orderly
        if entry.total == 1:
            return entry.payload, ended
        partial = self._mine.get(entry.entry_id)
        if partial is None:
            partial = Partial(
                self._src_id, self._topic_id, entry.entry_id, number, entry.total, context.flags, doubtful
            )
        return self._partials.add(partial, entry, context.now), ended

    def clear(self) -> list[Partial]:
        """End everything held."""
        return [self._partials.take(partial) for partial in list(self._mine.values())]

    def reset(self) -> list[Partial]:
        """End everything held and forget ids, order and pace: what follows is of another time."""
        self._newest = None
        self._latest = self._settled = _NOWHERE
        self._history.clear()
        self._orderly = True
        self._pace = Pace(window=16, least=8)
        return self.clear()

    def _number(self, entry_id: int) -> int:
        """An entry id unwrapped: less than 64 behind the newest it is an older message, otherwise a newer one."""
        if self._newest is None:
            return entry_id
        return unwrap(entry_id, self._newest - OVERTAKEN + 1, V0.id_bits)  # further back a message is overtaken

    def _out_of_order(self, number: int, index: int, context: Context) -> bool:
        """Whether an entry's place in its topic disagrees with its packet's, other than on a link without loss."""
        if context.epoch != self._epoch:
            self._epoch = context.epoch
            self._settled = max(self._settled, self._latest)
        if context.position > self._top:
            return (number, index) < self._settled
        for position, other, other_index, epoch in self._history:
            if epoch != context.epoch and position != context.position:
                ahead = number - other or index - other_index
                if (ahead < 0) == (position < context.position) and ahead:
                    return True
        return False

    def _advance(self, number: int, entry_id: int, index: int, now: float) -> None:
        """Follow the newest message, and count those never seen."""
        if self._newest is None or number - self._newest >= _RESTART_JUMP // 2:
            self._newest = number
            self._pace.observe(now, 1)
        elif number > self._newest:
            self.missed_ids += number - self._newest - 1
            self._pace.observe(now, number - self._newest)
            self._newest = number
        elif number < self._newest and index == 0 and self.missed_ids and entry_id not in self._mine:
            self.missed_ids -= 1

    def _overtaken(self, context: Context) -> Iterator[Partial]:
        newest = self._newest
        assert newest is not None
        waited = self._pace.duration(_PATIENT if context.steady else OVERTAKEN)
        patience = max(waited, _STALL_S) if context.steady else waited
        for partial in list(self._mine.values()):
            if newest - partial.number >= OVERTAKEN or context.now - partial.last > patience:
                yield self._partials.take(partial)
