"""The health of a running link: its counters over the last seconds, compared with limits.

Invariants: no input or output, and time is an argument. Only counters that the blocks keep anyway are read. A value
that is not known is left out, never invented. Loss is estimated from gaps in numbers, because a receiver cannot know
what was sent. The levels are those of diagnostic_msgs/DiagnosticStatus.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

from gr_ros2.core.watch import Watch
from gr_ros2.link.fates import Fate
from gr_ros2.settings.config import DiagnosticsConfig

Stats = Mapping[str, Any]

WINDOW_S = 10.0
"""s over which rates and losses are taken: long enough for a share of some packets, short enough to act on."""
QUEUE_FULL = 0.8
"""Share of a queue's bound that waits to be sent from which on it is about to drop messages."""

LOCKED = {
    "no_key": "sealed, and no key is configured here",
    "not_sealed": "not sealed, where a key is configured",
    "wrong_key": "sealed with a key that is not accepted here",
    "replayed": "replays of what was heard before",
    "not_stored": "not used, because the state file cannot be written",
    "same_id": "under this robot's own id",
    "tag": "damaged, or forged",
}
"""Reasons to refuse a packet that may be caused by an attack or by a wrong configuration."""


class Level(IntEnum):
    """Severity of a status."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass
class Status:
    """One part of a link.

    :ivar problems: what is wrong, in words; empty if the level is OK
    :ivar values: values by name, as text
    """

    name: str
    level: Level = Level.OK
    problems: list[str] = field(default_factory=list)
    values: dict[str, str] = field(default_factory=dict)

    @property
    def message(self) -> str:
        """The problems in one line, or OK."""
        return "; ".join(self.problems) or "OK"

    def judge(self, what: str, value: float, unit: str, warn: float, error: float = 0.0) -> None:
        """Add a value, and raise the level if the value exceeds a limit (0: no limit)."""
        self.values[f"{what} ({unit})" if unit else what] = f"{value:.3g}"
        level = Level.ERROR if error and value > error else Level.WARN if warn and value > warn else Level.OK
        if level:
            self.level = max(self.level, level)
            self.problems.append(f"{what} {value:.3g} {unit}".strip())

    def warn(self, what: str, count: int, before: int) -> None:
        """Add a count of events that should never happen, and warn if the count has grown."""
        self.values[what] = str(count)
        if count > before:
            self.level = max(self.level, Level.WARN)
            self.problems.append(f"{count - before} {what}")


class Recent(NamedTuple):
    """A link's figures over the last ``WINDOW_S``, or since it was judged first.

    :ivar sent, received: packets/s
    :ivar air: share of the time for which it sends, 0..1; of several radios, that of the busiest
    :ivar delivered: share of the messages that came, 0..1; None where none was due
    """

    sent: float
    received: float
    air: float
    delivered: float | None


class _Snapshot(NamedTuple):
    """The relevant counters at one moment. For each topic: messages delivered and messages lost; for each radio: s of
    airtime sent."""

    now: float
    sent: int
    airtimes: tuple[float, ...]
    received: int
    missing: int
    rejected: int
    lost_on_graph: int
    unpublished: int
    topics: dict[str, tuple[int, int]]
    front_end_passed: Mapping[str, int]
    front_end_lost: Mapping[str, int]
    locked: dict[str, int]
    unsaved: int
    state_unsaved: int


class LinkHealth:
    """Judges the snapshots of one link, taken at regular times.

    :param name: prefix of the name of every part
    """

    def __init__(self, config: DiagnosticsConfig, name: str) -> None:
        self._config = config
        self._name = name
        self._snapshots: deque[_Snapshot] = deque()
        self._heard_at: float | None = None
        self._reached: dict[int, float] = {}
        """When something of each robot came last, itself or over others, s."""
        self._silence, self._silences = self._watch(), dict[int, Watch]()
        """Of all robots, and of each."""

    def judge(self, stats: Stats, now: float) -> list[Status]:
        """The status of receiver, transmitter, front end (if it counts anything), each of several radios, and every
        topic received.

        :param stats: statistics of a ``RobotLink``
        :param now: s, monotonic
        """
        snapshot = _snapshot(stats, now)
        if snapshot.received > (self._snapshots[-1].received if self._snapshots else 0):
            self._heard_at = now
        while len(self._snapshots) > 1 and self._snapshots[1].now <= now - WINDOW_S:
            self._snapshots.popleft()
        before = self._snapshots[0] if self._snapshots else snapshot
        front_end = self._front_end(snapshot, self._snapshots[-1].front_end_lost if self._snapshots else {})
        self._snapshots.append(snapshot)
        topics = [self._topic(name, topic, before, snapshot) for name, topic in stats["sink"]["topics"].items()]
        receiver, transmitter = self._receiver(stats, before, snapshot), self._transmitter(stats, before, snapshot)
        first = before is snapshot
        for kind, count in snapshot.locked.items():
            receiver.warn(f"packets refused: {LOCKED[kind]}", count, 0 if first else before.locked.get(kind, 0))
        unsaved = 0 if first else before.state_unsaved
        receiver.warn("times that the state file could not be written", snapshot.state_unsaved, unsaved)
        receiver.warn("messages not published", snapshot.unpublished, 0 if first else before.unpublished)
        transmitter.warn("messages lost on the ROS graph", snapshot.lost_on_graph, 0 if first else before.lost_on_graph)
        return [receiver, transmitter, *front_end, *self._radios(stats), *topics]

    def recent(self) -> Recent:
        """The figures between the snapshots judged."""
        before, snapshot = self._snapshots[0], self._snapshots[-1]
        delivered, lost = (
            max(
                sum(topic[part] for topic in snapshot.topics.values()) - sum(t[part] for t in before.topics.values()), 0
            )
            for part in (0, 1)
        )
        return Recent(
            sent=_rate(snapshot.sent - before.sent, before, snapshot),
            received=_rate(snapshot.received - before.received, before, snapshot),
            air=_air(before, snapshot),
            delivered=delivered / (delivered + lost) if delivered + lost else None,
        )

    def _watch(self) -> Watch:
        return Watch(2 * self._config.period_s)

    def links(self, stats: Stats, receiver: Status) -> dict[int, Status]:
        """How the link to each robot is that was ever heard or reached over others: ``up``, ``degraded`` or ``lost``.

        :param receiver: as :meth:`judge` has it; what troubles it troubles all links
        """
        (degraded_s, lost_s), found, now = self._config.silence_s, {}, self._snapshots[-1].now
        far = {peer["robot"]: peer for peer in stats["peers"] if peer["hops"]}
        clocks = {peer["robot"]: peer["clock"] for peer in stats["peers"]}
        doubled = {peer["robot"] for peer in stats["peers"] if peer["doubled"]}
        ages = [*stats["sink"]["silence_s"].items(), *((robot, peer["heard_s"]) for robot, peer in far.items())]
        for src_id, age in ages:
            self._reached[src_id] = max(self._reached.get(src_id, now - age), now - age)
        for src_id, at in self._reached.items():
            silence = now - at
            state = Status(f"gr_ros2/link_{src_id}", values={"age (s)": f"{silence:.2f}"})
            if (clock := clocks.get(src_id)) is not None:
                state.values["clock ahead (s)"] = f"{clock['ahead_s']:.4f} ± {clock['error_s']:.4f}"
            if src_id in far:
                state.values |= {"hops": str(far[src_id]["hops"]), "over robot": str(far[src_id]["over"])}
            watched = self._silences.setdefault(src_id, self._watch()).age(silence, now)
            if lost_s and watched > lost_s:
                state.level, state.problems = Level.ERROR, ["lost"]
            elif receiver.level or (degraded_s and watched > degraded_s):
                state.level, state.problems = Level.WARN, ["degraded"]
            else:
                state.problems = ["up"]
            if src_id in doubled:
                state.level = max(state.level, Level.WARN)
                state.problems.append("two robots have this number")
            found[src_id] = state
        return found

    def _receiver(self, stats: Stats, before: _Snapshot, snapshot: _Snapshot) -> Status:
        status, limits = Status(f"{self._name}: receiver"), self._config
        received, missing = snapshot.received - before.received, snapshot.missing - before.missing
        if received + missing > 0:
            lost = max(missing, 0) / (received + max(missing, 0))
            status.judge("packet loss", lost, "", *limits.loss)
        status.judge("packets received", _rate(received, before, snapshot), "1/s", 0)
        status.judge("packets rejected", _rate(snapshot.rejected - before.rejected, before, snapshot), "1/s", 0)
        if self._heard_at is None:
            status.values["silence (s)"] = "nothing received yet"
        else:
            silence = self._silence.age(snapshot.now - self._heard_at, snapshot.now)
            status.judge("silence", silence, "s", *limits.silence_s)
        status.values["packets damaged"] = str(stats["packets"]["damaged"])
        status.values["frames of others"] = str(stats["packets"]["foreign"])
        status.values["held (B)"] = str(stats["sink"]["held_bytes"])
        snr = stats["phy"].get("snr_db")
        if snr is not None:
            status.values["SNR (dB)"] = f"{snr:.1f}"
        return status

    def _transmitter(self, stats: Stats, before: _Snapshot, snapshot: _Snapshot) -> Status:
        status = Status(f"{self._name}: transmitter")
        rate = _rate(snapshot.sent - before.sent, before, snapshot)
        status.judge("packets sent", rate, "1/s", 0)
        status.values["airtime of a packet (s)"] = f"{stats['phy']['airtime_s']:.3g}"
        status.values["airtime used"] = f"{_air(before, snapshot):.3g}"
        account = stats["airtime"]
        if not account["transmits"]:
            status.level = max(status.level, Level.WARN)
            status.problems.append("sending is off")
        if "spent_s" in account:
            status.values["airtime spent (s)"] = f"{account['spent_s']:.3g}"
            status.values["airtime allowed (s)"] = f"{account['allowed_s']:.3g} in {account['window_s']:g}"
            status.warn("times that the airtime account could not be stored", account["unsaved"], before.unsaved)
        status.values |= {f"packets dropped: {why}": str(count) for why, count in sorted(account["refused"].items())}
        status.values["packets waiting"] = str(stats["packets"]["backlog"])
        topics = stats["source"]["topics"].values()
        status.values["messages waiting"] = str(sum(topic["queued"] for topic in topics))
        # A queue that holds only the newest message is full by design. A queue without a bound is never full.
        bounded = [topic for topic in topics if topic["queue_depth"] and topic["queue"] != "latest"]
        if bounded:
            fullest = max(topic["queued"] / topic["queue_depth"] for topic in bounded)
            status.judge("fullest queue", fullest, "", QUEUE_FULL)
        refused: dict[str, int] = {}
        for topic in topics:
            for reason, count in topic["refused"].items():
                refused[reason] = refused.get(reason, 0) + count
        status.values |= {f"messages dropped: {reason}": str(count) for reason, count in sorted(refused.items())}
        for name, topic in stats["source"]["topics"].items():
            dropped = sum(topic["refused"].values()) + topic[Fate.LOST_ON_GRAPH]
            status.values[f"{name} (sent, dropped)"] = f"{topic['sent']}, {dropped}"
        return status

    def _radios(self, stats: Stats) -> list[Status]:
        """Each of several radios: a warning where its device is gone, or a robot is hardly heard over it."""
        found = []
        for name, radio in stats.get("radios", {}).items():
            status = Status(f"{self._name}: radio {name}")
            if not radio["present"]:
                status.level, status.problems = Level.WARN, ["the device is gone"]
            for robot, share in radio["heard"].items():
                status.values[f"heard of robot {robot}"] = f"{share:.2f}"
                if radio["present"] and share < 0.5:
                    status.level = Level.WARN
                    status.problems.append(f"robot {robot} is hardly heard over it")
            status.values |= {name: str(radio[name]) for name in ("sent", "copied", "skipped", "came", "copies")}
            status.values["carries"] = str(radio["carries"])
            if bound := radio.get("bound"):
                status.values["alone"] = ", ".join(bound["topics"])
                status.values["alone, messages that wait"] = str(bound["waiting"])
                status.values["alone, robots heard"] = ", ".join(map(str, bound["heard"]))
            found.append(status)
        return found

    def _front_end(self, snapshot: _Snapshot, before: Mapping[str, int]) -> list[Status]:
        """The counters of the front end, with a warning of new losses. Empty if it counts nothing."""
        status = Status(f"{self._name}: front end")
        status.values |= {name.replace("_", " "): str(count) for name, count in snapshot.front_end_passed.items()}
        for name, count in snapshot.front_end_lost.items():
            status.warn(name.replace("_", " "), count, before.get(name, 0))
        return [status] if status.values else []

    def _topic(self, name: str, topic: Stats, before: _Snapshot, snapshot: _Snapshot) -> Status:
        status, limits = Status(f"{self._name}: {name}"), self._config
        delivered, lost = (
            new - old for new, old in zip(snapshot.topics[name], before.topics.get(name, (0, 0)), strict=True)
        )
        if delivered + lost:
            share = lost / (delivered + lost)
            status.judge("messages lost", share, "", *limits.loss)
        status.judge("messages", _rate(delivered, before, snapshot), "1/s", 0)
        status.values["messages delivered"] = str(topic["delivered"])
        status.values |= {f"messages lost: {reason}": str(count) for reason, count in sorted(topic["lost"].items())}
        latency = topic["recent_latency_s"]
        if latency is not None:
            status.judge("latency", latency["p50"], "s", *limits.latency_s)
            status.values["latency, 95 % (s)"] = f"{latency['p95']:.3g}"
        if topic["age_s"] is not None:
            status.judge("age", topic["age_s"], "s", *limits.age_s)
        if topic["hops"]:
            status.values |= {"hops": str(topic["hops"]), "over robot": str(topic["over"])}
        return status


def _snapshot(stats: Stats, now: float) -> _Snapshot:
    sink = stats["sink"]
    topics = {name: (topic["delivered"], sum(topic["lost"].values())) for name, topic in sink["topics"].items()}
    rejected = sum(sink["rejected"].values())
    lost_on_graph = sum(topic[Fate.LOST_ON_GRAPH] for topic in stats["source"]["topics"].values())
    return _Snapshot(
        now=now,
        sent=stats["packets"]["out"],
        airtimes=tuple(radio["airtime"]["sent_s"] for radio in stats.get("radios", {"": stats}).values()),
        received=sink["packets"],
        missing=sink["packet_loss_est"],
        rejected=rejected,
        lost_on_graph=lost_on_graph,
        unpublished=sink[Fate.PUBLISH_FAILED],
        topics=topics,
        front_end_passed=stats["front_end"]["passed"],
        front_end_lost=stats["front_end"]["lost"],
        locked={kind: count for kind, count in sink["rejected"].items() if kind in LOCKED},
        unsaved=stats["airtime"].get("unsaved", 0),
        state_unsaved=sink["dropped"].get("state_not_written", 0),
    )


def _air(before: _Snapshot, snapshot: _Snapshot) -> float:
    """Share of the time for which the busiest radio sent. One that was opened again counts from 0 on."""
    used = max(new - old if new >= old else new for new, old in zip(snapshot.airtimes, before.airtimes, strict=True))
    return min(_rate(used, before, snapshot), 1.0)


def _rate(count: float, before: _Snapshot, snapshot: _Snapshot) -> float:
    return count / (snapshot.now - before.now) if snapshot.now > before.now else 0.0
