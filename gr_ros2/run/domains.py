"""The ROS graphs of a run, on domains of its own, so that two runs on one computer do not receive each other's
messages."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

from gr_ros2.middleware import Middleware, join_graph
from gr_ros2.middleware.free_domains import FREE, ReservedDomain
from gr_ros2.run.scenario import Scenario
from gr_ros2.settings.config import SinkConfig, SourceConfig, replaced
from gr_ros2.settings.fields import AUTO


def open_graph(scenario: Scenario, end: SourceConfig | SinkConfig, node: str) -> Middleware:
    """Join the graph of one end of the link with a participant of its own.

    :param node: name of the node on the graph, after ``gr_ros2_``
    """
    local = scenario.localhost_only
    return join_graph(end.middleware, domain_id=end.domain_id, node_name=f"gr_ros2_{node}", localhost_only=local)


def on_own_domains(scenario: Scenario, stack: ExitStack) -> Scenario:
    """The scenario on domains that nobody else uses, where ``own_domains`` is set and it names none.

    :param stack: gives the domains back
    :raises MiddlewareError: when none is free
    """
    if not scenario.own_domains:
        return scenario
    given = [
        end.domain_id for end in (scenario.ros_source, scenario.ros_sink, *(one.ros_source for one in scenario.robots))
    ]
    free = (number for number in FREE if number not in given)
    if scenario.robots:
        domains = [
            stack.enter_context(ReservedDomain(free)).number if domain == AUTO else domain for domain in given[2:]
        ]
        robots = [
            replace(robot, ros_source=replaced(robot.ros_source, domain_id=domain))
            for robot, domain in zip(scenario.robots, domains, strict=True)
        ]
        return replace(scenario, robots=tuple(robots))
    here, there = (stack.enter_context(ReservedDomain(free)).number if domain == AUTO else domain for domain in given)
    back = scenario.back
    if back is not None:  # the reverse direction has the same two graphs
        ends = {"ros_source": there, "ros_sink": here}
        back = replace(
            back,
            **{
                name: replaced(end, domain_id=domain)
                for name, domain in ends.items()
                for end in (getattr(back, name),)
                if end.domain_id == AUTO
            },
        )
    return replace(
        scenario,
        ros_source=replaced(scenario.ros_source, domain_id=here),
        ros_sink=replaced(scenario.ros_sink, domain_id=there),
        back=back,
    )
