"""The computed curves at points that stand in textbooks."""

from __future__ import annotations

import numpy as np
import pytest

from gr_ros2.phy.theory import (
    at_least,
    coded_orthogonal_success,
    convolutional_success,
    half_point,
    orthogonal_symbol_error,
    packet_success,
    psk_symbol_error,
    qam_bit_error,
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


def test_a_gray_coded_symbol_error_is_mostly_one_bit() -> None:
    assert qam_bit_error(1, ratio(9.59)) == pytest.approx(1e-5, rel=0.05)
    assert qam_bit_error(2, ratio(10)) == pytest.approx(psk_symbol_error(4, ratio(10)) / 2, rel=0.01)
    for bits, db in ((4, 18), (6, 24)):
        assert qam_bit_error(bits, ratio(db)) == pytest.approx(qam_symbol_error(2**bits, ratio(db)) / bits, rel=0.02)


@pytest.mark.parametrize("error", [0.045, 0.055])
def test_the_convolutional_code_decodes_as_often_as_computed(error: float) -> None:
    fec = pytest.importorskip("gr_ros2.phy.fec", reason="needs GNU Radio 3.10")
    code, draw, right = fec.Codes("cc").of(400), np.random.default_rng(1), 0
    for _ in range(400):
        bits = draw.integers(0, 2, 400).astype(np.uint8)
        wrong = draw.random(code.coded_bits) < error
        hard = 2.0 * (code.encode(bits) ^ wrong) - 1
        right += np.array_equal(code.decode(hard.astype(np.float32)), bits)
    share = right / 400
    assert convolutional_success((1, 2), error, 400) < share + 0.06, "a bound"
    assert convolutional_success((1, 2), 0.75 * error, 400) > share - 0.06, "that costs less than a decibel"


def test_punctured_codes_decode_less_and_a_fraction_need_not_be_reduced() -> None:
    shares = [convolutional_success(rate, 0.005, 800) for rate in ((1, 2), (2, 3), (3, 4))]
    assert shares == sorted(shares, reverse=True)
    assert convolutional_success((24, 48), 0.03, 800) == convolutional_success((1, 2), 0.03, 800)
    assert convolutional_success((3, 4), 0.5, 800) == 0.0
    assert convolutional_success((3, 4), 0.0, 800) == 1.0


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
