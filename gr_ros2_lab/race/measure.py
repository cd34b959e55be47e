"""The results of one contender under one condition, as numbers, and the best contenders of a condition.

Invariants: a message is delivered when its bytes arrive unchanged, and it counts once. Bytes in alignment gaps and the
padding of DDS may change. A number that does not apply is None. Winners are computed from the numbers as the tables
show them, so contenders with the same shown number win together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Literal

import numpy as np

from gr_ros2.codecs.messages import COMPRESSED_IMAGE, IMAGE
from gr_ros2.compression import LinkCodec
from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2.observe.latency import latency
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.race.contenders import Races
from gr_ros2_lab.race.links import LinkLog, LinkReport
from gr_ros2_lab.race.race_settings import RaceRecording
from gr_ros2_lab.race.rows import RowName, number_of, quality_db
from gr_ros2_lab.record.metrics import Age, age, age_quantile

FRESH_S = 0.2
"""s of age up to which odometry counts as fresh."""
_IN_FLIGHT_S = 0.5
"""s after an outage's begin in which what had passed the air before may still arrive."""
_JUDGED_EACH = 5
"""Of so many pictures one is compared with what the camera saw."""


@dataclass(frozen=True)
class RaceCell:
    """Results of one contender under one condition. Times are in s, sizes in bytes. Both directions of the air count.

    :param load: share of the airtime that the recording needs without compression, one frame per message
    :param loss: probability that a frame is lost
    :param matched: both ends found each other before the first message
    :param delivered: messages of ``sent`` that arrived unchanged; ``altered`` and ``duplicates`` are counted apart
    :param airtime_per_message: airtime of all frames since the first message, per message delivered
    :param air_bytes_per_message: bytes of all frames since the first message, per message delivered
    :param air_bytes_reverse: share of these bytes that the receiving end sent
    :param discovery_bytes: bytes of all frames before the first message
    :param first_message: time from joining the network to the first delivery
    :param robots: 2 and more on one channel: all numbers are those of all pairs; None for a talker and a listener
    :param latency_p99_of_sent: what 99 % of the messages sent are not later than, where one that is lost never comes;
        None where more than 1 % are lost
    :param age_p95: what the age does not exceed for 95 % of the time; of a team the mean of all pairs
    :param age_peak: the highest age of any pair
    :param all_heard: time from the last robot's joining until every robot has a message of every other one
    :param row: what happened beside the odometry, of which all numbers are but those of ``beside``
    :param found_after: time from joining the network until both ends know of each other, after which the first message
        is sent: the network's part of ``first_message``
    :param processor_per_message: processor time of all programs and of the radio's process, per message delivered
    :param processor_programs: that of the two programs alone, which ends with the interface of the network
    :param fresh_after: time from an outage's end until the newest message is ``FRESH_S`` old or less
    :param lost: messages of ``sent`` that never came
    :param bytes_until_fresh: bytes of all frames from the outage's begin until then
    :param beside_delivered: share of the messages beside the odometry that arrived
    :param beside_done: time until the last of them was there, from when it was sent, or the receiver joined; None
        unless all arrived
    :param beside_age: of a camera, what the age of its newest picture does not exceed for 95 % of the time
    :param beside_quality: of a camera, mean PSNR of the pictures that arrived, dB
    :param drops: frames and messages that were dropped on the way, by name
    :param busy: load average per processor; above 1, the times come from the computer and not from the radio
    """

    contender: str
    load: float
    loss: float
    sample_rate: float
    matched: bool
    sent: int
    delivered: int
    altered: int
    duplicates: int
    pdr: float | None
    latency_p50: float | None
    latency_p99: float | None
    age_mean: float | None
    airtime_per_message: float | None
    air_bytes_per_message: float | None
    air_bytes_reverse: float | None
    discovery_bytes: float
    first_message: float | None
    drops: dict[str, int]
    busy: float
    robots: int | None = None
    latency_p99_of_sent: float | None = None
    age_p95: float | None = None
    age_peak: float | None = None
    all_heard: float | None = None
    row: RowName = "steady"
    found_after: float | None = None
    processor_per_message: float | None = None
    processor_programs: float | None = None
    fresh_after: float | None = None
    lost: int | None = None
    bytes_until_fresh: float | None = None
    beside_delivered: float | None = None
    beside_done: float | None = None
    beside_age: float | None = None
    beside_quality: float | None = None

    @property
    def races(self) -> Races:
        """The race to which it belongs."""
        if self.robots:
            return "team"
        return "two" if self.row == "steady" else "row"


