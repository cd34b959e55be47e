"""Path errors against shapes whose distance is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2_lab.record.recorder import path_error, rms_error

T = np.linspace(0, 10, 401)
LINE = np.column_stack([T, 2 * T])
ANGLE = np.linspace(0, 2 * np.pi, 2001)
CIRCLE = np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])


def test_identical_paths_have_no_error() -> None:
    assert path_error(CIRCLE, CIRCLE) == 0
    assert rms_error(T, LINE, T, LINE) == 0


def test_a_shifted_line_is_off_by_the_shift() -> None:
    shifted = LINE + np.array([3, 4])
    assert path_error(LINE, shifted) == pytest.approx(5)
    assert rms_error(T, LINE, T, shifted) == pytest.approx(5)


def test_subsampling_a_line_costs_nothing_and_a_curve_little() -> None:
    assert path_error(LINE, LINE[::50]) == pytest.approx(0, abs=1e-9)
    assert rms_error(T, LINE, T[::50], LINE[::50]) == pytest.approx(0, abs=1e-9)
    assert path_error(CIRCLE, CIRCLE[::20]) == pytest.approx(0, abs=0.01)


def test_a_larger_circle_is_off_by_the_difference_of_radii() -> None:
    assert path_error(CIRCLE, 1.5 * CIRCLE) == pytest.approx(0.5, rel=1e-3)


def test_a_delay_is_no_error_along_the_path_and_speed_times_delay_at_equal_times() -> None:
    assert path_error(LINE, LINE) == 0
    assert rms_error(T, LINE, T + 0.5, LINE) == pytest.approx(0.5 * np.sqrt(5))


def test_time_spent_standing_does_not_count() -> None:
    standing = np.vstack([LINE[:100], np.repeat(LINE[100:101], 500, axis=0), LINE[101:]])
    assert path_error(LINE, standing) == pytest.approx(0, abs=1e-9)


def test_a_single_point_and_no_point() -> None:
    assert path_error([[0, 0], [4, 0]], [[2, 0]]) == pytest.approx(1, rel=1e-2)
    assert path_error([[1, 1]], [[1, 1], [1, 1]]) == 0
    assert path_error([], LINE) is None
    assert path_error(LINE, []) is None
    assert rms_error([], [], T, LINE) is None
    assert rms_error(T, LINE, T + 100, LINE) is None


def test_height_does_not_count() -> None:
    assert path_error([[0, 0, 5], [1, 0, 9]], [[0, 0], [1, 0]]) == 0


_POINTS = st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=1, max_size=20)


@given(_POINTS, _POINTS)
def test_it_is_symmetric_and_finite(one: list[tuple[float, float]], other: list[tuple[float, float]]) -> None:
    error = path_error(one, other)
    assert error is not None
    assert np.isfinite(error)
    assert error == pytest.approx(path_error(other, one))
    assert path_error(one, one) == 0
