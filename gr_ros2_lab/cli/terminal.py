"""The picture of the paths in the terminal, for users who do not open the file."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

WIDTH, HEIGHT = 78, 22
_DOTS = 2 * (WIDTH - 8), 4 * (HEIGHT - 4)
"""Dots of the area between the axes, which are as far apart both ways."""
_MARKS = 30
"""Marks of the received path."""


def path_text(sent: npt.ArrayLike, received: npt.ArrayLike, title: str) -> str:
    """Transmitted path as blue dots, received as red crosses, axes in metres and of one scale, with terminal colours.

    :param sent: positions (x, y), m, shape (n, 2)
    :param received: the same, in the order of reception
    """
    import plotext  # many runs draw nothing

    plotext.clear_figure()
    plotext.plot_size(WIDTH, HEIGHT)
    plotext.theme("clear")
    plotext.title(title)
    paths = [np.asarray(path, dtype=float).reshape(-1, 2) for path in (sent, received)]
    together = np.concatenate(paths)
    if len(together):
        middle = (together.min(0) + together.max(0)) / 2
        dot_m = max(float((np.ptp(together, axis=0) / _DOTS).max()), 1e-3)
        (left, low), (right, high) = middle - dot_m * np.array(_DOTS) / 2, middle + dot_m * np.array(_DOTS) / 2
        plotext.xlim(left, right)
        plotext.ylim(low, high)
    fewer = paths[1][:: max(len(paths[1]) // _MARKS, 1)]
    for path, color, marker in ((paths[0], "blue", "braille"), (fewer, "red", "x")):
        if len(path):
            plotext.scatter(*path.T.tolist(), color=color, marker=marker)
    return str(plotext.build())
