"""DDS domains of tests belong to one process at a time."""

from __future__ import annotations

import socket
from itertools import cycle
from pathlib import Path

import pytest

from gr_ros2.core.errors import MiddlewareError
from tests import domains
from tests.domains import domain, free_domains, free_ports, give_back


def only(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(domains, "_DOMAINS", (number,))
    monkeypatch.setattr(domains, "_order", cycle([number]))


def test_a_domain_is_handed_out_again_only_when_it_was_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    (number,) = free_domains(1)
    only(monkeypatch, number)
    with pytest.raises(MiddlewareError, match="in use"):
        free_domains(1)
    give_back()
    assert free_domains(1) == [number]


@pytest.mark.parametrize("port", [0, 12], ids=["of all participants", "of the second"])
def test_a_domain_that_a_program_uses_is_not_handed_out(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    (number,) = free_domains(1)
    give_back()
    only(monkeypatch, number)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("", 7400 + 250 * number + port))
        with pytest.raises(MiddlewareError, match="in use"):
            free_domains(1)


def test_a_process_keeps_its_own() -> None:
    own = {domain(), domain(1)}
    give_back()
    assert {domain(0), domain(1)} == own
    assert len(own) == 2
    assert not own & set(free_domains(3))


def test_ports_are_one_process_s_own_and_no_program_gets_one_without_asking(monkeypatch: pytest.MonkeyPatch) -> None:
    own, more = free_ports(2), free_ports(100, socket.SOCK_STREAM)
    assert not set(own) & set(more)
    monkeypatch.setattr(domains, "_own", {})  # another process has none yet
    others = free_ports(100)
    assert {(port - 7400) // 250 for port in others}.isdisjoint((port - 7400) // 250 for port in own + more)
    lowest = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    assert max(*own, *more, *others) < lowest
