"""Robots between which the channel was measured: over time by a trace, or over place by a survey."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import ChannelConfig, MeasuredChannel, ScenarioChannel
from gr_ros2_lab.medium.base import FixedPaths, Hearers, Ints, Measured, RadioPath, Surroundings
from gr_ros2_lab.medium.positions import LEAST_DB, Motion, Positions
from gr_ros2_lab.medium.trace import ChannelTrace, MeasuredLosses, TraceLevels, is_survey, read_trace
from gr_ros2_lab.survey.table import Survey, read_table

Paths = Sequence[Sequence[RadioPath]]


class TracedPaths(FixedPaths):
    """Robots whose channels follow traces over time.

    :param traces: of those paths that have one, by sender and receiver
    :param levels: whether SNRs count, rather than losses
    """

    def __init__(self, paths: Paths, traces: dict[tuple[int, int], ChannelTrace], *, levels: bool) -> None:
        super().__init__(paths)
        self._traces, self._counts_levels, self._begin_s = traces, levels, 0.0
        with_snr = levels and any(trace.snr_db is not None for trace in traces.values())
        self.moves = "channel.trace" if with_snr else ""
        self.surveyed = with_snr
        self._levels = [self._levels_of(sender) for sender in range(self.robots)]
        self._acting = any(map(self._acts, traces.values()))
        self.passes = self.passes and not self._acting

    def begin(self, now: float) -> None:
        self._begin_s = now

    def change(self, sender: int, **settings: Any) -> None:
        if self.moves and "snr_db" in settings:
            raise ConfigError("channel.snr_db: the level follows from the trace; leave channel.trace out")
        super().change(sender, **settings)
        self.passes = self.passes and not self._acting
        self._levels[sender] = self._levels_of(sender)

    def hearers(self, sender: int, now: float) -> Hearers:
        return self._levels[sender].hearers(now - self._begin_s)

    def measured(self, sender: int, receiver: int) -> Measured | None:
        trace = self._traces.get((sender, receiver))
        return None if trace is None or not self._acts(trace) else MeasuredLosses(trace)

    def _acts(self, trace: ChannelTrace) -> bool:
        """Whether a trace loses or delays whole packets."""
        by_level = self._counts_levels and trace.snr_db is not None
        return trace.capacity is not None or (trace.loss is not None and not by_level)

    def _levels_of(self, sender: int) -> TraceLevels:
        paths = [self.path(sender, receiver) for receiver in self.reached(sender)]
        told = [(path, self._traces.get((sender, path.receiver)) if self._counts_levels else None) for path in paths]
        return TraceLevels(told, self.robots, LEAST_DB)


class SurveyedPlaces(Positions):
    """Robots whose channels were measured where they drive.

    :param levels: whether SNRs count, rather than losses
    """

    moves = "channel.trace"
    surveyed = True

    def __init__(self, survey: Survey, channel: ScenarioChannel, motion: Motion, paths: Paths, *, levels: bool) -> None:
        self.survey, self._counts_levels = survey, levels
        if levels and not survey.has_snr:
            raise ConfigError(
                f"channel.trace: {survey.name} has no SNR; take phy direct or modem, for which its losses count"
            )
        (survey.path_loss if levels else survey.loss_line).at(np.ones(1))  # says what it cannot tell
        robots = len(paths)
        super().__init__(channel, motion, 1.0, [0.0] * robots, [0.0] * robots, paths=paths)
        self.passes = self.passes and levels

    def change(self, sender: int, **settings: Any) -> None:
        super().change(sender, **settings)
        self.passes = self.passes and self._counts_levels

    def range_m(self, snr_db: float) -> float:
        return self.survey.path_loss.range_m(snr_db) if self._counts_levels else inf

    def measured(self, sender: int, receiver: int) -> Measured | None:
        return None if self._counts_levels else _SurveyedLoss(self, sender, receiver)

    def loss(self, sender: int, receiver: int, now: float) -> float:
        """Share of the packets that are lost, s after the run began."""
        self._go(now + self._begin_s)
        return self.survey.loss_between(self._places[sender], self._places[receiver])

    def _snr_db(self, sender: int, ids: Ints, apart: Floats) -> Floats:
        if not self._counts_levels:
            return np.full(len(apart), inf)
        return self.survey.snr_between(self._places[sender], self._places[ids])


class _SurveyedLoss(Measured):
    def __init__(self, around: SurveyedPlaces, sender: int, receiver: int) -> None:
        self._around, self._pair = around, (sender, receiver)

    def loss(self, now: float) -> float:
        return self._around.loss(*self._pair, now)


def measured_channel(
    channel: ScenarioChannel, paths: Paths, motion: Callable[[Survey], Motion], *, samples: bool
) -> Surroundings | None:
    """Robots whose channels were measured; None where none was.

    :param channel: of all paths that have none of their own
    :param motion: where the robots are, those that nobody tells where the survey says
    :param samples: whether the PHY has any, and so a level
    :raises ConfigError: when a file is wrong, or says nothing that this PHY has
    """
    named = {(sender, path.receiver): _trace(path.channel) for sender, heard in enumerate(paths) for path in heard}
    files = {name: Path(name) for name in named.values() if name}
    if not files:
        return None
    surveys = [path for path in files.values() if is_survey(path)]
    bare = [[path.bare for path in heard] for heard in paths]
    if surveys:
        if len(files) > 1 or not all(named.values()):
            raise ConfigError(f"paths: {surveys[0]} is of all robots; name it in channel.trace alone")
        if channel.snr_db is not None:
            raise ConfigError("channel.snr_db: follows from the survey; leave one of them out")
        survey = Survey(str(surveys[0]), read_table(surveys[0]))
        return SurveyedPlaces(survey, channel, motion(survey), bare, levels=samples)
    read = {name: read_trace(path) for name, path in files.items()}
    for trace in read.values():
        _check(trace, samples=samples)
    traces = {pair: read[name] for pair, name in named.items() if name}
    for sender, heard in enumerate(bare):
        for path in heard:
            trace_of = traces.get((sender, path.receiver))
            if trace_of is not None and trace_of.snr_db is not None and path.channel.snr_db is not None:
                raise ConfigError("channel.snr_db: follows from the trace; leave one of them out")
    return TracedPaths(bare, traces, levels=samples)


def _check(trace: ChannelTrace, *, samples: bool) -> None:
    if samples and trace.capacity is not None:
        raise ConfigError(
            f"channel.trace: {trace.name} tells a capacity, which this phy has by its own airtime; take phy direct or "
            "modem, or a trace of snr_db or loss"
        )
    if not samples and trace.loss is None and trace.capacity is None:
        raise ConfigError(
            f"channel.trace: {trace.name} tells an SNR, which a phy without samples has not; take another phy, or a "
            "trace of loss or capacity_bps"
        )


def _trace(channel: ChannelConfig) -> str:
    return channel.trace if isinstance(channel, MeasuredChannel) else ""
