"""The two ends of a scenario's link, and the further receivers: which settings each has, in real and simulated time.

Invariants: an end that both sends and receives is one endpoint; a receiver that reports has a source id of its own;
starts are not counted, because no end exists longer than its run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gr_ros2.config import SinkConfig, SourceConfig
from gr_ros2.gr.ends import Start
from gr_ros2.link.rate import Rung
from gr_ros2.run.scenario import Scenario
from gr_ros2.setting import AUTO
from gr_ros2.wire import BROADCAST

Halves = tuple[SourceConfig | None, SinkConfig | None]
"""The settings of an end's sending half and of its receiving half; None for a half that it does not have."""


def start_of_run(ways: Sequence[Scenario], *, any_length: bool, ladder: Sequence[Rung] = ()) -> Start:
    """The start of every end of a run.

    :param ways: one scenario per direction
    :param any_length: whether the PHY carries shorter packets in less time
    :param ladder: see :attr:`gr_ros2.phy.Phy.ladder`
    """
    return Start(ways[0].seed + 1, reports=_answered(ways), any_length=any_length, ladder=ladder)


def halves_of_ends(ways: Sequence[Scenario]) -> list[Halves]:
    """The settings of all ends. The first sends and the others receive; with two directions, the second sends too.

    :param ways: one scenario per direction
    """
    there, back = ways[0], ways[1] if len(ways) > 1 else None
    halves: list[Halves] = [(there.ros_source, None if back is None else back.ros_sink)]
    own_id = there.ros_source.src_id()
    for number in range(1 + len(there.receivers)):
        sink = there.ros_sink
        if back is None and _answered(ways) and sink.robot_id in (AUTO, own_id):
            sink = replace(sink, robot_id=_free_id(own_id, number))
        halves.append((None if back is None else back.ros_source, sink))
    return halves


def _answered(ways: Sequence[Scenario]) -> bool:
    return len(ways) > 1 or ways[0].reports is not None


def _free_id(taken: int, number: int) -> int:
    """A source id for a receiver that reports and has no id of its own."""
    return BROADCAST - 1 - number - (BROADCAST - 1 - number <= taken)
