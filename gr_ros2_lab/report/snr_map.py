"""The map of a run whose levels follow from positions: SNR over the world, obstacles, and where the robots drove."""

from __future__ import annotations

from math import degrees
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from gr_ros2.observe.colours import COLOURS
from gr_ros2.settings.config import ScenarioChannel, build
from gr_ros2_lab.medium.positions import snr_map
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings

_EVERY_S = 0.5
_LONGEST_S = 120.0
"""s of the robots' ways that are drawn."""


def map_of(result: Result) -> Figure | None:
    """The map of a run; None where levels do not follow from positions in a simulated world."""
    config: dict[str, Any] = dict(result.config)
    if config.get("channel", {}).get("from") != "positions" or config.get("source") != "sim":
        return None
    fleet = Fleet.of(build(SimSettings, config["sim"]))
    times = np.arange(0.0, min(result.duration_s, _LONGEST_S) + _EVERY_S, _EVERY_S)
    ways = np.array([fleet.at(float(now), fleet.robot_ids)[0] for now in times])
    return snr_figure(build(ScenarioChannel, config["channel"]), fleet, ways, float(result.phy["sample_rate"]))


def snr_figure(channel: ScenarioChannel, fleet: Fleet, ways: Any, bandwidth: float) -> Figure:
    """SNR of what the first robot sends from where it set out.

    :param ways: where the robots were, m, shape (times, robots, 2)
    :param bandwidth: of the noise, Hz
    """
    world = fleet.world
    middles, snr_db = snr_map(channel, world, ways[0, 0], bandwidth)
    figure = Figure(figsize=(6.6, 5.6), layout="constrained")
    axes = figure.add_subplot(
        title="SNR of robot 1 from where it set out", xlabel="x [m]", ylabel="y [m]", aspect="equal"
    )
    shown = axes.pcolormesh(middles, middles, snr_db, cmap="viridis", shading="nearest", rasterized=True)
    figure.colorbar(shown, ax=axes, label="SNR [dB]")
    for x, y, half_x, half_y, angle in world.boxes:
        corner = (x - half_x, y - half_y)
        axes.add_patch(
            Rectangle(
                corner, 2 * half_x, 2 * half_y, angle=degrees(angle), rotation_point="center", fill=False, color="white"
            )
        )
    for x, y, radius in world.circles:
        axes.add_patch(Circle((x, y), radius, fill=False, color="white"))
    for number in range(ways.shape[1]):
        colour = COLOURS[number % len(COLOURS)]
        axes.plot(*ways[:, number].T, color=colour, linewidth=1.0, label=f"robot {number + 1}")
        axes.plot(*ways[0, number], marker="o", color=colour, markersize=5)
    axes.set_xlim(0, world.size)
    axes.set_ylim(0, world.size)
    if ways.shape[1] <= 8:
        figure.legend(loc="outside lower center", ncols=4, fontsize="small", frameon=False)
    return figure
