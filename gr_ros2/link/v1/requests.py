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
ASK_S = 0.5
"""s after which a request is repeated."""
CHECK_S = 0.02
"""s between two checks of what is missing."""


class Requests:
    """The requests of one robot.

    :ivar lacking: whether they keep messages that this one lacked when it last looked
    :ivar crowded: whether some of the requests found no room then
    :ivar check_at: when it looks next, s, if a packet may leave then; infinite for never
    :ivar again_at: when a request is repeated whose answer has not come, s; infinite for never
    """

    def __init__(self, neighbours: Iterable[Neighbour], settings: Settings) -> None:
        self.lacking = self.crowded = False
        self._neighbours, self._settings = neighbours, settings
        self.check_at = -inf if settings.hears else inf
        self.again_at = inf

    def entries(self, room: int, now: float) -> list[Ask]:
        """Requests, as many as ``room`` bytes hold."""
        found: list[Ask] = []
        if now < self.check_at:
            return found
        self.check_at = now + CHECK_S
        self.lacking, self.crowded, self.again_at = False, False, inf
        for neighbour in [neighbour for neighbour in self._neighbours if neighbour.proven]:
            hello, inbox, asked = neighbour.hello, neighbour.inbox, neighbour.asked
            marks = list(hello.marks)
            if hello.digest and hello.digest != inbox.announced.digest:
                marks.append((TABLE_TOPIC, hello.digest))
            kept = [mark[0] for mark in marks if inbox.lacks(mark, neighbour.hello_number, now)]
            lacking = [*kept, *neighbour.lost_frames]
            self.lacking = self.lacking or bool(lacking)
            wanted = bytes(topic for topic in dict.fromkeys(lacking) if now >= asked.get(topic, -inf))
            said = wanted[: max(room - ASK_LEN, 0)]
            if len(said) < len(wanted):
                self.crowded, self.check_at = True, now
            if said:
                room -= ASK_LEN + len(said)
                found.append(Ask(neighbour.src_id, said))
                neighbour.lost_frames.difference_update(said)
                asked.update(dict.fromkeys(said, now + ASK_S * self._settings.slower))
            self.again_at = min([self.again_at, *(asked.get(topic, now) for topic in kept)])
        return found
