"""The figures of robots on one channel: its slots, who hears whom, and where each believes the others to be."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from gr_ros2.observe.colours import COLOURS, OUTCOME_COLOURS
from gr_ros2.observe.team import STRIP_S
from gr_ros2_lab.record.team import Team
from gr_ros2_lab.report.figures import panels


def strip_figure(team: Team) -> Figure:
    """The first seconds of the channel, in which all enter, and the last ones."""
    figure = Figure(figsize=(8.0, max(3.6, 1.2 + 0.25 * len(team.robots))), layout="constrained")
    first = team.sends[0].t if team.sends else 0.0
    last = team.sends[-1].t if team.sends else STRIP_S
    for axes, begin in zip(figure.subplots(2, 1), (first, max(first, last - STRIP_S)), strict=True):
        _strip(axes, team, begin)
    axes.set_xlabel("time [s]")
    handles = [Patch(color=colour, label=name) for name, colour in OUTCOME_COLOURS.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, fontsize="small", frameon=False)
    return figure


def _strip(axes: Axes, team: Team, begin: float) -> None:
    place = {robot: number for number, robot in enumerate(team.robots)}
    for name, colour in OUTCOME_COLOURS.items():
        shown = [s for s in team.sends if begin <= s.t < begin + STRIP_S and s.outcome(len(team.robots)) == name]
        rows = [place[send.robot] for send in shown]
        widths = [send.airtime_s for send in shown]
        axes.barh(rows, widths, left=[send.t for send in shown], height=0.8, color=colour)
    axes.set(xlim=(begin, begin + STRIP_S), yticks=range(len(place)))
    axes.set_yticklabels([f"robot {robot}" for robot in place], fontsize="small" if len(place) <= 8 else "xx-small")
    axes.invert_yaxis()


def hearing_figure(team: Team) -> Figure:
    """SNR over time of every pair, one axis for each receiver."""
    figure, every = panels(len(team.robots), same_scale=True)
    for axes, one in zip(every, team.robots, strict=True):
        for number, other in enumerate(team.robots):
            if one != other and team.snr_db[one, other]:
                t, snr = np.array(team.snr_db[one, other]).T
                axes.plot(t, snr, color=COLOURS[number % len(COLOURS)], label=f"robot {other}")
        axes.set_ylabel(f"robot {one} hears\n[dB]", fontsize="small")
    _legend(figure, team)
    return figure


def belief_figure(team: Team) -> Figure:
    """Where the robots drove, where the others believed them to be, and by how much that was wrong."""
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    there, wrong = figure.subplots(1, 2)
    for number, robot in enumerate(team.robots):
        colour = COLOURS[number % len(COLOURS)]
        if len(team.ways[robot]):
            _, x, y = np.array(team.ways[robot]).T
            there.plot(x, y, color=colour, linewidth=4, alpha=0.3)
        for other in team.robots:
            if robot != other and len(team.beliefs[other, robot]):
                t, x, y, error = np.array(team.beliefs[other, robot]).T
                there.plot(x, y, color=colour, linewidth=0.8)
                wrong.plot(t, error, color=colour, linewidth=0.8)
    there.set(title="driven (wide), believed by the others", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    wrong.set(title="by how much the others were wrong", xlabel="time [s]", ylabel="error [m]", ylim=(0, None))
    _legend(figure, team)
    return figure


def _legend(figure: Figure, team: Team) -> None:
    handles = [Patch(color=COLOURS[n % len(COLOURS)], label=f"robot {robot}") for n, robot in enumerate(team.robots)]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=min(len(handles), 8), fontsize="small", frameon=False
    )
