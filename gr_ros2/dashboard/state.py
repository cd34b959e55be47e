"""The state of one link for a dashboard. It takes the events of both ends and gives snapshots. Sans-IO.

Invariants: the size of the windows bounds the memory, however long the link runs. Times are arguments, s on the clock
of the events. Any thread may call it, and no call delays another thread for longer than it takes to read one message.
Counts are exact during the run. When the result is known, every number comes from the result.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from math import nan
from threading import Lock
from types import MappingProxyType
from typing import get_args

import numpy as np

from gr_ros2.core.watch import Watch
from gr_ros2.dashboard.packets import missing_before, packet_views
from gr_ros2.dashboard.pictures import newest_picture
from gr_ros2.dashboard.topic_names import Key, TopicNames
from gr_ros2.dashboard.views import GOOD, SILENT_S, AirView, PathView, RobotView, SeriesView, Snapshot, TopicView
from gr_ros2.dashboard.windows import RATE_S, AgeMeter, PathComparison, Rate
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.events import (
    Accepted,
    AirKind,
    Announced,
    Delivered,
    Lost,
    Missed,
    Received,
    ReceiverEvent,
    Refused,
    Rejected,
    SenderEvent,
    SentPacket,
)
from gr_ros2.link.fates import Fate, arrived
from gr_ros2.link.lateness import LATE_S
from gr_ros2.link.tracker import Tracked, Tracker
from gr_ros2.observe.latency import Latency, latency, latency_cdf
from gr_ros2.observe.positions import PositionReader, position_reader
from gr_ros2.observe.result import RunResult, TopicResult
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire import Packet

HISTORY_S = 180.0
"""Length of the shown curves and paths, s."""
LATENCIES = 2000
"""Newest deliveries of a topic from which its latency is computed."""
UNDER_WAY = 4096
"""Most messages of a source that wait for their delivery. The oldest is forgotten first and then has no latency."""
PACKETS_SHOWN = 12

_ROBOTS = 64
"""Most robots heard that are remembered."""
_ENOUGH = 3
"""Fewest messages or packets in the last seconds from which a share is taken."""
_QUIET_S = 1.0
"""s, and three times as long as between two packets, after which none comes any more: a burst is heard in less."""
_CHANGES = 100
"""Most changes of the channel that are remembered."""
_PATH_STEP_S = 0.1


class _Topic:
    """One topic of one source."""

    def __init__(self, type_name: str, history: int) -> None:
        self.sent = 0
        self.delivered = 0
        self.repaired = 0
        self.delivered_bytes = 0
        self.ended: Counter[str] = Counter()
        self.sent_rate = Rate()
        self.delivered_rate = Rate()
        self.latencies: deque[float] = deque(maxlen=LATENCIES)
        self.age = AgeMeter()
        self.mean(type_name)
        self.belief = PathComparison(int(HISTORY_S / _PATH_STEP_S), _PATH_STEP_S)
        self.history: deque[tuple[float, float, float, float, float]] = deque(maxlen=history)

    def mean(self, type_name: str) -> None:
        """Its messages are of this type."""
        self.read_position: PositionReader | None = position_reader(type_name)
        self.picture = newest_picture(type_name)

    def fates(self, *, arrives: bool) -> dict[str, int]:
        """The ledger fates as far as the events alone show them. An observer of both ends uses the ledger instead.

        :param arrives: whether it is seen what arrives
        """
        whole = {Fate.DELIVERED.value: self.delivered - self.repaired, Fate.REPAIRED.value: self.repaired}
        fates = {fate: count for fate, count in {**whole, **self.ended}.items() if count}
        rest = self.sent - sum(fates.values())
        return {**fates, Fate.IN_FLIGHT.value: rest} if rest > 0 and arrives else fates


class _SourceWindow:
    """One sender."""

    def __init__(self) -> None:
        self.last_serial = -1
        self.arrives = False
        """Whether what arrives of it is seen: not at its own end of a link."""
        self.messages: Tracker[Tracked] = Tracker(UNDER_WAY)
        """Messages on their way, so that a delivery finds its submission."""
        self.unheard = Rate()
        """Packets that it has sent since one of it came; as bytes, how many numbers they take."""


class DashboardState:
    """Everything the page shows of one link.

    :param registry: types of the topic ids
    :param topics: names of the topics to show from the start, by source id and topic id
    :param packet_len: bytes of a packet
    :param name: name of the link
    :param duration_s: s during which messages will be submitted, 0 = unknown
    :param ledger: gives the messages per fate, as an observer of both ends knows them; None uses the events alone
    :param tick_s: s between two calls of :meth:`tick`, for the length of the history
    :param airtime: s that a packet of so many bytes takes at an MCS; None where packets take no air, or it is not known
    :param received_as: absolute name under which a sender's topic comes out here, '' where it is not known
    :param senders: source ids of those that the receiver can hear; what others send is left out. None = all
    """

    def __init__(
        self,
        registry: Registry,
        topics: Mapping[Key, str],
        packet_len: int,
        *,
        name: str = "",
        duration_s: float = 0.0,
        ledger: Callable[[], Mapping[Key, Mapping[str, int]]] | None = None,
        tick_s: float = 0.5,
        airtime: Callable[[int, int], float] | None = None,
        received_as: Callable[[int, str], str] = lambda _src_id, _name: "",
        senders: Collection[int] | None = None,
    ) -> None:
        self._lock = Lock()
        self._senders = senders
        self._names = TopicNames(registry, topics)
        self._packet_len = packet_len
        self._name = name
        self._duration_s = duration_s
        self._ledger = ledger
        self._history, self._least_span_s = int(HISTORY_S / tick_s), tick_s / 2
        self._start: float | None = None
        self._sources: dict[int, _SourceWindow] = {}
        self._topics: dict[Key, _Topic] = {}
        self._received: deque[tuple[float, Received | Rejected]] = deque(maxlen=PACKETS_SHOWN + 1)
        self._packets: Counter[str] = Counter()
        self._packets_sent, self._packets_received = Rate(), Rate()
        self._understood, self._numbered, self._missed = Rate(), Rate(), Rate()
        """Packets received, and as bytes those that their numbers show to be missing."""
        self._newest: dict[int, int] = {}
        self._changes: deque[float] = deque(maxlen=_CHANGES)
        self._phase = "waiting"
        self._airtime, self._received_as = airtime, received_as
        self._silence = Watch(2 * tick_s)
        self._spent: Counter[str] = Counter()
        """s of air since the last point of the history, by what the packets were for."""
        self._air: deque[tuple[float, ...]] = deque(maxlen=self._history)
        self._robots: dict[int, tuple[float, int]] = {}
        """When each robot was heard last, itself or over others, and packets received of it."""
        self._ways: dict[int, tuple[int, int | None]] = {}
        """How many robots have sent the newest message of each robot on, and the last of them."""
        self._result: RunResult | None = None
        for key in topics:
            if self._hears(key[0]):
                self._topic(key)

    # -- feeding ------------------------------------------------------------------------------------------------

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        if not self._hears(src_id):
            return
        with self._lock:
            source = self._sources.setdefault(src_id, _SourceWindow())
            if isinstance(event, SentPacket):
                self._packets["sent"] += 1
                self._packets[f"air_{event.kind}"] += 1
                if self._airtime is not None:
                    self._spent[event.kind] += self._airtime(len(event.data), event.mcs)  # type: ignore[assignment]
                self._packets_sent.add(event.now)
                source.unheard.add(event.now, event.packet.numbered)
                for entry in event.entries:
                    source.messages.left(entry)
            elif isinstance(event, Accepted):
                self._accepted(source, src_id, event)
            elif isinstance(event, Missed):
                topic = self._topic((src_id, event.topic_id))
                topic.sent += event.count
                topic.ended[Fate.LOST_ON_GRAPH.value] += event.count
            elif isinstance(event, Refused):
                self._refused(source, src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        with self._lock:
            if isinstance(event, Delivered):
                self._delivered(event, now)
            elif isinstance(event, Announced):
                for topic in event.topics:
                    full_name = self._received_as(event.src_id, topic.name)
                    self._learn((event.src_id, topic.topic_id), topic.name, topic.type_name, full_name)
            elif isinstance(event, Lost):
                source = self._sources.get(event.src_id)
                if source is None or not source.messages.repeats(event):
                    self._topic((event.src_id, event.topic_id)).ended[str(event.reason)] += 1
            elif isinstance(event, Received | Rejected):
                self._begin(now)
                self._packets["handed_up"] += 1
                self._packets_received.add(now)
                self._received.append((now, event))
                if isinstance(event, Received):
                    self._heard(event.packet.src_id, now, packets=1)
                    self._understood.add(now)
                    if event.packet.numbered:  # others, as repairs and reports, tell only which are missing
                        self._numbered.add(now)
                    self._missed.add(now, self._missing_before(event.packet, now))
                if isinstance(event, Rejected):
                    self._packets[f"rejected_{event.error.kind}"] += 1
                    self._packets["rejected"] += 1

    def changed(self, now: float) -> None:
        """Somebody has changed the channel."""
        with self._lock:
            if self._start is not None:
                self._changes.append(now - self._start)

    def subscribed(self, src_id: int, topics: Iterable[tuple[str, Topic]]) -> None:
        """Take over what a source's topics are, with absolute names. More may come while it runs."""
        if not self._hears(src_id):
            return
        with self._lock:
            for full_name, topic in topics:
                self._learn((src_id, topic.topic_id), topic.name, topic.type_name, full_name)

    def finish(self, result: RunResult | None, *, failed: bool = False) -> None:
        """End the run. There is no result if the run failed, or if only one end of the link was observed."""
        with self._lock:
            self._result = result
            self._phase = "failed" if failed else "ended"

    # -- asking -------------------------------------------------------------------------------------------------

    def tick(
        self,
        now: float,
        queued: Mapping[Key, int] | None = None,
        *,
        snr_db: float | None = None,
        late_s: float = 0.0,
        told: Sequence[str] = (),
        clocks: Mapping[int, ClockOffset] = MappingProxyType({}),
    ) -> Snapshot:
        """A snapshot of the link now. Until the run is over, it also becomes the newest point of the history.

        :param queued: messages waiting at the source, by source and topic id
        :param snr_db: of the newest packets received, dB
        :param late_s: how late the computer was in the last seconds, s
        :param told: what the link itself says is wrong
        :param clocks: what is known of the clocks of other robots
        """
        ledger = {} if self._ledger is None else self._ledger()
        with self._lock:
            over = self._phase in ("ended", "failed")
            here = self._understood.totals(now)[0]
            lost_now = self._lost(now)
            start = now if self._start is None else self._start
            elapsed = max(now - start, 0.0)
            keys = sorted(self._topics)
            if not over and self._start is not None:
                for key in keys:
                    self._remember(key, now, elapsed, (queued or {}).get(key))
                self._remember_air(elapsed, snr_db if here else None, lost_now)
            views = tuple(
                self._view(place, key, now, elapsed=elapsed, queued=queued or {}, ledger=ledger)
                for place, key in enumerate(keys)
            )
            colours = {key: place for place, key in enumerate(keys)}
            received = self._packets["handed_up"] - self._packets["rejected"]
            rejected = {kind: n for kind, n in sorted(self._packets.items()) if kind.startswith("rejected_")}
            air = {f"air_{kind}": self._packets[f"air_{kind}"] for kind in get_args(AirKind)}
            heard = list(self._received)
            alarms = {} if over or self._start is None else dict(self._alarms(now, elapsed, keys, late_s, told))
            past = np.array(self._air, dtype=float).reshape(-1, 3 + len(get_args(AirKind)))
            busy = dict(zip(get_args(AirKind), past[:, 3:].T, strict=True))
            silent = min((now - last for last, _ in self._robots.values()), default=None)
            return Snapshot(
                phase=self._phase,
                name=self._name,
                elapsed_s=elapsed if self._result is None else self._result.duration_s,
                duration_s=self._duration_s,
                sent=sum(view.sent for view in views),
                delivered=sum(view.delivered for view in views),
                topics=views,
                series=tuple(self._series(place, key) for place, key in enumerate(keys)),
                paths=tuple(
                    self._path(place, key, start) for place, key in enumerate(keys) if self._topics[key].read_position
                ),
                pictures=tuple(
                    view
                    for key in keys
                    if (picture := self._topics[key].picture) is not None
                    and (view := picture.view(self._names.full(key), now)) is not None
                ),
                packets={
                    "sent": self._packets["sent"],
                    "received": received,
                    **rejected,
                    **(air if sum(air.values()) > air["air_new"] else {}),
                },
                state=next(iter(alarms), "" if over or self._start is None else "up"),
                alarms=tuple(text for texts in alarms.values() for text in texts),
                heard=tuple(
                    RobotView(src_id, now - last, count, *self._ways.get(src_id, (0, None)), clocks.get(src_id))
                    for src_id, (last, count) in sorted(self._robots.items())
                ),
                air=AirView(
                    past[:, 0],
                    {} if self._airtime is None else busy,
                    past[:, 1],
                    past[:, 2],
                    tuple(self._changes),
                ),
                lost_now=lost_now,
                silent_s=silent,
                packets_now=(
                    self._packets_sent.totals(now)[0] / RATE_S,
                    self._packets_received.totals(now)[0] / RATE_S,
                ),
                last_packets=packet_views(heard, self._packet_len, self._names, colours, start)[-PACKETS_SHOWN:],
            )

    def _alarms(
        self, now: float, elapsed: float, keys: list[Key], late_s: float, told: Sequence[str]
    ) -> Iterator[tuple[str, list[str]]]:
        """What is wrong now, by the state that it stands for, the worst first."""
        silent = [now - last for last, _ in self._robots.values()]
        if self._silence.age(min(silent, default=elapsed), now) > SILENT_S:
            yield "down", ["no robot has been heard" + (f" for {min(silent):.0f} s" if silent else " yet")]
        if late_s >= LATE_S:
            yield (
                "late",
                [f"the computer is up to {late_s:.2f} s late: what this page shows is the computer's, not the link's"],
            )
        poor = [*told]
        for key in keys:
            topic, share = self._topics[key], _pdr_now(self._topics[key], now)
            enough = elapsed > RATE_S and topic.sent_rate.totals(now)[0] >= _ENOUGH
            if self._ledger is not None and enough and share is not None and share < GOOD:
                poor.append(f"{self._names.full(key)}: {share:.0%} of the messages of the last {RATE_S:.0f} s arrived")
        if poor:
            yield "degraded", poor

    def _lost(self, now: float) -> float | None:
        """The share of the packets of the last seconds that were lost. While nothing comes, packets that were sent say
        so; where only what comes is seen, nothing does: the last ones that came tell only of the time before them."""
        numbered, missing = self._numbered.totals(now)[0], self._missed.totals(now)[1]
        since = {src_id: now - last for src_id, (last, _) in self._robots.items()}
        between_s = (RATE_S - min(since.values(), default=0.0)) / max(numbered, 1)
        silent = {src_id: silence > max(_QUIET_S, 3 * between_s) for src_id, silence in since.items()}
        unheard = sum(
            source.unheard.totals(now)[1]
            for src_id, source in self._sources.items()
            if silent.get(src_id) and self._whole(src_id)
        )
        missing += unheard
        told = unheard or not all(silent.values())
        return missing / (numbered + missing) if told and numbered + missing >= _ENOUGH else None

    def _missing_before(self, packet: Packet, now: float) -> int:
        """Packets of the last seconds that are missing before this one, and no more: an outage may have been longer."""
        missing = missing_before(packet, self._newest)
        source = self._sources.get(packet.src_id)
        if source is None or not self._whole(packet.src_id):
            return missing
        sent, source.unheard = source.unheard.totals(now)[1], Rate()
        return min(missing, sent)

    def _whole(self, src_id: int) -> bool:
        """Whether it is seen both what a sender sends and what arrives of it."""
        return self._ledger is not None or (src_id in self._sources and self._sources[src_id].arrives)

    def _remember(self, key: Key, now: float, elapsed: float, queued: int | None) -> None:
        topic = self._topics[key]
        age = topic.age.read(now)
        pdr = _pdr_now(topic, now) if self._whole(key[0]) else None
        topic.history.append(
            (
                elapsed,
                nan if pdr is None else pdr,
                topic.delivered_rate.totals(now)[1] / RATE_S,
                nan if age is None else age[0],
                nan if queued is None else queued,
            )
        )

    def _remember_air(self, elapsed: float, snr_db: float | None, lost: float | None) -> None:
        """Add what the air was used for to its history. A clock that hardly moves, as simulated time may, adds
        nothing: a single packet would take most of so short a time."""
        span = elapsed - (self._air[-1][0] if self._air else 0.0)
        if span >= self._least_span_s:
            spent = (self._spent[kind] / span for kind in get_args(AirKind))
            self._air.append((elapsed, *(nan if value is None else value for value in (snr_db, lost)), *spent))
            self._spent.clear()

    def _view(
        self,
        place: int,
        key: Key,
        now: float,
        *,
        elapsed: float,
        queued: Mapping[Key, int],
        ledger: Mapping[Key, Mapping[str, int]],
    ) -> TopicView:
        topic = self._topics[key]
        final = self._final(key)
        if final is not None:
            return _final_view(place, key, final)
        # The ledger has priority: it has taken every event, also those from before this state was made.
        whole = self._whole(key[0])
        fates = topic.fates(arrives=whole) if self._ledger is None else dict(ledger.get(key, {}))
        sent, delivered = (
            (topic.sent, topic.delivered) if self._ledger is None else (sum(fates.values()), arrived(fates))
        )
        seconds = min(elapsed, self._duration_s) if self._duration_s else elapsed
        latencies = np.sort(np.array(topic.latencies, dtype=float))
        age_now, age_mean, age_peak = topic.age.read(now) or (None, None, None)
        return TopicView(
            name=self._names.full(key),
            type_name=self._names.type_name(key),
            src_id=key[0],
            topic_id=key[1],
            colour=place,
            sent=sent,
            delivered=delivered,
            pdr=delivered / sent if sent and whole else None,
            pdr_now=_pdr_now(topic, now) if whole else None,
            goodput_Bps=topic.delivered_bytes / seconds if seconds > 0 else None,
            goodput_now_Bps=topic.delivered_rate.totals(now)[1] / RATE_S,
            latency_s=latency(latencies),
            latency_cdf_s=latency_cdf(latencies),
            age_now_s=age_now,
            age_mean_s=age_mean,
            age_peak_s=age_peak,
            queued=queued.get(key),
            ledger=fates,
        )

    def _series(self, place: int, key: Key) -> SeriesView:
        points = np.array(self._topics[key].history, dtype=float).reshape(-1, 5)
        t, pdr, goodput, age, queued = points.T
        return SeriesView(self._names.full(key), place, t, pdr, goodput, age, queued)

    def _path(self, place: int, key: Key, start: float) -> PathView:
        belief = self._topics[key].belief
        t, errors = belief.errors()
        return PathView(
            self._names.full(key),
            place,
            *belief.sent.xy(),
            *belief.received.xy(),
            truth=belief.sent.latest,
            belief=belief.received.latest,
            error_m=belief.error(),
            error_t=t - start,
            errors_m=errors,
        )

    def _final(self, key: Key) -> TopicResult | None:
        if self._result is None:
            return None
        name = self._names.full(key)
        return next((t for t in self._result.topics if (t.src_id, t.topic) == (key[0], name)), None)

    # -- events -------------------------------------------------------------------------------------------------

    def _begin(self, now: float) -> None:
        if self._start is None:
            self._start = now
            self._spent.clear()
            if self._phase == "waiting":
                self._phase = "running"

    def _learn(self, key: Key, name: str, type_name: str, full_name: str = "") -> None:
        if self._names.learn(key, name, type_name, full_name=full_name) and key in self._topics:
            self._topics[key].mean(type_name)

    def _topic(self, key: Key) -> _Topic:
        topic = self._topics.get(key)
        if topic is None:
            topic = self._topics[key] = _Topic(self._names.type_name(key), self._history)
        return topic

    def _accepted(self, source: _SourceWindow, src_id: int, event: Accepted) -> None:
        self._begin(event.now)
        topic = self._topic((src_id, event.topic_id))
        topic.sent += 1
        source.last_serial = event.serial
        topic.sent_rate.add(event.now, len(event.payload))
        source.messages.add(Tracked.of(event))
        if topic.read_position is not None:
            point = topic.read_position(event.payload)
            if point is not None:
                topic.belief.moved(event.now, point)

    def _refused(self, source: _SourceWindow, src_id: int, event: Refused) -> None:
        topic = self._topic((src_id, event.topic_id))
        topic.ended[str(event.reason)] += 1
        message = source.messages.get(event.serial)
        if message is not None:
            source.messages.close(message)
        if event.serial > source.last_serial:  # refused before it was queued
            source.last_serial = event.serial
            topic.sent += 1

    def _heard(self, src_id: int, now: float, *, packets: int) -> None:
        self._robots[src_id] = now, self._robots.get(src_id, (now, 0))[1] + packets
        if len(self._robots) > _ROBOTS:
            del self._robots[min(self._robots, key=lambda one: self._robots[one][0])]

    def _hears(self, src_id: int) -> bool:
        return self._senders is None or src_id in self._senders

    def _delivered(self, event: Delivered, now: float) -> None:
        key = (event.src_id, event.topic_id)
        source = self._sources.get(event.src_id)
        message = None
        if source is not None:
            source.arrives = True
            message = source.messages.find(event)
            if message is not None:
                source.messages.close(message)
            elif source.messages.repeats(event):
                return
        self._ways[event.src_id] = event.hops, event.over
        if event.hops:
            self._heard(event.src_id, now, packets=0)
        topic = self._topic(key)
        topic.delivered += 1
        topic.repaired += event.repaired
        topic.delivered_bytes += len(event.payload)
        topic.delivered_rate.add(now, len(event.payload))
        made = now - (event.age_s if event.latency_s is None else event.latency_s)
        if message is not None:
            made = message.t_sent
            topic.latencies.append(now - made)
            topic.age.delivered(made, now)
        elif source is None:  # its sender is not observed: what it has waited there, its stamp tells at most
            topic.age.delivered(made, now)
            if event.latency_s is not None:
                topic.latencies.append(event.latency_s)
        if topic.picture is not None:
            topic.picture.take(event.message, made)
        if topic.read_position is not None:
            point = topic.read_position(event.payload)
            if point is not None:
                topic.belief.heard(now, point)


def _pdr_now(topic: _Topic, now: float) -> float | None:
    sent = topic.sent_rate.totals(now)[0]
    return min(topic.delivered_rate.totals(now)[0] / sent, 1.0) if sent else None  # some were sent before


def _final_view(place: int, key: Key, final: TopicResult) -> TopicView:
    q = final.latency_s
    known = [value for value in (q.p50, q.p95, q.p99, q.max) if value is not None]
    return TopicView(
        name=final.topic,
        type_name=final.type,
        src_id=key[0],
        topic_id=key[1],
        colour=place,
        sent=final.sent,
        delivered=final.delivered,
        pdr=final.pdr,
        pdr_now=None,
        goodput_Bps=final.goodput_Bps,
        goodput_now_Bps=0.0,
        latency_s=Latency(*known) if len(known) == 4 else None,
        latency_cdf_s=final.latency_cdf_s,
        age_now_s=None,
        age_mean_s=final.age_s.mean,
        age_peak_s=final.age_s.peak,
        queued=None,
        ledger=dict(final.ledger),
        path_error_m=final.path_error_m,
        rms_error_m=final.rms_error_m,
    )
