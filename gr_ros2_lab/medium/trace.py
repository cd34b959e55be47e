"""A channel that was measured over time: SNR, loss or capacity, from a CSV file or in Mahimahi's format.

Invariants: a value holds until the next row; after its end a trace begins again; a packet is never faster than the
capacity that was measured, and what was not used of it is lost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.medium.base import Hearers, Measured, RadioPath
from gr_ros2_lab.survey.numbers import check_ranges, line_of, read_numbers, text_of
from gr_ros2_lab.survey.table import NEEDED

TIME = "t_s"
VALUES = ("snr_db", "loss", "capacity_bps")
GAP = 10.0
"""A row that comes so many times later than rows do in the middle leaves a gap."""
QUEUE_S = 2.0
"""s for which a packet may wait for capacity, or there is no room for it."""
_MTU = 1500
"""Bytes that one line of Mahimahi's format lets pass."""
_RANGES = {TIME: (-1e13, 1e13), "snr_db": (-100.0, 100.0), "loss": (0.0, 1.0), "capacity_bps": (0.0, 1e12)}


class Capacity:
    """How many bytes can have passed by a time.

    :param times: s, ascending; the last is the end of the trace, the first 0 unless there are stairs
    :param carried: bytes that have passed by each, ascending
    :param stairs: whether they pass at these times, not between them
    """

    def __init__(self, times: Floats, carried: Floats, *, stairs: bool) -> None:
        self._times, self._carried, self._stairs = times, carried, stairs

    def by(self, now: float) -> float:
        """Bytes that can have passed by a time in s."""
        rounds, rest = divmod(max(now, 0.0), self._times[-1])
        if self._stairs:
            place = int(np.searchsorted(self._times, rest, "right"))
            within = float(self._carried[place - 1]) if place else 0.0
        else:
            within = float(np.interp(rest, self._times, self._carried))
        return float(rounds * self._carried[-1] + within)

    def when(self, carried: float) -> float:
        """When so many bytes have passed, s."""
        whole = float(self._carried[-1])
        rounds = max(math.ceil(carried / whole) - 1, 0)
        rest = carried - rounds * whole
        place = int(np.searchsorted(self._carried, rest, "left"))
        place = min(place, len(self._carried) - 1)
        at = float(self._times[place])
        if not self._stairs and place:
            before, then = self._carried[place - 1], self._carried[place]
            at -= float((then - rest) / (then - before) * (self._times[place] - self._times[place - 1]))
        return float(rounds * self._times[-1] + at)


@dataclass(frozen=True, eq=False)
class ChannelTrace:
    """What was measured over time.

    :param times: s, ascending from 0
    :param period_s: after which it begins again
    :param snr_db, loss: at these times; None = not measured
    """

    name: str
    times: Floats
    period_s: float
    snr_db: Floats | None = None
    loss: Floats | None = None
    capacity: Capacity | None = None

    def row(self, now: float) -> int:
        """The row that holds at a time in s."""
        return int(np.searchsorted(self.times, max(now, 0.0) % self.period_s, "right")) - 1


class MeasuredLosses(Measured):
    """What a trace does to the packets from one robot to another."""

    def __init__(self, trace: ChannelTrace) -> None:
        self._trace = trace
        self._passed = 0.0

    def loss(self, now: float) -> float:
        return 0.0 if self._trace.loss is None else float(self._trace.loss[self._trace.row(now)])

    def leaves(self, now: float, size: int) -> float | None:
        capacity = self._trace.capacity
        if capacity is None:
            return now
        passed = max(self._passed, capacity.by(now)) + size
        at = capacity.when(passed)
        if at > now + QUEUE_S:
            return None
        self._passed = passed
        return max(at, now)


def is_survey(path: Path) -> bool:
    """Whether a file tells a channel over place."""
    header = {name.strip() for name in text_of(path).partition("\n")[0].split(",")}
    return header.issuperset(NEEDED)