@dataclass(frozen=True)
class Column:
    """A number that is compared between contenders.

    :param better: whether the largest or the smallest number wins
    :param races: those in which it is compared
    :param rows: of the rows, those in which it is compared; none: all
    """

    heading: str
    better: Literal["most", "least"]
    shown: Callable[[float], str]
    races: tuple[Races, ...] = ("two", "row", "team")
    rows: tuple[RowName, ...] = ()


def _ms(value: float) -> str:
    return f"{value * 1e3:.0f}" if value >= 0.1 else f"{value * 1e3:.1f}"


def _whole(value: float) -> str:
    return f"{value:.0f}"


_OUTAGES: tuple[RowName, ...] = ("outage-5", "outage-30")


COLUMNS = {
    "pdr": Column("PDR", "most", "{:.3f}".format),
    "latency_p50": Column("latency p50 [ms]", "least", _ms, ("two", "team")),
    "latency_p99": Column("latency p99 [ms]", "least", _ms, ("two", "team")),
    "latency_p99_of_sent": Column("p99 of sent [ms]", "least", _ms, ("two", "team")),
    "age_mean": Column("age mean [ms]", "least", _ms),
    "age_p95": Column("age p95 [ms]", "least", _ms),
    "age_peak": Column("age peak [ms]", "least", _ms),
    "airtime_per_message": Column("airtime /msg [ms]", "least", _ms, ("two",)),
    "air_bytes_per_message": Column("air bytes /msg", "least", _whole),
    "discovery_bytes": Column("discovery bytes", "least", _whole, ("two", "team")),
    "found_after": Column("found after [s]", "least", "{:.2f}".format, ("two",)),
    "first_message": Column("first message [s]", "least", "{:.2f}".format, ("two", "row"), ("late",)),
    "all_heard": Column("all hear all [s]", "least", "{:.2f}".format, ("team",)),
    "processor_per_message": Column("processor /msg [ms]", "least", _ms, ("two", "row")),
    "fresh_after": Column("fresh after [s]", "least", "{:.2f}".format, ("row",), _OUTAGES),
    "lost": Column("lost", "least", _whole, ("row",), _OUTAGES),
    "bytes_until_fresh": Column("bytes until fresh", "least", _whole, ("row",), _OUTAGES),
    "beside_delivered": Column("beside: delivered", "most", "{:.2f}".format, ("row",), ("late", "map", "camera")),
    "beside_done": Column("beside: all after [s]", "least", "{:.1f}".format, ("row",), ("late", "map")),
    "beside_age": Column("beside: age p95 [ms]", "least", _ms, ("row",), ("camera",)),
    "beside_quality": Column("beside: PSNR [dB]", "most", "{:.1f}".format, ("row",), ("camera",)),
}
"""The compared numbers, by field of :class:`RaceCell`."""


def columns(cells: Sequence[RaceCell]) -> dict[str, Column]:
    """Those of the race to which these cells belong."""
    kinds = {(cell.races, cell.row) for cell in cells} or {("two", "steady")}
    return {
        name: column
        for name, column in COLUMNS.items()
        if any(races in column.races and (races != "row" or row in (column.rows or (row,))) for races, row in kinds)
    }


class Identity:
    """Finds the message of a recording that has the given bytes.

    :raises ConfigError: when two messages of the recording are the same
    """

    def __init__(self, recording: RaceRecording) -> None:
        self._pictures = recording.type_name in (IMAGE, COMPRESSED_IMAGE)
        self.type_name = recording.type_name
        self._codec = LinkCodec(Registry.from_rows([(recording.topic, recording.type_name)]))
        self._numbers = {self._plain(payload): number for number, payload in enumerate(recording.payloads)}
        if len(self._numbers) < len(recording.payloads):
            raise ConfigError(
                f"{recording.path}: {recording.topic} holds the same message twice, so that it is not known which of "
                "them arrived; choose a topic with a stamp"
            )

    def number(self, payload: bytes) -> int | None:
        """Position of the message in the recording, from 0; None if the recording has no such message."""
        return self._numbers.get(self._plain(payload))

    def _plain(self, payload: bytes) -> bytes:
        """The payload without the bytes that DDS and the codec may change: alignment gaps, zeros after the message.

        Of a picture only its number, as video is not what went in.
        """
        if self._pictures:
            return str(number_of(payload)).encode()
        return self._codec.decode(0, self._codec.encode(0, payload)).rstrip(b"\0")


@dataclass(frozen=True)
class RaceSender:
    """What a robot sends, and how its messages are recognized."""

    recording: RaceRecording
    identity: Identity

    def sent(self, t_first: float) -> list[float]:
        """When each message counts as sent, if the first one did at ``t_first``."""
        return [t_first + due for due in self.recording.due]


