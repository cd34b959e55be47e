"""DDS domains that only one test process of a machine uses, also when several suites run at once.

Invariants: a process reserves a domain before it uses one, with an abstract Unix socket named after it. The kernel lets
go of that socket when the process ends, however it ends. Network namespaces share neither these sockets nor the ports
of DDS.
"""

from __future__ import annotations

import random
import socket
from itertools import cycle, islice

_DOMAINS = (*range(1, 100), *range(215, 231))
"""Not the default 0; their ports lie below and above those the system hands out (32768 to 60999)."""
_PARTICIPANTS = 8
"""So many of a domain are looked for."""

_order = cycle(random.Random().sample(_DOMAINS, len(_DOMAINS)))
_own: dict[int, tuple[int, socket.socket]] = {}
_lent: list[socket.socket] = []


def domain(offset: int = 0) -> int:
    """A domain of this process's own: the same one for an offset as long as the process lives."""
    if offset not in _own:
        _own[offset] = _reserve()
    return _own[offset][0]


def free_domains(count: int = 2) -> list[int]:
    """Domains for one test, which nobody else uses until :func:`give_back`."""
    found = [_reserve() for _ in range(count)]
    _lent.extend(reservation for _, reservation in found)
    return [number for number, _ in found]


def give_back() -> None:
    """What :func:`free_domains` handed out may be used again; at the end of each test."""
    while _lent:
        _lent.pop().close()


def _reserve() -> tuple[int, socket.socket]:
    for number in islice(_order, len(_DOMAINS)):
        reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            reservation.bind(f"\0gr-ros2-tests-domain-{number}")
        except OSError:  # of another process
            reservation.close()
            continue
        if _unused(number):
            return number, reservation
        reservation.close()
    raise RuntimeError(
        f"all {len(_DOMAINS)} DDS domains for tests are in use; `ss -xp | grep gr-ros2-tests` says by whom"
    )


def _unused(number: int) -> bool:
    """Whether a domain's first participants would have their ports: programs that are no tests reserve nothing."""
    for participant in range(_PARTICIPANTS):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7400 + 250 * number + 10 + 2 * participant))
            except OSError:
                return False
    return True
