"""Which message of which robot is worth sending next: the one that makes the neighbours' knowledge youngest.

A *stream* is one topic of one start of one robot; the messages of a stream are numbered by their origin. For each
robot that is heard, and each stream, an engine keeps the newest number that this robot is known or taken to have:

- *Evidence.* It sent the message itself, or its packet told that it has it: every packet tells the newest number of a
  few streams, in turn.
- *Belief.* A message that was sent was heard with probability ``BELIEF`` by each robot in range: by the own neighbours
  when this robot sent it, and by those neighbours that the sender names as heard when another robot sent it.

The gain of sending a stream's newest message is the sum over the neighbours of how much younger it makes them, in s.
With the sum of the squares of all gains over the largest square, how many messages are worth as much as the best one is
known. Each beyond ``gain_even`` adds 1 to the robot's *weight*, by which it shares the channel with others.

Invariants: sans-IO, the caller passes in times; the work for a message heard is bounded by the robots heard, and that
for a choice by robots times streams; equal calls give equal choices; memory is bounded by the ids and the streams that
the caller does not drop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from math import inf
from typing import NamedTuple

from gr_ros2.core.tuning import Tuning
from gr_ros2.relay.robots import OtherRobots
from gr_ros2.wire.control import Newest
from gr_ros2.wire.mac_block import MOST_WEIGHT
from gr_ros2.wire.v1 import TABLE_TOPIC

EXPIRES_S = 60.0
"""s for which a number refuses lower ones: what was made later than that after it came is newer, or the number was
false. A message may be much younger than its age says, but it was made before it came; and as much older as packets can
be held back by who has no key."""
_HALF = 1 << 15


class Stream(NamedTuple):
    """One topic of one start of a robot.

    :param start: tells the starts of one robot apart
    """

    origin: int
    start: int
    topic_id: int


class _State:
    """A stream, and who has what of it."""

    __slots__ = ("arrivals", "came", "has", "known", "newest", "period")

    def __init__(self, tuning: Tuning) -> None:
        self.newest = -1
        self.came = -inf
        self.period = tuning.gain_first_period_s
        self.arrivals: deque[tuple[int, float]] = deque(maxlen=tuning.gain_arrivals)
        self.has: dict[int, float] = {}
        """The newest number that a neighbour is taken to have."""
        self.known: set[int] = set()
        """The neighbours that had any, as they have shown."""


class Gains:
    """The gain of sending each message that this robot has, for those who hear it.

    :param src_id: of this robot
    :param robots: those that it hears
    """

    def __init__(self, src_id: int, robots: OtherRobots, tuning: Tuning = Tuning()) -> None:
        self._tuning = tuning
        self.src_id, self.robots = src_id, robots
        self._streams: dict[Stream, _State] = {}
        self._told: dict[tuple[int, int, int], _State] = {}
        """The same by what an entry ``Newest`` names."""
        self._turn = 0
        self._worth = 1.0
        self._chosen_at = 0.0

    def has(self, stream: Stream) -> int:
        """The newest number of a stream that is here; -1 for none."""
        state = self._streams.get(stream)
        return -1 if state is None else state.newest

    # ---- what is heard

    def neighbour(self, src_id: int, now: float, names: Iterable[int] = (), heard: int = 0) -> None:
        """A packet of a robot was heard; see :meth:`OtherRobots.hear`."""
        if not self.robots.hear(src_id, now, names, heard):  # it may have forgotten others since
            for state in self._streams.values():
                state.known.discard(src_id)

    def hears(self, src_id: int, now: float) -> bool:
        """Whether a robot is a neighbour and says that it hears this one."""
        return self.robots.is_near(src_id, now) and self.src_id in self.robots.all[src_id].hears

    def knows(self, src_id: int, stream: Stream) -> bool:
        """Whether a robot has shown that it knows the table of another one that has a stream."""
        table = self._streams.get(stream._replace(topic_id=TABLE_TOPIC))
        return table is not None and src_id in table.known

    def message(self, via: int, stream: Stream, number: int, now: float, made: float | None = None) -> bool:
        """A message was heard.

        :param via: the robot whose packet carried it
        :param made: when it was made, s; now by default
        :return: whether it is newer than what is here
        """
        state = self._state(stream)
        new = stream.origin != self.src_id and self._arrived(state, number, now, now if made is None else made)
        state.has[via] = max(number, state.has.get(via, number))
        state.known.add(via)
        for name in self.robots.heard_by(via):
            if name != self.src_id:
                self._count_as_heard(state, name, number, self._tuning.gain_others)
        return new

    def told(self, via: int, newest: Newest) -> None:
        """A robot tells the newest number that it has of a stream. What is not here cannot be relayed to it."""
        state = self._told.get((newest.origin, newest.start, newest.topic_id))
        if state is not None:
            ahead = (newest.number - state.newest + _HALF & 0xFFFF) - _HALF
            state.has[via] = state.newest + min(ahead, 0)  # more may be false
            state.known.add(via)

    # ---- what is sent

    def own(self, topic_id: int, start: int, number: int, now: float) -> None:
        """This robot has a new message of its own."""
        self._arrived(self._state(Stream(self.src_id, start, topic_id)), number, now, now)

    def gain(self, stream: Stream, now: float) -> float:
        """By how many s sending its newest message makes the neighbours younger, all together."""
        state = self._streams[stream]
        return self._gain(stream, state, self.robots.near(now))

    def lacks(self, stream: Stream, now: float) -> bool:
        """Whether a neighbour is likely to lack its newest message."""
        period = self._streams[stream].period
        if stream.topic_id == TABLE_TOPIC:
            period = min(period, self._tuning.gain_known_s)
        return self.gain(stream, now) >= self._tuning.gain_likely * period

    def best(
        self,
        now: float,
        cost: Callable[[Stream], float] = lambda _: 1.0,
        others: Sequence[float] = (),
        may_leave: Callable[[Stream], bool] = lambda _: True,
        room: float = inf,
    ) -> tuple[Stream | None, float]:
        """The stream whose gain squared is largest for its cost, and its gain in s; None where nothing is gained.

        :param cost: of sending a stream's newest message, above 0; infinite where it is not to be considered
        :param others: gains of other messages, which count for the weight
        :param may_leave: whether a stream's message may leave now
        :param room: how much of the cost fits a packet: a table that takes several counts as so many for the weight
        """
        neighbours = self.robots.near(now)
        best: Stream | None = None
        most = worth = found = found_worth = 0.0
        largest, total = max(others, default=0.0), sum(gain * gain for gain in others)
        for stream, state in self._streams.items():
            gain = self._gain(stream, state, neighbours)
            if not gain:
                continue
            costs = cost(stream)
            packets = max(costs / room, 1.0) if stream.topic_id == TABLE_TOPIC and costs < inf else 1.0
            total += gain * gain * packets
            by_cost = gain * gain / costs
            if by_cost > worth:
                most, worth = gain, by_cost
            if by_cost > found_worth and may_leave(stream):
                best, found, found_worth = stream, gain, by_cost
        own = len(neighbours) * (now - self._chosen_at)  # of a message made since the choice before
        self._chosen_at = now
        worth = max(total / max(most, largest, own, 1e-9) ** 2, 1.0)
        self._worth += self._tuning.gain_smoothing * (worth - self._worth)
        return best, found

    @property
    def weight(self) -> int:
        """Packets to send while others send one."""
        return min(max(int(1 + self._worth - self._tuning.gain_even), 1), MOST_WEIGHT)

    def sent(self, stream: Stream, number: int, now: float, share: float | None = None) -> None:
        """A message of a stream leaves.

        :param share: of the way to it by which the neighbours are taken to have come; None: ``gain_own``
        """
        state = self._streams[stream]
        for robot in self.robots.near(now):
            if robot != stream.origin:
                self._count_as_heard(state, robot, number, self._tuning.gain_own if share is None else share)

    @property
    def others(self) -> int:
        """Streams of other robots."""
        return sum(stream.origin != self.src_id for stream in self._streams)

    def tells(self, count: int | None = None) -> list[Newest]:
        """The newest numbers that are here of other robots' streams, in turn."""
        streams = [stream for stream in self._streams if stream.origin != self.src_id]
        count = min(self._tuning.gain_told if count is None else count, len(streams))
        turn, self._turn = self._turn, self._turn + count
        told = [streams[(turn + i) % len(streams)] for i in range(count)]
        return [Newest(s.origin, s.start & 0xFF, s.topic_id, self._streams[s].newest & 0xFFFF) for s in told]

    # ----

    def drop(self, stream: Stream) -> None:
        """Forget a stream."""
        self._streams.pop(stream, None)
        self._told.pop((stream.origin, stream.start & 0xFF, stream.topic_id), None)

    def started(self, src_id: int) -> None:
        """A robot that is heard has started again: it has nothing of what it had."""
        for state in self._streams.values():
            state.has.pop(src_id, None)
            state.known.discard(src_id)

    def changed(self, stream: Stream) -> None:
        """The message of a stream is another one than before: nobody has it."""
        if (state := self._streams.get(stream)) is not None:
            state.has.clear()
            state.known.clear()

    def _state(self, stream: Stream) -> _State:
        state = self._streams.get(stream)
        if state is None:
            state = self._streams[stream] = _State(self._tuning)
            self._told[stream.origin, stream.start & 0xFF, stream.topic_id] = state
        return state

    def _arrived(self, state: _State, number: int, now: float, made: float) -> bool:
        if number <= state.newest:
            if made <= state.came + EXPIRES_S:
                return False
            state.arrivals.clear()
            state.has.clear()
        state.newest, state.came = number, now
        arrivals = state.arrivals
        arrivals.append((number, max(made, now - self._tuning.gain_unknown_s)))
        (first, since), (_, at) = arrivals[0], arrivals[-1]
        if number > first and at > since:
            state.period = (at - since) / (number - first)
        return True

    def _count_as_heard(self, state: _State, robot: int, number: int, share: float) -> None:
        before = state.has.get(robot)
        if before is None:
            before = number - self._tuning.gain_unknown_s / state.period
        if number > before:
            state.has[robot] = before + share * (number - before)

    def _gain(self, stream: Stream, state: _State, neighbours: Iterable[int]) -> float:
        newest, origin, has = state.newest, stream.origin, state.has
        table = stream.topic_id == TABLE_TOPIC  # who hears a robot has its table from it
        if newest < 0:
            return 0.0
        behind = 0.0
        for robot in neighbours:
            if robot != origin and not (table and origin in self.robots.all[robot].hears):
                before = has.get(robot)
                if before is None or (table and before <= newest - 1 and robot not in state.known):
                    behind += self._tuning.gain_unknown_s / state.period
                elif before < newest:
                    behind += (
                        min(newest - before, self._tuning.gain_known_s / state.period) if table else newest - before
                    )
        return behind * state.period
