"""Benches check what they stand on: a row of 15 packets counts 15 packets."""

from __future__ import annotations

import pytest

pytest.importorskip("gnuradio")

from bench import port


def test_messages_of_the_port_leave_in_the_packets_that_the_row_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port, "PACKETS", 1500)
    assert port.blocks_rate(port.ODOMETRY_BYTES, 15) > 0
    assert port.blocks_rate(port.SMALL_BYTES, 1) > 0


def test_a_row_whose_packets_were_compressed_away_ends_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port, "PACKETS", 1500)
    monkeypatch.setattr(port, "AS_IT_IS", {})
    with pytest.raises(SystemExit, match="100 messages of 15 packets arrived in"):
        port.blocks_rate(port.ODOMETRY_BYTES, 15)
