"""The computed curves at points that stand in textbooks."""

from __future__ import annotations

import pytest

from gr_ros2.phy.theory import (
    at_least,
    coded_orthogonal_success,
    half_point,
    orthogonal_symbol_error,
    packet_success,
    psk_symbol_error,
    qam_symbol_error,
)


def ratio(db: float) -> float:
    return 10 ** (db / 10)


def test_bpsk_needs_9_6_db_for_one_error_in_100000() -> None:
    assert psk_symbol_error(2, ratio(9.59)) == pytest.approx(1e-5, rel=0.05)


def test_qpsk_and_4_qam_are_the_same() -> None:
    assert psk_symbol_error(4, ratio(10)) == pytest.approx(qam_symbol_error(4, ratio(10)), rel=1e-9)


def test_two_orthogonal_signals_have_the_closed_form() -> None:
    for db in (0, 5, 10):
        assert orthogonal_symbol_error(2, ratio(db)) == pytest.approx(0.5 * 2.718281828 ** (-ratio(db) / 2), rel=1e-3)


def test_packets_and_half_points() -> None:
    assert packet_success(0.5, 2) == pytest.approx(0.25)
    assert packet_success(1.0, 2) == 0.0
    assert at_least(1, 8, 0.1) == pytest.approx(1 - 0.9**8)
    assert at_least(2, 8, 0.0) == 0.0
    assert at_least(2, 8, 1.0) == 1.0
    assert half_point(lambda db: float(db > 3.0)) == pytest.approx(3.0, abs=0.01)


def test_chirps_that_are_always_right_carry_all_their_bits_and_blind_guesses_none() -> None:
    assert coded_orthogonal_success(128, 1e-9, 690, 100) > 0.999
    assert coded_orthogonal_success(128, 1e-9, 720, 100) < 0.001
    assert coded_orthogonal_success(128, 127 / 128, 50, 100) < 0.001
