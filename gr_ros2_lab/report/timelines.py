"""The figures of an experiment over time: delivery, age, airtime, and the first packets one by one.

Invariants: times are s since submission began; a figure with no data says so and is never empty; an interval in which
nothing was sent has no PDR.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from gr_ros2.core.arrays import Floats
from gr_ros2.observe.colours import COLOURS
from gr_ros2_lab.record.metrics import age_sawtooth
from gr_ros2_lab.record.trace import Ints, Messages, Packets
from gr_ros2_lab.report.figures import panels

_BINS = 40
"""Approximate number of intervals into which a run is divided."""
_FIRST_S, _FIRST_PACKETS = 2.0, 150
"""Limits of the packets that are drawn one by one: the first s of sending, and the number of packets."""
_FAR_APART = 10
"""If the peak ages of runs differ by more than this factor, their common axis is logarithmic."""
_LOST = "#d62728"


@dataclass(frozen=True)
class Deliveries:
    """The data for delivery over time: times (NaN where there is none) and size of every message."""

    t_sent: Floats
    t_delivered: Floats
    size: Ints

    @staticmethod
    def of(messages: Sequence[Messages]) -> Deliveries:
        """The data of one or several topics. A message refused before it was queued gets the time of the message
        before."""
        if not messages:
            return Deliveries(np.empty(0), np.empty(0), np.empty(0, dtype=np.int64))
        order = np.argsort(np.concatenate([m.serial for m in messages]), kind="stable")
        return Deliveries(
            _carried_on(np.concatenate([m.t_sent for m in messages])[order]),
            np.concatenate([m.t_delivered for m in messages])[order],
            np.concatenate([m.size for m in messages])[order],
        )


def delivery_figure(lines: Mapping[str, Deliveries], duration_s: float, changes: Sequence[float] = ()) -> Figure:
    """PDR by time of submission, and goodput by time of delivery, in intervals of equal length.

    :param lines: name -> its messages, one topic or one run each
    :param duration_s: s during which messages were submitted
    :param changes: s at which somebody changed something
    """
    figure = Figure(figsize=(8.0, 5.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    end = max(
        [duration_s, 1e-3, *(_latest(times) for line in lines.values() for times in (line.t_sent, line.t_delivered))]
    )
    width = nice_step(max(duration_s, 1e-3) / _BINS)
    edges = np.arange(0, end + width, width)
    middles = (edges[:-1] + edges[1:]) / 2
    for place, ((name, line), colour) in enumerate(zip(lines.items(), cycle(COLOURS))):
        done = ~np.isnan(line.t_delivered)
        sent, _ = np.histogram(line.t_sent, edges)
        delivered, _ = np.histogram(line.t_sent[done], edges)
        some = sent > 0
        # The first lines are the widest, so that all lines are visible where they overlap.
        wide = 1.2 + 0.8 * (len(lines) - 1 - place)
        mark = {"marker": ".", "markersize": 4 + wide}
        above.plot(middles[some], delivered[some] / sent[some], color=colour, linewidth=wide, label=name, **mark)
        bytes_, _ = np.histogram(line.t_delivered[done], edges, weights=line.size[done])
        below.step(edges, np.append(bytes_, bytes_[-1:]) / width / 1000, where="post", color=colour, linewidth=1.5)
    above.set(title="Delivery over time", ylabel="PDR", ylim=(-0.04, 1.06))
    below.set(ylabel="goodput [kB/s]", xlabel=f"time [s], in intervals of {width:g} s", ylim=(0, None), xlim=(0, end))
    for axes in (above, below):
        axes.grid(alpha=0.3)
        axes.axvline(duration_s, color="0.5", linewidth=0.8, linestyle=":")
        _mark(axes, changes)
    _legend(figure, above, lines)
    return figure


def age_figure(
    topics: Mapping[str, Mapping[str, Messages]], t_end: Mapping[str, float], changes: Sequence[float] = ()
) -> Figure:
    """Age of information: a panel per topic with a sawtooth per run.

    :param topics: panel name -> line name -> messages
    :param t_end: s, end of the observation by line name
    :param changes: s at which somebody changed something
    """
    names = list(dict.fromkeys(name for lines in topics.values() for name in lines))
    figure, every = panels(len(topics))
    figure.suptitle("Age of the newest message delivered", fontsize="large")
    for axes, (panel, lines) in zip(every, topics.items(), strict=False):
        peaks = []
        for name, messages in lines.items():
            done = messages.delivered
            start, until, newest = age_sawtooth(messages.t_sent[done], messages.t_delivered[done], t_end[name])
            t = np.column_stack([start, until]).ravel()
            age = np.column_stack([start - newest, until - newest]).ravel()
            axes.plot(t, age, color=COLOURS[names.index(name) % len(COLOURS)], linewidth=0.9, label=name)
            peaks += [float(age.max())] if len(age) else []
        axes.set_ylabel("age [s]")
        axes.set_title(panel, fontsize="small", loc="left", pad=3)
        axes.grid(alpha=0.3)
        if peaks and max(peaks) > _FAR_APART * min(peaks) > 0:
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        _mark(axes, changes)
        if not peaks:
            axes.text(0.5, 0.5, "nothing was delivered", ha="center", va="center", transform=axes.transAxes)
    every[-1].set_xlim(0, max(t_end.values(), default=1.0) or 1.0)
    if len(names) > 1:
        _legend(figure, every[0], names)
    return figure


def airtime_figure(packets: Packets, airtime_s: float, duration_s: float, changes: Sequence[float] = ()) -> Figure:
    """Airtime per time of the packets that left the source, and of those that arrived.

    :param airtime_s: s, of one packet on average
    :param duration_s: s during which messages were submitted
    :param changes: s at which somebody changed something
    """
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.add_subplot(title="Use of the air", ylabel="airtime per time [%]")
    t_sent, t_received = packets.times()
    end = max(duration_s, 1e-3, _latest(t_sent), _latest(t_received))
    width = nice_step(max(duration_s, 1e-3) / _BINS)
    # An interval must be longer than a few packets. Otherwise the figure shows rounding effects and not the load.
    width = max(width, nice_step(5 * airtime_s))
    edges = np.arange(0, end + width, width)
    for times, name, colour, alpha in (
        (t_sent, "packets that left the source", COLOURS[1], 0.35),
        (t_received, "packets that arrived", COLOURS[0], 0.6),
    ):
        load = np.histogram(times[~np.isnan(times)], edges)[0] * airtime_s / width * 100
        axes.stairs(load, edges, color=colour, fill=True, alpha=alpha)
        axes.stairs(load, edges, color=colour, label=name)
    axes.axhline(100, color="black", linewidth=1, linestyle="--", label="all the air there is")
    axes.axvline(duration_s, color="0.5", linewidth=0.8, linestyle=":")
    _mark(axes, changes)
    axes.set(xlabel=f"time [s], in intervals of {width:g} s", xlim=(0, end), ylim=(0, None))
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    return figure


def packets_figure(packets: Packets, topics: Sequence[str]) -> Figure:
    """The first packets since messages are submitted, one by one: which entries of which topic each carries (above),
    when it left, and when or whether it arrived (below).

    :param topics: their names in the order of their colours
    """
    figure = Figure(figsize=(11.0, 5.4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    t_sent, t_received = packets.times()
    before = int(np.searchsorted(t_sent, 0.0))
    t_sent, t_received = t_sent[before:], t_received[before:]
    shown = int(min(np.searchsorted(t_sent, t_sent[0] + _FIRST_S), _FIRST_PACKETS)) if len(t_sent) else 0
    if not shown:
        above.text(0.5, 0.5, "no packet was sent", ha="center", transform=above.transAxes)
        return figure
    entry = (packets.packet >= before) & (packets.packet < before + shown)
    number = packets.packet[entry] - before
    names = list(dict.fromkeys([*topics, *packets.topic.tolist()]))
    codes = np.array([names.index(topic) for topic in packets.topic[entry]])
    heights = np.zeros(shown)
    blocks, colours, edges = [], [], []
    for at, code, serial in zip(number, codes, packets.serial[entry], strict=True):
        blocks.append(Rectangle((at - 0.45, heights[at]), 0.9, 1))
        colours.append(COLOURS[code % len(COLOURS)])
        # Consecutive messages have different shades, so that their fragments can be distinguished.
        edges.append((0, 0, 0, 0.0) if serial % 2 else (1, 1, 1, 0.35))
        heights[at] += 1
    above.add_collection(PatchCollection(blocks, facecolor=colours, edgecolor="white", linewidth=0.4))
    above.add_collection(PatchCollection(blocks, facecolor=edges, edgecolor="none"))
    arrived = ~np.isnan(t_received[:shown])
    places = np.arange(shown)
    lost = places[~arrived]
    above.plot(lost, np.full(len(lost), -0.05 * heights.max()), "x", color=_LOST, markersize=4)
    above.set(ylabel="entries of the packet", xlim=(-1, shown), ylim=(-0.1 * heights.max(), heights.max() * 1.05))
    above.set_yticks(np.arange(0, heights.max() + 1, max(1, heights.max() // 5)))
    above.set_title(f"The first {shown} of {len(t_sent):,} packets", loc="left")
    below.add_collection(
        LineCollection(
            [[(at, t_sent[at]), (at, t_received[at])] for at in places[arrived]], colors="0.7", linewidths=0.8
        )
    )
    below.plot(places, t_sent[:shown], ".", color="0.2", markersize=4)
    below.plot(places[arrived], t_received[:shown][arrived], ".", color=COLOURS[0], markersize=4)
    below.plot(lost, t_sent[lost], "x", color=_LOST, markersize=5)
    below.set(xlabel="packets in the order in which they left", ylabel="time [s]")
    below.grid(alpha=0.3)
    keys: list[Patch | Line2D] = [
        Patch(color=COLOURS[code % len(COLOURS)], label=names[code]) for code in sorted(set(codes.tolist()))
    ]
    for label, mark, colour in (("left", ".", "0.2"), ("arrived", ".", COLOURS[0]), ("did not arrive", "x", _LOST)):
        keys.append(Line2D([], [], linestyle="none", marker=mark, color=colour, label=label))
    figure.legend(handles=keys, loc="outside lower center", ncols=min(len(keys), 6), fontsize="small", frameon=False)
    return figure


def _mark(axes: Axes, changes: Sequence[float]) -> None:
    """Draw when somebody changed something, as the dashboard does."""
    for at in changes:
        axes.axvline(at, color="0.4", linewidth=0.9, linestyle="--")


def nice_step(at_least: float) -> float:
    """The smallest of … 0.1, 0.2, 0.5, 1, 2, 5, 10 … that is not smaller than ``at_least``.

    :param at_least: above 0
    """
    power = 10.0 ** np.floor(np.log10(at_least))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= at_least * (1 - 1e-9)))


def _latest(times: Floats) -> float:
    """The latest time that is not NaN, at least 0."""
    return float(np.max(times, initial=0.0, where=~np.isnan(times)))


def _carried_on(times: Floats) -> Floats:
    """NaN replaced by the number before it, 0 at the beginning."""
    known = np.where(np.isnan(times), -1, np.arange(len(times)))
    last = np.maximum.accumulate(known)
    return np.where(last >= 0, times[last], 0.0)


def _legend(figure: Figure, axes: Axes, names: Sequence[str] | Mapping[str, object]) -> None:
    if names:
        handles, labels = axes.get_legend_handles_labels()
        columns = 2 if max(map(len, labels), default=0) > 30 else min(len(labels), 4)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns or 1, fontsize="small", frameon=False)
