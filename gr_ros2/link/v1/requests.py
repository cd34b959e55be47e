"""What a robot requests from others: messages that they keep for robots that join late, and this one lacks;
and key frames of topics of which a frame could not be decoded."""

from __future__ import annotations

from collections.abc import Iterable
from math import inf

from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.neighbours import Neighbour
from gr_ros2.wire.control import Ask
from gr_ros2.wire.v1 import TABLE_TOPIC

ASK_LEN = 3
"""Bytes of a request for messages, without the topics."""


class Requests:
    """The requests of one robot.

    :ivar crowded: whether some of the requests found no room when it last looked
    :ivar check_at: when it looks next, s; infinite for never
    """

    def __init__(self, neighbours: Iterable[Neighbour], settings: Settings) -> None:
        self.crowded = False
        self._neighbours, self._settings, self._tuning = neighbours, settings, settings.tuning
        self.check_at = -inf if settings.hears else inf
        self._wanted_at = inf
        """When messages that others keep and this robot lacks are asked for, s."""

    def told(self, now: float) -> None:
        """A robot may have named what this one lacks."""
        for neighbour in self._proven():
            self._want(neighbour, self._kept(neighbour, now), now)

    def next(self) -> float:
        """When a request may have to leave, s; infinite for never."""
        lost = (each.asked.get(topic, -inf) for each in self._proven() for topic in each.lost_frames)
        return max(self.check_at, min(self._wanted_at, min(lost, default=inf)))

    def entries(self, room: int, now: float) -> list[Ask]:
        """Requests, as many as ``room`` bytes hold."""
        found: list[Ask] = []
        if now < self.check_at:
            return found
        self.check_at = now + self._tuning.ask_check_s
        self.crowded, self._wanted_at = False, inf
        for neighbour in self._proven():
            kept, asked = self._kept(neighbour, now), neighbour.asked
            lacking = dict.fromkeys([*kept, *neighbour.lost_frames])
            wanted = bytes(topic for topic in lacking if now >= asked.get(topic, -inf))
            said = wanted[: max(room - ASK_LEN, 0)]
            if len(said) < len(wanted):
                self.crowded, self.check_at = True, now
            if said:
                room -= ASK_LEN + len(said)
                found.append(Ask(neighbour.src_id, said))
                neighbour.lost_frames.difference_update(said)
                asked.update(dict.fromkeys(said, now + self._tuning.ask_s * self._settings.slower))
            self._want(neighbour, kept, now)
        return found

    def _proven(self) -> list[Neighbour]:
        """Those who are asked."""
        return [neighbour for neighbour in self._neighbours if neighbour.proven]

    def _want(self, neighbour: Neighbour, topics: Iterable[int], now: float) -> None:
        for topic in topics:
            self._wanted_at = min(self._wanted_at, neighbour.asked.get(topic, now))

    def _kept(self, neighbour: Neighbour, now: float) -> list[int]:
        """Topics of which a robot keeps a message that this one lacks."""
        hello, inbox = neighbour.hello, neighbour.inbox
        marks = list(hello.marks)
        if hello.digest and hello.digest != inbox.announced.digest:
            marks.append((TABLE_TOPIC, hello.digest))
        return [mark[0] for mark in marks if inbox.lacks(mark, neighbour.hello_number, now)]
