"""DDS domains of tests belong to one process at a time."""

from __future__ import annotations

import socket
from itertools import cycle

import pytest

from gr_ros2.core.errors import MiddlewareError
from tests import domains
from tests.domains import domain, free_domains, give_back


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


def test_a_domain_that_a_program_uses_is_not_handed_out(monkeypatch: pytest.MonkeyPatch) -> None:
    (number,) = free_domains(1)
    give_back()
    only(monkeypatch, number)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("", 7400 + 250 * number + 12))  # its second participant
        with pytest.raises(MiddlewareError, match="in use"):
            free_domains(1)


def test_a_process_keeps_its_own() -> None:
    own = {domain(), domain(1)}
    give_back()
    assert {domain(0), domain(1)} == own
    assert len(own) == 2
    assert not own & set(free_domains(3))
