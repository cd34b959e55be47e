"""The ROS graphs of a run, on domains of its own, so that two runs on one computer do not receive each other's
messages."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from typing import TypeVar

from gr_ros2.middleware import Middleware, join_graph
from gr_ros2.middleware.free_domains import FREE, ReservedDomain
from gr_ros2.settings.config import SinkConfig, SourceConfig, replaced
from gr_ros2.settings.fields import AUTO
from gr_ros2_lab.run.robot_settings import RobotSettings
from gr_ros2_lab.run.scenario import Scenario

_Half = TypeVar("_Half", SourceConfig | None, SinkConfig | None)


def open_graph(scenario: Scenario, end: SourceConfig | SinkConfig, node: str) -> Middleware:
    """Join the graph of one end of the link with a participant of its own.

    :param node: name of the node on the graph, after ``gr_ros2_``
    """
    local = scenario.localhost_only
    return join_graph(end.middleware, domain_id=end.domain_id, node_name=f"gr_ros2_{node}", localhost_only=local)


def on_own_domains(scenario: Scenario, stack: ExitStack) -> tuple[RobotSettings, ...]:
    """The robots of a scenario on domains that nobody else uses, where ``own_domains`` is set and they name none. Each
    has a graph of its own; those that only receive are on one together.

    :param stack: gives the domains back
    :raises MiddlewareError: when none is free
    """
    robots = scenario.all_robots
    if not scenario.own_domains:
        return robots
    given = {half.domain_id for robot in robots for half in (robot.source, robot.sink) if half is not None}
    free = (number for number in FREE if number not in given)
    reserved: dict[int, int] = {}

    def own(half: _Half, graph: int) -> _Half:
        if half is None or half.domain_id != AUTO:
            return half
        if graph not in reserved:
            reserved[graph] = stack.enter_context(ReservedDomain(free)).number
        return replaced(half, domain_id=reserved[graph])

    graphs = [-1 if robot.source is None else number for number, robot in enumerate(robots)]
    return tuple(
        replace(robot, source=own(robot.source, graph), sink=own(robot.sink, graph))
        for robot, graph in zip(robots, graphs, strict=True)
    )
