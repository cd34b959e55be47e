"""What a person should know about a link that runs, and about its surroundings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.link.endpoint import OpenEndpoint, without_table
from gr_ros2.middleware.services import ServiceGraph
from gr_ros2.radio.clocks import ClockWatch
from gr_ros2.radio.findings import doubled, outrun, peers, same_id, unheard
from gr_ros2.radio.mismatch import Mismatch
from gr_ros2.radio.ros_side import RosSide
from gr_ros2.radio.waiting import foreign, shortcut


class LinkFindings:
    """The findings of one robot's link.

    :param robot: its number
    :param stats: a snapshot of its counters, as :meth:`gr_ros2.radio.robot_link.RobotLink.stats`
    :param clock: s, monotonic
    """

    def __init__(
        self,
        robot: int,
        end: LiveEnd[OpenEndpoint],
        ros: RosSide,
        *,
        mismatch: Mismatch,
        clocks: ClockWatch,
        stats: Callable[[], Mapping[str, Any]],
        clock: Callable[[], float],
    ) -> None:
        self._robot, self._end, self._ros = robot, end, ros
        self._mismatch, self._clocks, self._stats, self._clock = mismatch, clocks, stats, clock
        self._outrun: dict[str, int] = {}

    def lines(self) -> list[str]:
        """One line each, mostly none."""
        now, stats, graph = self._clock(), self._stats(), self._ros.graph
        heard = stats["peers"]
        robots = [peer["robot"] for peer in heard]
        names = {info.topic for info in graph.discover() if info.publishers}
        services = graph.discover_services() if isinstance(graph, ServiceGraph) else ()
        full, self._outrun = outrun(self._outrun, stats["source"]["topics"])
        lines = [
            shortcut([*names, *services], self._robot, robots),
            foreign(names, stats["sink"]["topics"]),
            *self._same_numbers(heard),
            *without_table(peer["robot"] for peer in heard if peer["no_table"]),
            full if self._ros.shares else None,
            *self._mismatch.lines(stats, robots, now),
            *self._clocks.lines(now),
        ]
        with self._end.lock:
            if self._ros.slots is not None and self._ros.slots.unheard(now):
                lines.append(unheard(self._robot, robots))
        return [line for line in lines if line is not None]

    def alarms(self) -> list[str]:
        """One line for each number under which two robots send, and for each clock that was set lately."""
        now = self._clock()
        return [*self._same_numbers(peers(self._end, now)), *self._clocks.lines(now)]

    def _same_numbers(self, heard: Sequence[Mapping[str, Any]]) -> list[str]:
        with self._end.lock:
            own = same_id(self._robot, self._end.endpoint.received.rejected)
        return [*([own] if own else []), *doubled(heard)]
