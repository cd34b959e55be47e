"""The robots of a scenario: the settings of each, and what lies between them, in real and simulated time.

Invariants: a robot that both sends and receives has one endpoint; a receiver that reports has a source id of its own;
starts are not counted, because no robot exists longer than its run; the robots that offer messages come first, in the
order of :meth:`Scenario.directions`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gr_ros2.config import SinkConfig, SourceConfig
from gr_ros2.gr.ends import Start
from gr_ros2.link.rate import Rung
from gr_ros2.medium.base import Path, Paths
from gr_ros2.run.scenario import Scenario
from gr_ros2.setting import AUTO
from gr_ros2.wire import BROADCAST

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
        return [(way.ros_source, ways[1 - number].ros_sink) for number, way in enumerate(ways)]
    halves: list[Halves] = [(there.ros_source, None)]
    own_id = there.ros_source.src_id()
    for number in range(1 + len(there.receivers)):
        sink = there.ros_sink
        if _answered(ways) and sink.robot_id in (AUTO, own_id):
            sink = replace(sink, robot_id=_free_id(own_id, number))
        halves.append((None, sink))
    return halves


def paths_of(scenario: Scenario) -> Paths:
    """For every robot the paths to those that can hear it."""
    ways = scenario.directions()
    if len(ways) > 1:
        return [[Path(1 - number, way.channel)] for number, way in enumerate(ways)]
    there = [Path(number, channel) for number, channel in enumerate((scenario.channel, *scenario.receivers), 1)]
    if scenario.reports is None:
        return [there, *([] for _ in there)]
    delay_s = scenario.reports.delay_s
    return [there, *([Path(0, channel, delay_s)] for channel in scenario.report_channels())]


def recorder_of(scenario: Scenario, robot: int) -> int:
    """Which recorder takes what a robot receives: 0 that of the result, 1 and above those of further receivers."""
    return 0 if scenario.back is not None else max(robot - 1, 0)


def _answered(ways: Sequence[Scenario]) -> bool:
    return len(ways) > 1 or ways[0].reports is not None


def _free_id(taken: int, number: int) -> int:
    """A source id for a receiver that reports and has no id of its own."""
    return BROADCAST - 1 - number - (BROADCAST - 1 - number <= taken)
