"""The ROS graphs of a run, on domains of its own, so that two runs on one computer do not receive each other's
messages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace

from gr_ros2.middleware.free_domains import FREE, ReservedDomain
from gr_ros2.settings.fields import AUTO
from gr_ros2_lab.run.robot_settings import RobotSettings
from gr_ros2_lab.run.scenario import Scenario


def on_own_domains(scenario: Scenario, stack: ExitStack) -> tuple[RobotSettings, ...]:
    """The robots of a scenario on domains that nobody else uses, where ``own_domains`` is set and they name none. Each
    has a graph of its own.

    :param stack: gives the domains back
    :raises MiddlewareError: when none is free
    """
    robots = scenario.all_robots
    if not scenario.own_domains:
        return robots
    given = {robot.config.graph.domain_id for robot in robots}
    free = (number for number in FREE if number not in given)
    return tuple(_on_own_domain(robot, free, stack) for robot in robots)


def _on_own_domain(robot: RobotSettings, free: Iterator[int], stack: ExitStack) -> RobotSettings:
    graph = robot.config.graph
    if graph.domain_id != AUTO:
        return robot
    domain_id = stack.enter_context(ReservedDomain(free)).number
    return replace(robot, config=replace(robot.config, graph=replace(graph, domain_id=domain_id)))
