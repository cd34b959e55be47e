"""Questions and answers of robots: whatever entries come, in whatever order and time, what is kept is bounded, answers
leave no more often than they may and can be written, and what an end tells of itself can be shown in words."""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from functools import partial
from typing import Any

from fuzz.loop import main, within
from gr_ros2.core.errors import WireError
from gr_ros2.link.v1.pings import ANSWER_S, KEPT, Pings
from gr_ros2.radio.findings import differences, in_words
from gr_ros2.wire.control import PING_LEN, About, Control, Ping, read_control, write_control

MOST_LINES = 400
"""Lines of Python for an entry heard, the packet after it, and the words about it; a fifth of them are needed."""
_OWN, _ROOM = 1, 60
_TOLD: Mapping[str, Any] = {"packet_len": 220, "phy": 7, "key": 9, "text": "1.0 psk 1e+06"}
_HEAD = 2
"""Bytes before each entry: who sends it, and how much later than the one before, 10 ms."""


class _Robot:
    """A robot that asks everybody whom it hears."""

    def __init__(self) -> None:
        self.pings = Pings()
        self.pings.introduce(**_TOLD)
        self.pings.wall_s = 1.7e9
        self.answered_at = -ANSWER_S

    def hear(self, src_id: int, entry: Control | None, now: float) -> None:
        pings = self.pings
        if isinstance(entry, Ping | About):
            pings.receive(src_id, _OWN, entry, now)
        peer = pings.put(src_id, now) | {"snr_here_db": None}
        assert in_words(peer)
        if peer["about"] is not None:
            differences(_TOLD, peer["about"])
        sent = pings.entries(_ROOM, {src_id: 12.0}, now) if pings.due <= now else []
        if sent and isinstance(sent[0], Ping) and sent[0].reply:
            assert now >= self.answered_at + ANSWER_S
            self.answered_at = now
        written = [write_control(one) for one in sent]
        assert sum(map(len, written)) <= _ROOM
        assert all(read_control(data, 0, len(data))[0] == len(data) for data in written)


def pings(data: bytes) -> None:
    """Take the bytes as entries heard, and answer in between."""
    robot, now, at = _Robot(), 0.0, 0
    while at + _HEAD + 2 <= len(data):
        src_id, later = data[at] % 255, data[at + 1]  # nobody can ask for robot 255
        now += later / 100
        try:
            at, entry = read_control(data, at + _HEAD, len(data))
        except WireError:
            break
        within(MOST_LINES, partial(robot.hear, src_id, entry, now))
    for trips in robot.pings.asked.values():
        assert trips.answered <= trips.asked
        assert len(trips.round_trips) <= KEPT
    json.dumps([trips.summary(now) for trips in robot.pings.asked.values()], allow_nan=False)


def corpus() -> list[bytes]:
    """Conversations with one robot and with many, and next to nothing."""
    rng = random.Random(5)
    one, many = b"", b""
    for n in range(1, 40):
        answer = Ping(_OWN, n, True, False, n, rng.randrange(1 << 16), rng.choice((0, 1_700_000_000_000_000)), 3.5)
        about = About(rng.randrange(1 << 16), n, 1 << 31, rng.choice((b"", b"\xff\x1b[2J", b"2.0 ofdm")))
        for entry in (Ping(_OWN, n, wants_about=n % 2 > 0), answer, about):
            written = write_control(entry)
            one += bytes((2, rng.choice((0, 2, 11)))) + written
            many += bytes((n * 6 % 255, rng.choice((0, 1)))) + written
    return [b"", bytes(_HEAD + PING_LEN), one, many]


if __name__ == "__main__":
    main(pings, corpus())
