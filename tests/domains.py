"""DDS domains that only one test process of a machine uses, also when several suites run at once, see
:mod:`gr_ros2.middleware.free_domains`."""

from __future__ import annotations

import random
from itertools import cycle, islice

from gr_ros2.middleware.free_domains import FREE, ReservedDomain

_DOMAINS = FREE
_order = cycle(random.Random().sample(_DOMAINS, len(_DOMAINS)))
_own: dict[int, ReservedDomain] = {}
_lent: list[ReservedDomain] = []


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


def _reserve() -> ReservedDomain:
    return ReservedDomain(islice(_order, len(_DOMAINS)))