def read_trace(path: Path) -> ChannelTrace:
    """Read a channel over time.

    :raises ConfigError: when it cannot be read, or has a gap, a number that is none, or time that goes back; names line
        and value
    """
    first = text_of(path).split(maxsplit=1)[:1]
    if first and first[0].isdecimal():
        return _mahimahi(path)
    columns = read_numbers(path, (TIME, *VALUES))
    found = [name for name in VALUES if name in columns]
    if TIME not in columns or not found:
        raise ConfigError(
            f"{path}: has no header of a trace; write {TIME} and one or more of {', '.join(VALUES)}, or take a file of "
            "Mahimahi or a survey"
        )
    times = columns[TIME]
    if len(times) < 2:
        raise ConfigError(f"{path}: {len(times)} rows say nothing over time; a trace has two or more")
    check_ranges(path, columns, _RANGES)
    _check_times(path, times)
    times = times - times[0]
    usual = float(np.median(np.diff(times)))
    period_s = float(times[-1]) + usual
    capacity = None
    if "capacity_bps" in columns:
        until = np.append(times, period_s)
        carried = np.concatenate(([0.0], np.cumsum(columns["capacity_bps"] / 8 * np.diff(until))))
        capacity = _carrying(path, Capacity(until, carried, stairs=False), carried)
    return ChannelTrace(str(path), times, period_s, columns.get("snr_db"), columns.get("loss"), capacity)


def _check_times(path: Path, times: Floats) -> None:
    steps = np.diff(times)
    usual = float(np.median(steps))
    for row in np.flatnonzero(steps <= 0)[:1]:
        where = f"{path}: line {line_of(path, row + 1)}"
        raise ConfigError(
            f"{where}: {TIME} = {times[row + 1]:g} after {times[row]:g}: time goes back or stands; sort the rows"
        )
    for row in np.flatnonzero(steps > GAP * usual)[:1]:
        where = f"{path}: line {line_of(path, row + 1)}"
        raise ConfigError(
            f"{where}: a gap of {steps[row]:g} s after {TIME} = {times[row]:g}, where rows are {usual:g} s apart; "
            "fill it, or cut the trace there"
        )


def _mahimahi(path: Path) -> ChannelTrace:
    """The times in ms at which 1,500 bytes may pass, one a line."""
    lines = text_of(path).split()
    for number, line in enumerate(lines, 1):
        if not line.isdecimal() or len(line) > 12:
            raise ConfigError(f"{path}: line {number}: {line[:40]!r} is no time in ms, as Mahimahi writes them")
    times = np.array([int(line) for line in lines]) * 1e-3
    for row in np.flatnonzero(np.diff(times) < 0)[:1]:
        raise ConfigError(
            f"{path}: line {row + 2}: {lines[row + 1]} after {lines[row]}: time goes back; sort the lines"
        )
    if times[-1] == 0:
        raise ConfigError(f"{path}: ends at 0 ms, so it carries nothing over time; take a longer one")
    carried = _MTU * np.arange(1.0, len(times) + 1)
    return ChannelTrace(str(path), np.zeros(1), float(times[-1]), capacity=Capacity(times, carried, stairs=True))


def _carrying(path: Path, capacity: Capacity, carried: Floats) -> Capacity:
    if carried[-1] < _MTU:
        raise ConfigError(f"{path}: capacity_bps: {carried[-1]:.0f} bytes in all of it, not one packet; take another")
    return capacity


class TraceLevels:
    """The SNRs of one sender at those who hear it, as its traces tell them.

    :param paths: to those who hear it, each with its trace; None = the SNR of its channel
    """

    def __init__(self, paths: Sequence[tuple[RadioPath, ChannelTrace | None]], robots: int, least_db: float) -> None:
        self._paths, self._robots, self._least_db = paths, robots, least_db
        self._known: tuple[tuple[int, ...], Hearers] | None = None

    @cached_property
    def _ids(self) -> list[int]:
        return [path.receiver for path, _ in self._paths]

    def hearers(self, now: float) -> Hearers:
        """Those who hear it, s after the run began: the same object as long as nothing changes."""
        rows = tuple(-1 if trace is None or trace.snr_db is None else trace.row(now) for _, trace in self._paths)
        if self._known is None or self._known[0] != rows:
            levels = [self._level(place, row) for place, row in enumerate(rows)]
            heard = Hearers(np.array(self._ids, int), np.array(levels, float), np.zeros(len(levels)), self._robots)
            self._known = rows, heard
        return self._known[1]

    def _level(self, place: int, row: int) -> float:
        path, trace = self._paths[place]
        if trace is None or trace.snr_db is None:
            return math.inf if path.channel.snr_db is None else path.channel.snr_db
        return max(float(trace.snr_db[row]), self._least_db)