@dataclass(frozen=True)
class RaceStream:
    """The messages of one program at another one. All times are s on one clock.

    :param t_sent: due time of each message, in the order of the recording
    :param heard: time of each arrival, and the bytes that arrived
    """

    identity: Identity
    t_sent: Sequence[float]
    heard: Sequence[tuple[float, bytes]]


@dataclass(frozen=True)
class Observed:
    """What was observed of one contender. All times are s on one clock.

    :param began: when the first program began to join; of a team the last one
    :param streams: of every pair of programs
    :param busy: see :class:`RaceCell`
    :param beside: what goes beside the odometry
    :param outage: begin and end
    :param processor_s: processor time of the programs, and of the radio's process, from the first message to the last
    :param late: only what was sent after ``began`` counts as sent
    :param found_after: see :class:`RaceCell`
    """

    began: float
    matched: bool
    streams: Sequence[RaceStream]
    air: LinkReport
    busy: float
    beside: Sequence[RaceStream] = ()
    outage: tuple[float, float] | None = None
    processor_s: tuple[float, float] | None = None
    late: bool = False
    found_after: float | None = None


def check_outage(outage: tuple[float, float], stream: RaceStream, air: LinkReport) -> None:
    """Check the premise of an outage.

    :raises RunError: when anything came through, or nothing was lost
    """
    begin, end = outage
    came = sum(begin + _IN_FLIGHT_S < now < end for now, _ in stream.heard)
    if came or not air.drops["on_air"]:
        raise RunError(f"the race's outage of {end - begin:.1f} s was none: {came} messages came, drops {air.drops}")


def measure(
    seen: Observed,
    *,
    contender: str,
    load: float,
    loss: float,
    sample_rate: float,
    robots: int | None = None,
    row: RowName = "steady",
) -> RaceCell:
    """Compute all numbers of a cell."""
    altered = duplicates = sent = 0
    latencies: list[Floats] = []
    ages: list[Age] = []
    p95s: list[float] = []
    firsts: list[float] = []
    fresh_after = None
    for stream in seen.streams:
        t_sent, t_delivered, changed, again = _arrivals(stream)
        altered, duplicates = altered + changed, duplicates + again
        if seen.late:
            after = t_sent >= seen.began
            t_sent, t_delivered = t_sent[after], t_delivered[after]
        done = ~np.isnan(t_delivered)
        if seen.outage is not None:
            fresh_after = _fresh_after(t_sent[done], t_delivered[done], seen.outage[1])
        sent += len(t_sent)
        latencies.append(t_delivered[done] - t_sent[done])
        if done.any():
            firsts.append(float(t_delivered[done].min()) - seen.began)
        found = age(t_sent[done], t_delivered[done], float(t_sent[-1])) if len(t_sent) else None
        if found is not None:
            ages.append(found)
            p95s.append(age_quantile(t_sent[done], t_delivered[done], float(t_sent[-1]), 0.95) or 0.0)
    delivered = sum(map(len, latencies))
    arrived = np.sort(np.concatenate(latencies))
    times = latency(arrived)
    last_of_99 = ceil(0.99 * sent) - 1
    first = min((stream.t_sent[0] for stream in seen.streams if len(stream.t_sent)), default=np.inf)
    logs = (seen.air.forward, seen.air.reverse)
    before, _ = _traffic(logs, -np.inf, first)
    size, airtime = _traffic(logs, first, np.inf)
    reverse, _ = _traffic(logs[1:], first, np.inf)
    until_fresh = None
    if seen.outage is not None and fresh_after is not None:
        until_fresh, _ = _traffic(logs, seen.outage[0], seen.outage[1] + fresh_after)
    used = seen.processor_s
    return RaceCell(
        contender=contender,
        load=load,
        loss=loss,
        sample_rate=sample_rate,
        matched=seen.matched,
        sent=sent,
        delivered=delivered,
        altered=altered,
        duplicates=duplicates,
        pdr=delivered / sent if sent else None,
        latency_p50=None if times is None else times.p50,
        latency_p99=None if times is None else times.p99,
        age_mean=sum(found.mean for found in ages) / len(ages) if ages else None,
        airtime_per_message=airtime / delivered if delivered else None,
        air_bytes_per_message=size / delivered if delivered else None,
        air_bytes_reverse=reverse / size if size else None,
        discovery_bytes=before,
        first_message=min(firsts, default=None),
        drops={name: count for name, count in seen.air.drops.items() if count},
        busy=seen.busy,
        robots=robots,
        latency_p99_of_sent=float(arrived[last_of_99]) if 0 <= last_of_99 < delivered else None,
        age_p95=sum(p95s) / len(p95s) if p95s else None,
        age_peak=max((found.peak for found in ages), default=None),
        all_heard=max(firsts) if len(firsts) == len(seen.streams) else None,
        row=row,
        found_after=seen.found_after,
        processor_per_message=sum(used) / delivered if used and delivered else None,
        processor_programs=used[0] / delivered if used and delivered else None,
        fresh_after=fresh_after,
        lost=sent - delivered if seen.outage is not None else None,
        bytes_until_fresh=until_fresh,
        **_beside(seen),
    )


