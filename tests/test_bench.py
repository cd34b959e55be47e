"""Benches check what they stand on: a row of 15 packets counts 15 packets."""

from __future__ import annotations

import pytest

from bench import gate, port, rates
from bench.rows import Row


def test_messages_of_the_port_leave_in_the_packets_that_the_row_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port, "PACKETS", 1500)
    assert port.blocks_rate(port.ODOMETRY_BYTES, 15) > 0
    assert port.blocks_rate(port.SMALL_BYTES, 1) > 0


def test_a_row_whose_packets_were_compressed_away_ends_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port, "PACKETS", 1500)
    monkeypatch.setattr(port, "AS_IT_IS", {})
    with pytest.raises(SystemExit, match="100 messages of 15 packets arrived in"):
        port.blocks_rate(port.ODOMETRY_BYTES, 15)


def test_ages_beside_messages_that_were_compressed_away_end_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rates, "SECONDS", 6.0)
    monkeypatch.setattr(rates, "SEEDS", [0])
    assert rates.ages({rates.NEAR: 30.0}, rates.SAMPLE_RATE)[rates.NEAR][rates.ODOM] > 0
    monkeypatch.setattr(rates, "COMPRESSION", True)
    with pytest.raises(SystemExit, match="messages leave in"):
        rates.ages({rates.NEAR: 30.0}, rates.SAMPLE_RATE)


def test_the_gate_misses_what_has_become_twice_as_bad(monkeypatch: pytest.MonkeyPatch) -> None:
    told = [
        Row("share", 0.4, sense="≥", target=0.9),
        Row("cost", 21.0, sense="≤", target=10.0),
        Row("altered", 1.0, sense="=", target=0.0),
        Row("a little slower", 15.0, sense="≤", target=10.0),
        Row("a figure", 1.0),
    ]
    monkeypatch.setattr(gate, "_QUICK", (lambda: told,))
    assert [(row.what, row.met) for row in gate.gate()] == [
        ("share", False),
        ("cost", False),
        ("altered", False),
        ("a little slower", True),
    ]
