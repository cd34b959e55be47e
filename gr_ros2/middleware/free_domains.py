"""ROS domains that no other program of this computer uses, for runs that bring their own robots.

Invariants: a process reserves a domain before it uses one, with an abstract Unix socket named after it. The kernel lets
go of that socket when the process ends, however it ends. Network namespaces share neither these sockets nor the ports
of DDS.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable

from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import MiddlewareError

FIRST = 41
"""The domain that is tried first, so that a run alone on its computer always has the same."""
FREE = (*range(FIRST, 100), *range(1, FIRST), *range(215, 231))
"""Not the default 0. Their ports lie below and above those that the system hands out (32768 to 60999)."""
_MULTICAST = 0, 1
"""Ports of a domain that all its participants share: none can join where another program has one for itself."""
_PARTICIPANTS = 8
"""Number of a domain's participants that are looked for."""


class ReservedDomain(Closing):
    """A domain, reserved until it is closed.

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
