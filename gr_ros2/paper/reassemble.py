"""Reassembles the fragments of one source and topic into messages, and never mixes two messages.

The 8-bit entry id wraps around after 256 messages, a restarted sender starts at any id, and a sender of random ids (as
in the paper) soon repeats an id. These rules protect a message, besides its id:

- *Contradiction*: another ``total``, other flags, or the same index with other bytes begins a new message.
- *Overtaking*: a message ends when 64 newer ids were seen, or would have passed unseen at the topic's recent rate.
- *Order*: a sender sends a topic's messages one after the other, each in index order. After packets were missed, an
  entry whose order among the topic's recent entries contradicts its packet's sequence number belongs to a different
  period: held messages end, and the entry begins a new one. While no packet was missed this rule does not apply, so
  messages of a topic may interleave on a link without loss.
- *Rules broken*: between two entries with no packet missed, an orderly sender continues a message or begins one at
  index 0, and never uses one id for two messages. From a sender that breaks these rules nothing is held across a missed
  packet, and a message accepts only its next fragment. Messages of a topic may then still interleave on a link without
  loss; fragments in another order, and two messages with one id, are refused.
- *Reset* (see ``sequence``): a restart or outage seen in the packet numbers ends everything held of the source.

Invariants: each message that began ends exactly once, in a Delivered or a Lost; completed ids are not remembered.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from gr_ros2.paper.partials import Partial, Partials
from gr_ros2.paper.sequence import CountRate
from gr_ros2.wire import unwrap
from gr_ros2.wire.v0 import V0, EntryV0

OVERTAKEN = 64
_PATIENT = 192
"""Number of ids that must have passed unseen when the packet numbers show no loss; most likely the sender paused."""
_STALL_S = 0.5
"""s for which a sender or receiver may stop between packets. At 30,000 packets/s, 192 ids take only 0.1 s."""
_HISTORY = 128
_RESTART_JUMP = 4096
_NOWHERE = (-1, -1)


@dataclass(slots=True)
class Context:
    """What the packet of an entry says about the entry.

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
    """Decides which entries of one source and topic belong to one message.

    :param partials: holds the incomplete messages
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
        """The highest (message number, index) seen so far, and the highest one before the last missed packet."""
        self._orderly = True
        """Whether the sender has kept the rules since the last reset."""
        self._epoch = 0
        self._top = -1
        """The highest packet position that had an entry of this topic."""
        self._pace = CountRate(window=16, least=8)

    def accept(self, entry: EntryV0, context: Context) -> tuple[bytes | None, list[Partial]]:
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
        """End everything held and forget ids, order and rate: the following entries belong to a different period."""
        self._newest = None
        self._latest = self._settled = _NOWHERE
        self._history.clear()
        self._orderly = True
        self._pace = CountRate(window=16, least=8)
        return self.clear()

    def _number(self, entry_id: int) -> int:
        """The unwrapped entry id: less than 64 behind the newest id it is an older message, otherwise a newer one."""
        if self._newest is None:
            return entry_id
        return unwrap(entry_id, self._newest - OVERTAKEN + 1, V0.id_bits)  # further back a message is overtaken

    def _out_of_order(self, number: int, index: int, context: Context) -> bool:
        """Whether the order of an entry in its topic contradicts its packet's order; never on a link without loss."""
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
        """Follow the newest message, and count the messages never seen."""
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
