"""The messages of reliable topics, all of which go to the robots that lack them and do not hear who made them.

Every message is kept with the one of its topic before it. Each robot tells up to which message of a topic it has all;
it is sent the next ones, the oldest first. One that was sent, by this robot or by another one that it hears, is sent
again when the robot has told since that it still lacks it: at first after ``relay_again_s``, then after twice as long
with each time, and not while packets with a part of it are being repaired for that robot. Of a topic that is kept for
late robots, one that has told nothing yet but knows the table gets the newest.

Invariants: sans-IO, the caller passes in times; what is kept is bounded, and of the neighbours that brought it, the one
with most of it loses first; work for a choice is bounded by ``relay_window``, the robots that are heard and the topics.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple

from gr_ros2.core.tuning import Tuning
from gr_ros2.relay.gain import EXPIRES_S, Gains, Stream
from gr_ros2.relay.quotas import Quotas
from gr_ros2.wire.control import Newest
from gr_ros2.wire.relayed import Relayed

COST = 2300
"""Bytes that a message takes beside its payload, one alone in its topic, sent to eight robots (measured with
``tracemalloc``)."""
Order = tuple[int, int]
"""Number of the packet in which a message began, and its place there."""


class Name(NamedTuple):
    """A message."""

    stream: Stream
    order: Order


def _never(_robot: int, _now: float) -> bool:
    return False


@dataclass(slots=True)
class Kept:
    """A message that is kept.

    :param message: as it came; ``after`` tells what comes before it
    :param made: when it was made, s
    :param until: when it is of no more use, s
    :ivar sent: by robot: when it was last sent to it, or last seen to be under way, s, and how often it was sent
    :ivar repaired: whether a part of what was sent last is being repaired for a robot, at a time in s
    """

    message: Relayed
    made: float
    until: float
    sent: dict[int, tuple[float, int]] = field(default_factory=dict)
    repaired: Callable[[int, float], bool] = _never


@dataclass(slots=True)
class _Row:
    """The messages of one topic.

    :param late: how many of them robots get that have told nothing
    """

    late: int = 0
    orders: list[Order] = field(default_factory=list)
    """Ascending."""
    newest: Order = (-1, 0)
    """Of the message that came last; it may be kept no more."""
    kept: list[Kept] = field(default_factory=list)
    has: dict[int, Order] = field(default_factory=dict)
    told: dict[int, float] = field(default_factory=dict)
    """When each robot told last what it has, s."""
    beyond: dict[int, tuple[Order, float]] = field(default_factory=dict)
    """By robot: what it has told that has not come here, and since when, s."""
    kept_for: dict[int, Order] = field(default_factory=dict)
    """What robots get that came late, up to this message, one by one: they take none that was made before another."""
    served: float = -inf
    """When one of the messages was sent last, s."""


class InOrder:
    """The messages of reliable topics that are kept for robots that do not hear who made them.

    :param gains: knows who hears whom
    :param quotas: where the messages are kept
    """

    def __init__(self, gains: Gains, quotas: Quotas[Name], tuning: Tuning = Tuning()) -> None:
        self._tuning = tuning
        self._gains, self._quotas = gains, quotas
        self._rows: dict[Stream, _Row] = {}
        self._named: dict[tuple[int, int, int], _Row] = {}
        """The same by what an entry ``Newest`` names."""

    def __getitem__(self, name: Name) -> Kept:
        row = self._rows[name.stream]
        return row.kept[row.orders.index(name.order)]

    def __contains__(self, name: Name) -> bool:
        row = self._rows.get(name.stream)
        return row is not None and name.order in row.orders

    def keep(self, kept: Kept, via: int, late: int) -> int:
        """Keep a message that is the newest of its topic here; returns how many are lost for it.

        :param via: the robot whose packet brought it
        :param late: how many messages of its topic robots get that have told nothing
        """
        message = kept.message
        stream, order = Stream(message.origin, message.start, message.topic_id), (message.number, message.place)
        row = self._rows.get(stream)
        if row is not None:
            self._drop(stream, row.orders[bisect_left(row.orders, order) :])
        else:
            row = self._rows[stream] = self._named[stream.origin, stream.start & 0xFF, stream.topic_id] = _Row()
        row.late, row.newest = late, order
        row.orders.append(order)
        row.kept.append(kept)
        lost = self._quotas.put(Name(stream, order), via, len(message.payload))
        for name in lost:
            self._remove(name)
        return len(lost)

    def drop(self, stream: Stream, which: Callable[[Order], bool] = lambda _: True) -> None:
        """Keep these messages of a topic no longer."""
        row = self._rows.get(stream)
        if row is not None:
            self._drop(stream, [order for order in row.orders if which(order)])

    def _drop(self, stream: Stream, orders: Iterable[Order]) -> None:
        for order in orders:
            self._quotas.drop(Name(stream, order))
            self._remove(Name(stream, order))

    def drop_of(self, origin: int, which: Callable[[Stream], bool]) -> None:
        """Keep these topics of a robot no longer."""
        for stream in [stream for stream in self._rows if stream.origin == origin and which(stream)]:
            self.drop(stream)
            del self._rows[stream], self._named[stream.origin, stream.start & 0xFF, stream.topic_id]

    # ---- what others have

    def told(self, robot: int, newest: Newest, now: float) -> None:
        """A robot tells up to which message of a topic it has all."""
        row = self._named.get((newest.origin, newest.start, newest.topic_id))
        if row is not None and newest.place is not None:
            before = row.has.get(robot, (-1, 0))
            row.has[robot], row.told[robot] = self._believed(row, robot, (newest.number, newest.place), now), now
            for kept in row.kept[bisect_right(row.orders, before) : bisect_right(row.orders, row.has[robot])]:
                kept.sent.pop(robot, None)

    @staticmethod
    def _believed(row: _Row, robot: int, order: Order, now: float) -> Order:
        """Up to where a robot that tells an order has all. What has not come here for ``EXPIRES_S`` may be false: who
        was told it takes true messages again by then, and is sent what comes here from then on."""
        if order <= row.newest:
            row.beyond.pop(robot, None)
            return order
        first, since = row.beyond.get(robot, (order, now))
        if first <= row.newest:
            first, since = order, now
        row.beyond[robot] = first, since
        return order if now <= since + EXPIRES_S else min(row.has.get(robot, row.newest), row.newest)

    def heard(self, via: int, name: Name, now: float) -> None:
        """A robot has sent a message on: those that it hears should have it, too."""
        row = self._rows.get(name.stream)
        place = 0 if row is None else bisect_left(row.orders, name.order)
        if row is not None and row.orders[place : place + 1] == [name.order]:
            kept = row.kept[place]
            for robot in self._gains.robots.heard_by(via):
                kept.sent[robot] = now, kept.sent.get(robot, (0.0, 0))[1]

    def started(self, robot: int) -> None:
        """A robot has started again: it has nothing of what it had."""
        for row in self._rows.values():
            row.has.pop(robot, None)
            row.told.pop(robot, None)
            row.beyond.pop(robot, None)
            for kept in row.kept:
                kept.sent.pop(robot, None)

    # ---- what is sent

    def best(self, now: float) -> tuple[Name | None, float, list[float], int]:
        """The message that is worth most for its bytes, its gain in s, the gains of all topics, and how many messages
        are dropped because they are of no more use."""
        best: Name | None = None
        most = worth = 0.0
        gains: list[float] = []
        late: list[Name] = []
        apart: dict[int, list[int]] = {}
        for stream, row in self._rows.items():
            if not row.orders:
                continue
            if stream.origin not in apart:
                apart[stream.origin] = self._gains.robots.apart(stream.origin, now)
            wanted: dict[Order, int] = {}
            for robot in apart[stream.origin]:
                for order, kept in self._next(stream, row, robot, now):
                    if now > kept.until:
                        late.append(Name(stream, order))
                    else:
                        wanted[order] = wanted.get(order, 0) + 1
                        break
            if wanted:
                order = min(wanted)
                kept = row.kept[bisect_left(row.orders, order)]
                gain = wanted[order] * (now - max(kept.made, row.served) + self._tuning.gain_first_period_s)
                gains.append(gain)
                if gain * gain / len(kept.message.payload or b" ") > worth:
                    best, most, worth = Name(stream, order), gain, gain * gain / len(kept.message.payload or b" ")
        for name in dict.fromkeys(late):
            self._skip(name)
        return best, most, gains, len(late)

    def sent(self, name: Name, now: float, repaired: Callable[[int, float], bool] = _never) -> None:
        """A message has left.

        :param repaired: see :class:`Kept`
        """
        if name in self:
            row, kept = self._rows[name.stream], self[name]
            row.served, kept.repaired = now, repaired
            for robot in self._gains.robots.apart(name.stream.origin, now):
                if row.has.get(robot, (-1, 0)) < name.order:
                    kept.sent[robot] = now, min(kept.sent.get(robot, (0.0, 0))[1] + 1, self._tuning.relay_doubled)

    # ----

    def _next(self, stream: Stream, row: _Row, robot: int, now: float) -> list[tuple[Order, Kept]]:
        """The messages that a robot lacks and that are worth sending now, and those that are of no more use."""
        has, told = row.has.get(robot), row.told.get(robot, inf)
        if has is None and not self._gains.knows(robot, stream):
            return []
        begin = len(row.orders) - row.late if has is None else bisect_right(row.orders, has)
        again = self._tuning.relay_again_s * self._gains.robots.slower()
        found = []
        if has is None and row.orders:
            row.kept_for[robot] = row.orders[-1]
        first = max(begin, 0)
        window = 1 if has is None or has < row.kept_for.get(robot, has) else self._tuning.relay_window
        for n in range(first, min(first + window, len(row.orders))):
            kept = row.kept[n]
            at, times = kept.sent.get(robot, (-inf, 0))
            due = told > at + again / 2 and now >= at + again * 2 ** max(times - 1, 0)
            if due and times and kept.repaired(robot, now):
                kept.sent[robot], due = (now, times), False
            if due or now > kept.until:
                found.append((row.orders[n], kept))
        return found

    def _skip(self, name: Name) -> None:
        """A message is of no more use to anybody: the one after it follows the one before."""
        row = self._rows[name.stream]
        n = row.orders.index(name.order)
        if n + 1 < len(row.kept) and row.kept[n + 1].message.after == name.order:
            kept = row.kept[n + 1]
            kept.message = kept.message._replace(after=row.kept[n].message.after)
            kept.sent.clear()  # who has it may wait for the one that is skipped
        self._quotas.drop(name)
        self._remove(name)

    def _remove(self, name: Name) -> None:
        row = self._rows[name.stream]
        n = row.orders.index(name.order)
        del row.orders[n], row.kept[n]
