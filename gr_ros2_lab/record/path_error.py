"""How far a received path is from the transmitted one.

Invariants: distances are metres in the plane (x, y); a path with no points has no error (None); a path with one point,
or with length 0, is treated as that point everywhere.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gr_ros2.core.arrays import Floats

GRID_POINTS = 1000
"""Points of the common grid, ends included."""


def path_error(sent: npt.ArrayLike, received: npt.ArrayLike) -> float | None:
    """Mean distance of both paths, m, after interpolation to a common arc-length grid (0..1 of each path's length).

    Time has no effect: a path that is received late or subsampled has no error as long as it follows the same line
    (the paper, section 6).

    :param sent: positions, shape (n, 2) or wider; only the first two columns count
    :param received: likewise, in the order of reception
    """
    one, other = _plane(sent), _plane(received)
    if not len(one) or not len(other):
        return None
    grid = np.linspace(0.0, 1.0, GRID_POINTS)
    return float(np.linalg.norm(_along(one, grid) - _along(other, grid), axis=1).mean())


def rms_error(
    t_sent: npt.ArrayLike,
    sent: npt.ArrayLike,
    t_received: npt.ArrayLike,
    received: npt.ArrayLike,
) -> float | None:
    """RMS distance at equal times, m. Both paths are linear between their points; only the time they share counts.

    Unlike :func:`path_error` this grows with latency: it shows how wrong the position known to the receiver is.

    :param t_sent: s, when each transmitted position was submitted
    :param t_received: s on the same clock, when each received position was delivered
    :return: None where the paths share no time
    """
    (t_one, one), (t_other, other) = _timed(t_sent, sent), _timed(t_received, received)
    if not len(one) or not len(other):
        return None
    start, end = max(t_one[0], t_other[0]), min(t_one[-1], t_other[-1])
    if start > end:
        return None
    times = np.linspace(start, end, GRID_POINTS)
    apart = _interpolate(times, t_one, one) - _interpolate(times, t_other, other)
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def _plane(path: npt.ArrayLike) -> Floats:
    positions = np.asarray(path, dtype=float)
    return positions.reshape(len(positions), -1)[:, :2] if positions.size else np.empty((0, 2))


def _timed(times: npt.ArrayLike, path: npt.ArrayLike) -> tuple[Floats, Floats]:
    t, positions = np.asarray(times, dtype=float), _plane(path)
    order = np.argsort(t, kind="stable")
    return t[order], positions[order]


def _along(path: Floats, grid: Floats) -> Floats:
    """Positions at fractions of the path's length."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    moved = np.append(True, steps > 0)  # np.interp requires an increasing arc length
    length = np.append(0.0, np.cumsum(steps))[moved]
    return _interpolate(grid * length[-1], length, path[moved])


def _interpolate(at: Floats, known: Floats, path: Floats) -> Floats:
    return np.column_stack([np.interp(at, known, path[:, 0]), np.interp(at, known, path[:, 1])])
