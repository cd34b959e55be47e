"""DDS domains and ports that only one test process of a machine uses, also when several suites run at once, see
:mod:`gr_ros2_lab.run.domains`."""

from __future__ import annotations

import random
import socket
from contextlib import suppress
from itertools import cycle, islice

from gr_ros2_lab.run.domains import FREE, ReservedDomain

_DOMAINS = FREE
_PORTS = 250
"""Of a domain (RTPS 2.5, section 9.6.2.3)."""
_order = cycle(random.Random().sample(_DOMAINS, len(_DOMAINS)))
_own: dict[int, ReservedDomain] = {}
_OF_PORTS = -1
_lent: list[ReservedDomain] = []
_ports = cycle(range(_PORTS))


def domain(offset: int = 0) -> int:
    """A domain of this process's own: the same one for an offset as long as the process lives."""
    if offset not in _own:
        _own[offset] = _reserve()
    return _own[offset].number


def free_domains(count: int = 2) -> list[int]:
    """Domains for one test, which nobody else uses until :func:`give_back`."""
    found = [_reserve() for _ in range(count)]
    _lent.extend(found)
    return [reserved.number for reserved in found]


def give_back() -> None:
    """What :func:`free_domains` handed out may be used again; at the end of each test."""
    while _lent:
        _lent.pop().close()


def free_ports(count: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[int]:
    """Ports for one test: those of a domain that this process keeps and never opens.

    So no other test is there, nor a program that asks for any port (those are from 32768 on), and none is handed out
    again before all others were. Below port 49152, where direwolf's must be.
    """
    if _OF_PORTS not in _own:
        _own[_OF_PORTS] = ReservedDomain(number for number in islice(_order, len(_DOMAINS)) if number < 100)
    first = 7400 + 250 * domain(_OF_PORTS)
    found: list[int] = []
    for port in islice(_ports, _PORTS):
        with suppress(OSError), socket.socket(socket.AF_INET, kind) as one:
            one.bind(("", first + port))
            found.append(first + port)
        if len(found) == count:
            return found
    raise OSError(f"{count} of the ports from {first} on are wanted, {len(found)} are free")


def _reserve() -> ReservedDomain:
    return ReservedDomain(islice(_order, len(_DOMAINS)))
