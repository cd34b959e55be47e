"""The ROS graphs of a run, on domains of its own, so that two runs on one computer do not receive each other's
messages."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace

from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import MiddlewareError
from gr_ros2.settings.fields import AUTO
from gr_ros2_lab.run.robot_settings import RobotSettings
from gr_ros2_lab.run.scenario import Scenario

FIRST = 41
"""The domain that is tried first, so that a run alone on its computer always has the same."""
FREE = (*range(FIRST, 100), *range(1, FIRST), *range(215, 231))
"""Not the default 0. Their ports lie below and above those that the system hands out (32768 to 60999)."""
_MULTICAST = 0, 1
"""Ports of a domain that all its participants share: none can join where another program has one for itself."""
_PARTICIPANTS = 8
"""Number of a domain's participants that are looked for."""


class ReservedDomain(Closing):
    """A domain that no other program of this computer uses, reserved until it is closed.

    An abstract Unix socket named after it stands for it, which the kernel lets go of when the process ends, however it
    ends. Network namespaces share neither these sockets nor the ports of DDS.

    :param candidates: numbers, in the order in which they are tried
    :ivar number: of the domain
    :raises MiddlewareError: when all are in use
    """

    def __init__(self, candidates: Iterable[int] = FREE) -> None:
        tried = 0
        for self.number in candidates:
            tried += 1
            self._reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                self._reservation.bind(f"\0gr-ros2-domain-{self.number}")
            except OSError:  # reserved by another process, or elsewhere in this one
                self._reservation.close()
                continue
            if _unused(self.number):
                return
            self._reservation.close()
        raise MiddlewareError(
            f"all {tried} ROS domains that a run may take are in use (`ss -xp | grep gr-ros2-domain` names the "
            "processes); set graph.domain_id of each robot"
        )

    def close(self) -> None:
        """Give the domain back. Idempotent."""
        self._reservation.close()


def _unused(number: int) -> bool:
    """Whether the domain and its first participants would get their ports (RTPS 2.5, section 9.6.2.3). Programs that
    are not gr-ros2 reserve nothing."""
    for port in (*_MULTICAST, *range(10, 10 + 2 * _PARTICIPANTS)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7400 + 250 * number + port))
            except OSError:
                return False
    return True


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
