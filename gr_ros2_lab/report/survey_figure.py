"""The figure of a survey: where which SNR or loss was measured, over the map, and the path loss that fits it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.survey.table import Survey, SurveyRow

_MANY = 200
"""Points of the fitted curve."""


@dataclass(frozen=True, eq=False)
class GridPicture:
    """A map.

    :param occupied: -1 = not known, 0..100, rows of growing y
    :param resolution: m of a cell
    :param origin: of the first cell's corner, x and y in m
    """

    occupied: Floats
    resolution: float
    origin: tuple[float, float]


def survey_figure(survey: Survey, rows: Sequence[SurveyRow], grid: GridPicture | None = None) -> Figure:
    """What was measured over place, and over distance.

    :param grid: drawn below it
    """
    figure = Figure(figsize=(10.5, 4.8), layout="constrained")
    places, along = figure.subplots(1, 2)
    places.set(title="Where it was measured", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    if grid is not None:
        height, width = np.array(grid.occupied.shape) * grid.resolution
        left, bottom = grid.origin
        shades = np.where(grid.occupied < 0, 0.85, 1 - grid.occupied / 100)
        extent = (left, left + width, bottom, bottom + height)
        places.imshow(shades, cmap="gray", vmin=0, vmax=1, extent=extent, origin="lower", interpolation="nearest")
    places.plot([row.x_m for row in rows], [row.y_m for row in rows], color="0.6", linewidth=0.6, zorder=1)
    levels = survey.has_snr
    values, label = (survey.snr_db, "SNR [dB]") if levels else (survey.loss, "packets lost")
    known = np.isfinite(values)
    colours = "viridis" if levels else "viridis_r"
    shown = places.scatter(*survey.ends[known, :2].T, c=values[known], cmap=colours, s=16, zorder=2)
    lost = survey.packets == 0
    places.scatter(*survey.ends[lost, :2].T, marker="x", color="tab:red", s=20, zorder=3, label="nothing arrived")
    places.plot(*survey.ends[0, 2:], marker="^", color="black", linestyle="", label="robot heard")
    figure.colorbar(shown, ax=places, label=label)
    along.set(title="Over distance", xlabel="distance [m]", ylabel=label, xscale="log")
    along.scatter(np.maximum(survey.apart[known], 1e-1), values[known], s=10)
    try:
        distances = np.geomspace(max(survey.apart.min(), 1.0), max(survey.apart.max(), 2.0), _MANY)
        if levels:
            line, fitted = survey.path_loss, survey.path_loss.at(distances)
            name = f"exponent {line.exponent:.2f} ± {2 * line.slope_error:.2f}, {line.rms:.1f} dB rms"
        else:
            fitted, name = 1 / (1 + np.exp(survey.loss_line.at(distances))), "fitted"
        along.plot(distances, fitted, color="tab:orange", label=name)
    except ConfigError:
        pass  # it tells no path loss, which the command says
    for axes in (places, along):
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize="small")
    return figure
