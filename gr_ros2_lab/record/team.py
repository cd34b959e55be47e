"""Robots on one channel, as all of them together saw it: what was sent and what became of it, who hears whom, and where
each believes the others to be.

Invariants: times are s of the run's clock; memory is bounded by ``SENDS``, ``POINTS`` and the number of robots squared;
any thread may call it; a packet whose airtime overlaps that of another robot's packet is marked at both.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import hypot
from pathlib import Path
from threading import Lock
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import write_text, write_whole
from gr_ros2.link.events import Accepted, Delivered, PacketId, Received, ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.observe.positions import PositionReader
from gr_ros2.observe.team import PairView, Send, TeamView

TEAM_FILE = "team.json"
SENDS, POINTS = 20_000, 4000
"""Packets, and points of a robot's way or of what a robot believes of another one, that are kept; the newest."""
RECENT_S = 5.0
"""s for which a packet says who hears whom now."""


@dataclass
class Pair:
    """What one robot has of another one.

    :param snr_db: (s, dB) of packets, about one a second
    :param belief: (s, x, y, error), m: what it believes the other's place to be, and by how much it was wrong just
        before
    :param received: s, when the other's newest packets that came were sent
    :param way: robots that sent its newest message on, the last of them, and s when it came; None before the first
    """

    snr_db: list[tuple[float, float]] = field(default_factory=list)
    belief: deque[tuple[float, float, float, float]] = field(default_factory=lambda: deque(maxlen=POINTS))
    received: deque[float] = field(default_factory=lambda: deque(maxlen=256))
    way: tuple[int, int | None, float] | None = None

    def recent(self, now: float) -> int:
        """Packets received lately."""
        return sum(at > now - RECENT_S for at in self.received)


class TeamRecord:
    """Collects what all robots on one channel sent, heard and believed.

    :param robots: their source ids
    :param airtime: s of a packet by its bytes and MCS
    :param positions: what reads a place from a topic's messages, by source id and topic id
    """

    def __init__(
        self,
        robots: Sequence[int],
        airtime: Callable[[int, int], float],
        positions: Mapping[tuple[int, int], PositionReader],
    ) -> None:
        self.robots = tuple(robots)
        self._airtime, self._positions = airtime, positions
        self._lock = Lock()
        self._sends: deque[Send] = deque(maxlen=SENDS)
        self._under_way: dict[PacketId, Send] = {}
        self._ways: dict[int, deque[tuple[float, float, float]]] = {one: deque(maxlen=POINTS) for one in self.robots}
        self._pairs = {(one, other): Pair() for one in self.robots for other in self.robots if one != other}
        self._now = 0.0

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        if isinstance(event, SentPacket):
            with self._lock:
                self._sent(src_id, event)
        elif isinstance(event, Accepted) and (read := self._positions.get((src_id, event.topic_id))) is not None:
            point = read(event.payload)
            if point is not None:
                with self._lock:
                    self._ways[src_id].append((event.now, *point))

    def receiver_event(self, robot: int, event: ReceiverEvent, now: float) -> None:
        with self._lock:
            self._now = max(self._now, now)
            if isinstance(event, Received):
                send = self._under_way.get(event.identity)
                pair = self._pairs.get((robot, event.src_id))
                if send is None or pair is None:
                    return
                send.heard += 1
                pair.received.append(send.t)
                if event.snr_db is not None and (not pair.snr_db or send.t >= pair.snr_db[-1][0] + 1.0):
                    pair.snr_db.append((send.t, event.snr_db))
                    del pair.snr_db[:-POINTS]
            elif isinstance(event, Delivered):
                read = self._positions.get((event.src_id, event.topic_id))
                pair = self._pairs.get((robot, event.src_id))
                if pair is not None:
                    pair.way = event.hops, event.over, now
                point = None if read is None else read(event.payload)
                if point is None or pair is None:
                    return
                way = self._ways[event.src_id]
                off = hypot(way[-1][1] - pair.belief[-1][1], way[-1][2] - pair.belief[-1][2]) if pair.belief else 0.0
                pair.belief.append((now, *point, off))

    def view(self) -> TeamView:
        """The team now."""
        with self._lock:
            now = self._now
            sends = [send for send in self._sends if send.t > now - RECENT_S]
            sent = {robot: sum(send.robot == robot for send in sends) for robot in self.robots}
            return TeamView(
                now,
                self.robots,
                tuple(sends),
                {
                    (one, other): PairView(
                        min(pair.recent(now) / sent[other], 1.0) if sent[other] else None,
                        pair.snr_db[-1][1] if pair.snr_db and pair.recent(now) else None,
                        *(pair.way[:2] if pair.way is not None and pair.way[2] > now - RECENT_S else ()),
                    )
                    for (one, other), pair in self._pairs.items()
                },
                {robot: way[-1][1:] for robot, way in self._ways.items() if way},
                {key: pair.belief[-1][1:3] for key, pair in self._pairs.items() if pair.belief},
            )

    def write(self, folder: Path) -> None:
        """Write all of it as ``team.json``, for :func:`read_team`."""
        with self._lock:
            values = {
                "robots": self.robots,
                "sends": [[*asdict(send).values()] for send in self._sends],
                "ways": {str(robot): list(way) for robot, way in self._ways.items()},
                "pairs": [
                    {"robot": one, "of": other, "snr_db": pair.snr_db, "belief": list(pair.belief)}
                    for (one, other), pair in self._pairs.items()
                ],
            }
        write_whole(folder / TEAM_FILE, json.dumps(values), write_text)

    def _sent(self, src_id: int, event: SentPacket) -> None:
        begin = event.now if event.leave_at is None else event.leave_at
        send = Send(begin, src_id, self._airtime(len(event.data), event.mcs), event.kind)
        self._now = max(self._now, event.now)
        for other in reversed(self._sends):
            if other.t < begin - 4 * send.airtime_s:
                break
            apart = other.robot == src_id or other.t >= begin + send.airtime_s or begin >= other.t + other.airtime_s
            if not apart:
                other.overlapped = send.overlapped = True
        self._sends.append(send)
        self._under_way[event.identity] = send
        if len(self._under_way) > 2 * POINTS:
            for identity in list(self._under_way)[:POINTS]:
                del self._under_way[identity]


@dataclass(frozen=True)
class Team:
    """What :meth:`TeamRecord.write` wrote.

    :param ways: (s, x, y) of each robot, m
    :param snr_db: (s, dB) by receiver and sender
    :param beliefs: (s, x, y, error) by robot and the one that it believes to be there, m
    """

    robots: tuple[int, ...]
    sends: tuple[Send, ...]
    ways: Mapping[int, Sequence[Sequence[float]]]
    snr_db: Mapping[tuple[int, int], Sequence[Sequence[float]]]
    beliefs: Mapping[tuple[int, int], Sequence[Sequence[float]]]


def read_team(folder: Path) -> Team | None:
    """The team of a run, None where it has none.

    :raises ConfigError: for a file that is damaged
    """
    path = folder / TEAM_FILE
    if not path.is_file():
        return None
    try:
        values: dict[str, Any] = json.loads(path.read_text("utf-8"))
        pairs = {(pair["robot"], pair["of"]): pair for pair in values["pairs"]}
        return Team(
            tuple(values["robots"]),
            tuple(Send(*send) for send in values["sends"]),
            {int(robot): way for robot, way in values["ways"].items()},
            {key: pair["snr_db"] for key, pair in pairs.items()},
            {key: pair["belief"] for key, pair in pairs.items()},
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: is damaged ({error}); run the scenario again") from error
