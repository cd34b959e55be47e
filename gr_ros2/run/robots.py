"""The robots of a scenario: the settings of each, and what lies between them, in real and simulated time.

Invariants: a robot that both sends and receives has one endpoint; a receiver that reports has a source id of its own;
starts are not counted, because no robot exists longer than its run; the robots that offer messages come first, in the
order of :meth:`Scenario.directions`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from gr_ros2.gr.ends import Start
from gr_ros2.link.rate import Rung
from gr_ros2.medium.base import Path, Paths, PathsAt
from gr_ros2.run.scenario import Scenario
from gr_ros2.settings.config import SinkConfig, SourceConfig, replaced
from gr_ros2.settings.fields import AUTO
from gr_ros2.wire import BROADCAST

THERMAL_DBM_HZ = -174.0
"""Noise of a resistor at 290 K, dBm in a band of 1 Hz."""
LEAST_DB, MOST_DB = -30.0, 100.0
"""SNRs below the first are not heard and do not disturb; above the second nothing gets better."""
_SEEDS_APART = 7919
Halves = tuple[SourceConfig | None, SinkConfig | None]
"""The settings of a robot's sending half and of its receiving half; None for a half that it does not have."""


def start_of_run(
    ways: Sequence[Scenario], *, any_length: bool, ladder: Sequence[Rung] = (), half_duplex: bool = False
) -> Start:
    """The start of every robot of a run.

    :param ways: one scenario per direction
    :param any_length: whether the PHY carries shorter packets in less time
    :param ladder: see :attr:`gr_ros2.phy.Phy.ladder`
    :param half_duplex: whether all robots use one channel
    """
    answered = _answered(ways)
    return Start(ways[0].seed + 1, reports=answered, half_duplex=half_duplex, any_length=any_length, ladder=ladder)


def halves_of_robots(ways: Sequence[Scenario]) -> list[Halves]:
    """The settings of all robots. With one direction, the first sends and the others receive.

    :param ways: one scenario per direction
    """
    there = ways[0]
    if len(ways) > 1:
        sinks = [way.ros_sink for way in ways]
        if len(ways) == 2:
            sinks.reverse()  # each block is configured with the direction that it belongs to
        return [(way.ros_source, sink) for way, sink in zip(ways, sinks, strict=True)]
    halves: list[Halves] = [(there.ros_source, None)]
    own_id = there.ros_source.src_id()
    for number in range(1 + len(there.receivers)):
        sink = there.ros_sink
        if _answered(ways) and sink.robot_id in (AUTO, own_id):
            sink = replace(sink, robot_id=_free_id(own_id, number))
        halves.append((None, sink))
    return halves


def paths_at(scenario: Scenario, sample_rate: float) -> PathsAt:
    """For every robot the paths to those that can hear it, as a function of time. No gain changes yet.

    :param sample_rate: samples/s, which is the bandwidth of the noise
    """
    fixed = _between(scenario, sample_rate) if scenario.robots else _directed(scenario)
    return lambda _: fixed


def _between(scenario: Scenario, sample_rate: float) -> Paths:
    """The paths between robots that all send and receive."""
    paths: list[list[Path]] = []
    for number, sender in enumerate(scenario.robots):
        paths.append([])
        for other, receiver in enumerate(scenario.robots):
            snr_db = scenario.channel.snr_db
            if scenario.gains_db is not None:
                row = scenario.gains_db
                gain_db = row[number][other] if isinstance(row, tuple) else row
                noise_dbm = THERMAL_DBM_HZ + 10 * math.log10(sample_rate) + receiver.noise_figure_db
                snr_db = None if gain_db is None else sender.tx_power_dbm + gain_db - noise_dbm
                if snr_db is None or snr_db < LEAST_DB:
                    continue
            if other != number:
                seed = scenario.channel.seed + _SEEDS_APART * (1 + number * BROADCAST + other)
                snr_db = None if snr_db is None else min(snr_db, MOST_DB)
                paths[-1].append(Path(other, replaced(scenario.channel, snr_db=snr_db, seed=seed)))
    return paths


def _directed(scenario: Scenario) -> Paths:
    """The paths of the short forms: one sender and its receivers, or two robots."""
    ways = scenario.directions()
    if len(ways) > 1:
        return [[Path(1 - number, way.channel)] for number, way in enumerate(ways)]
    there = [Path(number, channel) for number, channel in enumerate((scenario.channel, *scenario.receivers), 1)]
    if scenario.reports is None:
        return [there, *([] for _ in there)]
    delay_s = scenario.reports.delay_s
    return [there, *([Path(0, channel, delay_s)] for channel in scenario.report_channels())]


def ears_of(scenario: Scenario, paths: Paths) -> list[list[int]]:
    """For each recorder of a run the robots whose packets it counts: first that of the result, then those of further
    receivers. Two robots share one recorder; each of several has its own, for the robots that it can hear."""
    ways = len(scenario.directions())
    if ways <= 2:
        return [list(range(ways)) for _ in range(1 + len(scenario.receivers))]
    heard: list[list[int]] = [[] for _ in range(ways)]
    for number, hearers in enumerate(paths):
        for path in hearers:
            heard[path.receiver].append(number)
    return heard


def recorder_of(scenario: Scenario, robot: int) -> int:
    """The place in :func:`ears_of` of the recorder of what a robot receives."""
    if scenario.robots:
        return robot if len(scenario.robots) > 2 else 0
    return 0 if scenario.back is not None else max(robot - 1, 0)


def _answered(ways: Sequence[Scenario]) -> bool:
    return len(ways) > 1 or ways[0].reports is not None


def _free_id(taken: int, number: int) -> int:
    """A source id for a receiver that reports and has no id of its own."""
    return BROADCAST - 1 - number - (BROADCAST - 1 - number <= taken)
