"""Observes one run and computes its results: the loss ledger, the paths and the numbers of every topic.

Invariant: it only observes; the run's own threads call it, and it delays none of them for longer than the ledger's lock
and the reading of one position; it stores only numbers in arrays for each message and packet.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from math import inf
from typing import Any

import numpy as np
import numpy.typing as npt

from gr_ros2.core.arrays import Floats
from gr_ros2.link.events import Accepted, AirKind, Delivered, Received, ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.link.fates import arrived
from gr_ros2.observe.positions import PositionReader, position_reader
from gr_ros2.observe.result import TopicResult
from gr_ros2.settings.registry import MAX_TOPICS, Registry, Topic
from gr_ros2_lab.record.ledger import Ledger, TopicLedger
from gr_ros2_lab.record.metrics import delivered_bytes, topic_result
from gr_ros2_lab.record.trace import PacketLog, Trace, Track, make_trace

GRID_POINTS = 1000
"""Points of the common grid, ends included."""


def path_error(sent: npt.ArrayLike, received: npt.ArrayLike) -> float | None:
    """Mean distance of both paths, m, after interpolation to a common arc-length grid (0..1 of each path's length).

    Time has no effect: a path that is received late or subsampled has no error as long as it follows the same line
    (the paper, section 6).

    :param sent: positions, shape (n, 2) or wider; only the first two columns count
    :param received: likewise, in the order of reception
    """
    one, other = _plane(sent), _plane(received)
    if not len(one) or not len(other):
        return None
    grid = np.linspace(0.0, 1.0, GRID_POINTS)
    return float(np.linalg.norm(_along(one, grid) - _along(other, grid), axis=1).mean())


def rms_error(
    t_sent: npt.ArrayLike,
    sent: npt.ArrayLike,
    t_received: npt.ArrayLike,
    received: npt.ArrayLike,
) -> float | None:
    """RMS distance at equal times, m. Both paths are linear between their points; only the time they share counts.

    Unlike :func:`path_error` this grows with latency: it shows how wrong the position known to the receiver is.

    :param t_sent: s, when each transmitted position was submitted
    :param t_received: s on the same clock, when each received position was delivered
    :return: None where the paths share no time
    """
    (t_one, one), (t_other, other) = _timed(t_sent, sent), _timed(t_received, received)
    if not len(one) or not len(other):
        return None
    start, end = max(t_one[0], t_other[0]), min(t_one[-1], t_other[-1])
    if start > end:
        return None
    times = np.linspace(start, end, GRID_POINTS)
    apart = _interpolate(times, t_one, one) - _interpolate(times, t_other, other)
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def _plane(path: npt.ArrayLike) -> Floats:
    positions = np.asarray(path, dtype=float)
    return positions.reshape(len(positions), -1)[:, :2] if positions.size else np.empty((0, 2))


def _timed(times: npt.ArrayLike, path: npt.ArrayLike) -> tuple[Floats, Floats]:
    t, positions = np.asarray(times, dtype=float), _plane(path)
    order = np.argsort(t, kind="stable")
    return t[order], positions[order]


def _along(path: Floats, grid: Floats) -> Floats:
    """Positions at fractions of the path's length."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    moved = np.append(True, steps > 0)  # np.interp requires an increasing arc length
    length = np.append(0.0, np.cumsum(steps))[moved]
    return _interpolate(grid * length[-1], length, path[moved])


def _interpolate(at: Floats, known: Floats, path: Floats) -> Floats:
    return np.column_stack([np.interp(at, known, path[:, 0]), np.interp(at, known, path[:, 1])])


class Recorder:
    """Joins the reports of both ends of a run.

    :param registry: names and types of the topic ids
    :param namespaces: namespace of each source id on the ROS graph, for the names of its topics
    :param topic_ids: topics of each source id to report even if nothing was sent on them, None = the whole registry
    :param on_delivery: called with every delivery, its time, and the time when the message was submitted, s on the
        run's clock; the latter is None for a repeat, and where no such message is known
    """

    def __init__(
        self,
        registry: Registry,
        namespaces: Mapping[int, str],
        topic_ids: Mapping[int, Iterable[int]] | None = None,
        on_delivery: Callable[[Delivered, float, float | None], None] | None = None,
    ) -> None:
        self.ledger = Ledger()
        self.sent: dict[tuple[int, int], Track] = defaultdict(Track)
        self.received: dict[tuple[int, int], Track] = defaultdict(Track)
        self._lengths: Counter[tuple[int, AirKind, int, int]] = Counter()
        """Number of packets sent, by their sender, what they were for, their length in bytes and their MCS."""
        self._air_from, self._air_to = inf, -inf
        self._packets = defaultdict(PacketLog, {src_id: PacketLog() for src_id in namespaces})
        self._books: list[TopicLedger] = []
        self._registry = registry
        self._namespaces = dict(namespaces)
        reported = dict.fromkeys(namespaces, range(len(registry))) if topic_ids is None else topic_ids
        self._keys = [(src_id, topic_id) for src_id, ids in reported.items() for topic_id in ids]
        self._delivered, self._delivered_bytes = 0, 0
        self._on_delivery = on_delivery
        readers = {topic.topic_id: position_reader(topic.type_name) for topic in registry}
        self._readers: dict[int, PositionReader] = {key: read for key, read in readers.items() if read is not None}

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        if isinstance(event, SentPacket):
            self._packets[src_id].sent(event)
            self._air_from, self._air_to = min(self._air_from, event.now), max(self._air_to, event.now)
            self._lengths[src_id, event.kind, len(event.data), event.mcs] += 1
        self.ledger.sender_event(src_id, event)
        if isinstance(event, Accepted):
            self._follow(self.sent, src_id, event.topic_id, event.payload, event.now)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Take an event of the receiver, at ``now`` on the sender's clock. A delivery is reported once it is
        republished."""
        if isinstance(event, Received):
            number = self.ledger.packet_received(event.identity)
            if number is not None:
                self._packets[event.src_id].received(number, now)
        submitted = self.ledger.receiver_event(event, now)
        if isinstance(event, Delivered):
            if self._on_delivery is not None:
                self._on_delivery(event, now, submitted)
            self._follow(self.received, event.src_id, event.topic_id, event.payload, now)

    def progress(self) -> tuple[int, int]:
        """Messages sent and delivered so far, over all topics."""
        return self.ledger.totals()

    def finish(self, duration_s: float, t_end: float, drained: bool = False) -> tuple[TopicResult, ...]:
        """Close the ledger and compute the numbers.

        :param duration_s: s during which messages were submitted
        :param t_end: s on the run's clock, end of submission
        :param drained: nothing is left in the PHY: packets that were sent and did not arrive are lost
        :return: one result per reported topic of each source, and one per further topic that occurred in the run
        :raises RunError: when the ledger does not add up
        """
        books = {(book.src_id, book.topic_id): book for book in self.ledger.finish(drained)}
        for key in self._keys:
            books.setdefault(key, TopicLedger(*key))
        self._books = [books[key] for key in sorted(books)]
        self._delivered = sum(arrived(book.fates) for book in self._books)
        self._delivered_bytes = sum(map(delivered_bytes, self._books))
        return tuple(self._topic_result(book, duration_s, t_end) for book in self._books)

    def airtime(self, of_packet: Callable[[int | None, int], float] | None) -> dict[str, Any]:
        """Airtimes in s: of the longest packet, of a packet sent on average, and of all packets sent per message and
        per byte delivered; of the packets of each :data:`gr_ros2.link.events.AirKind`, where there were several, and
        the same of each sender; the time from the first packet to the end of the last; and the bytes of all packets
        sent per message delivered.

        To be called after :meth:`finish`.

        :param of_packet: s that a packet of this many bytes, sent with this MCS, takes, or the longest packet for
            None; None stands for a PHY without samples
        """
        longest = total = mean = None
        sent_bytes = sum(length * count for (_, _, length, _), count in self._lengths.items())
        spent: Counter[str] = Counter()
        senders: dict[int, Counter[str]] = {}
        if of_packet is not None:
            longest = of_packet(None, 0)
            for (src_id, kind, length, mcs), count in self._lengths.items():
                seconds = of_packet(length, mcs) * count
                spent[kind] += seconds  # type: ignore[assignment]
                senders.setdefault(src_id, Counter())[kind] += seconds  # type: ignore[assignment]
            total = float(spent.total())
            mean = total / self._lengths.total() if total else longest
        return {
            "airtime_s": longest,
            "airtime_mean_s": mean,
            "airtime_per_message_s": total / self._delivered if total is not None and self._delivered else None,
            "airtime_per_byte_s": total / self._delivered_bytes
            if total is not None and self._delivered_bytes
            else None,
            **({"airtime_of_kinds_s": dict(spent)} if len(spent) > 1 else {}),
            "airtime_of_senders_s": {str(src_id): dict(senders[src_id]) for src_id in sorted(senders)},
            "air_span_s": self._air_to - self._air_from + (mean or 0) if self._lengths else 0.0,
            "bytes_per_message": sent_bytes / self._delivered if self._delivered else None,
        }

    def trace(self, t0: float, t_end: float, published_as: Mapping[str, str]) -> Trace:
        """Every message, packet and position. To be called after :meth:`finish`.

        :param t0: s on the run's clock, when submission began
        :param t_end: s on the run's clock, when it ended
        :param published_as: name of a topic at the sink by its name at the source
        """
        keys = sorted(self.sent.keys() | self.received.keys())
        tracks = {key: (self.sent.get(key, Track()), self.received.get(key, Track())) for key in keys}
        return make_trace(
            self._books,
            logs=self._packets,
            tracks=tracks,
            name_of=self._name,
            published_as=published_as,
            t0=t0,
            t_end=t_end,
        )

    def _follow(
        self, tracks: dict[tuple[int, int], Track], src_id: int, topic_id: int, payload: bytes, t: float
    ) -> None:
        read = self._readers.get(topic_id)
        if read is None:
            return
        track = tracks[src_id, topic_id]
        position = read(payload)
        if position is None:
            track.left_out += 1
            return
        track.add(t, *position)

    def _topic(self, topic_id: int) -> Topic | None:
        return self._registry[topic_id] if topic_id < len(self._registry) else None

    def _name(self, src_id: int, topic_id: int) -> str:
        topic = self._topic(topic_id)
        namespace = self._namespaces.get(src_id, f"source_{src_id}")
        if topic_id == MAX_TOPICS:  # the first id above them is that of a robot's table of topics
            return f"the topics that /{namespace.strip('/')} announces"
        return topic.on_graph(namespace) if topic is not None else f"/{namespace.strip('/')}/topic_{topic_id}"

    def _topic_result(self, book: TopicLedger, duration_s: float, t_end: float) -> TopicResult:
        topic = self._topic(book.topic_id)
        key = (book.src_id, book.topic_id)
        sent, received = self.sent.get(key, Track()), self.received.get(key, Track())
        (t_sent, xy_sent), (t_received, xy_received) = sent.points(), received.points()
        return topic_result(
            book,
            duration_s,
            t_end,
            topic=self._name(*key),
            type=topic.type_name if topic is not None else "",
            path_error_m=path_error(xy_sent, xy_received),
            rms_error_m=rms_error(t_sent, xy_sent, t_received, xy_received),
            left_out_sent=sent.left_out,
            left_out_received=received.left_out,
        )