def _arrivals(stream: RaceStream) -> tuple[Floats, Floats, int, int]:
    """When each message was sent and delivered, nan where it was not; how many came altered, and again."""
    t_sent = np.array(stream.t_sent)
    t_delivered = np.full(len(t_sent), np.nan)
    altered = duplicates = 0
    for now, payload in stream.heard:
        number = stream.identity.number(payload)
        if number is None or number >= len(t_sent):
            altered += 1
        elif not np.isnan(t_delivered[number]):
            duplicates += 1
        else:
            t_delivered[number] = now
    return t_sent, t_delivered, altered, duplicates


def _fresh_after(t_sent: Floats, t_delivered: Floats, end: float) -> float | None:
    """Time from the end of an outage until the newest message delivered is ``FRESH_S`` old or less."""
    fresh = t_delivered[(t_delivered >= end) & (t_delivered - t_sent <= FRESH_S)]
    return float(fresh.min()) - end if len(fresh) else None


def _beside(seen: Observed) -> dict[str, float | None]:
    """The numbers of what goes beside the odometry."""
    if not seen.beside:
        return {}
    sent = delivered = 0
    done: list[float] = []
    p95: float | None = None
    quality: list[float] = []
    for stream in seen.beside:
        t_sent, t_delivered, _, _ = _arrivals(stream)
        there = ~np.isnan(t_delivered)
        sent, delivered = sent + len(t_sent), delivered + int(there.sum())
        done += [float(now - max(was, seen.began)) for was, now in zip(t_sent[there], t_delivered[there], strict=True)]
        if stream.identity.type_name in (IMAGE, COMPRESSED_IMAGE):
            p95 = age_quantile(t_sent[there], t_delivered[there], float(t_sent[-1]), 0.95)
            quality = [quality_db(number_of(payload), payload) for _, payload in stream.heard[::_JUDGED_EACH]]
    return {
        "beside_delivered": delivered / sent,
        "beside_done": max(done) if delivered == sent else None,
        "beside_age": p95,
        "beside_quality": sum(quality) / len(quality) if quality else None,
    }


def shown(cell: RaceCell, column: str) -> str:
    """A number as the tables show it; a dash if it is None."""
    value = getattr(cell, column)
    return "–" if value is None else COLUMNS[column].shown(value)


def winners(cells: Sequence[RaceCell]) -> dict[str, list[str]]:
    """The best contenders in each column. All cells must have the same condition."""
    best: dict[str, list[str]] = {}
    for name, column in columns(cells).items():
        values = {cell.contender: getattr(cell, name) for cell in cells if getattr(cell, name) is not None}
        if not values:
            best[name] = []
            continue
        top = (max if column.better == "most" else min)(values.values())
        best[name] = [contender for contender, value in values.items() if column.shown(value) == column.shown(top)]
    return best


def ahead(cells: Sequence[RaceCell], contender: str) -> dict[str, list[str]]:
    """Who is better than a contender, by column. All cells must have the same condition; equal shown numbers are equal.

    A contender without a number is behind all that have one.
    """
    own = {cell.contender: cell for cell in cells}.get(contender)
    found: dict[str, list[str]] = {}
    for name, column in columns(cells).items():
        value = None if own is None else getattr(own, name)
        for cell in cells:
            other = getattr(cell, name)
            if other is None or (value is not None and column.shown(other) == column.shown(value)):
                continue
            if value is None or (other > value) == (column.better == "most"):
                found.setdefault(name, []).append(cell.contender)
    return found


def by_condition(cells: Sequence[RaceCell]) -> Mapping[tuple[float, float], list[RaceCell]]:
    """The cells, grouped by (load, loss)."""
    groups: dict[tuple[float, float], list[RaceCell]] = {}
    for cell in cells:
        groups.setdefault((cell.load, cell.loss), []).append(cell)
    return groups


def _traffic(logs: Sequence[LinkLog], begin: float, end: float) -> tuple[float, float]:
    """Bytes, and airtime in s, of the frames between two times."""
    size = airtime = 0.0
    for log in logs:
        t = np.array(log.t)
        inside = (t >= begin) & (t < end)
        size += float(np.array(log.size)[inside].sum())
        airtime += float(np.array(log.airtime)[inside].sum())
    return size, airtime
