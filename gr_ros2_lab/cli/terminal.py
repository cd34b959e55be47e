"""The picture of the paths in the terminal, for users who do not open the file."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

WIDTH, HEIGHT = 78, 22


def path_text(sent: npt.ArrayLike, received: npt.ArrayLike, title: str) -> str:
    """Transmitted path in blue, received in red over it, axes in metres, with terminal colours.

    :param sent: positions (x, y), m, shape (n, 2)
    :param received: the same, in the order of reception
    """
    import plotext  # many runs draw nothing

    plotext.clear_figure()
    plotext.plot_size(WIDTH, HEIGHT)
    plotext.theme("clear")
    plotext.title(title)
    for path, color in ((sent, "blue"), (received, "red")):
        xs, ys = np.asarray(path, dtype=float).reshape(-1, 2).T.tolist()
        if xs:
            plotext.scatter(xs, ys, color=color, marker="braille")
    return str(plotext.build())
