"""The page of one viewer: Bokeh models that are made once and get new data with every snapshot.

Invariants: the page only draws, and passes the viewer's settings to the monitor. Data is replaced and never appended,
so a page is as large after an hour as after a minute. A viewer who cannot keep up gets fewer pictures, not a queue of
them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.core.properties import Int, String
from bokeh.document import Document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.layouts import column
from bokeh.model import DataModel
from bokeh.models import (
    Checkbox,
    ColumnDataSource,
    CustomJS,
    DataRange1d,
    Div,
    FixedTicker,
    HoverTool,
    InlineStyleSheet,
    LogAxis,
    NumeralTickFormatter,
    Range1d,
    Slider,
    Toggle,
    VSpan,
)
from bokeh.plotting import figure
from jinja2 import Environment, FileSystemLoader

from gr_ros2.dashboard.asked_card import AskedCard
from gr_ros2.dashboard.monitor import RadioView, RunMonitor
from gr_ros2.dashboard.tables import (
    alarms_html,
    colour,
    counters_html,
    heard_html,
    packets_html,
    paths_html,
    state_text,
    team_html,
    tiles_html,
    topics_html,
)
from gr_ros2.dashboard.views import GOOD, Snapshot
from gr_ros2.observe.colours import AIR_COLOURS, OUTCOME_COLOURS
from gr_ros2.observe.team import STRIP_S, TeamView
from gr_ros2.settings.config import ChannelConfig

AHEAD = 3
"""When a viewer is this number of pictures behind, it gets no new one."""
CURVES_EVERY = 2
"""Pictures of which one has new curves: they show minutes, and to draw them is most of what an open page costs a
browser."""

_TEMPLATES = Path(__file__).parent / "templates"
_SENT, _RECEIVED = "#3b82d6", "#d62728"
"""Of lines that are seen on a bright and on a dark page."""
_SOFT = "#7a8a9a"
"""Of lines beside them. Words have the page's own grey, see ``page.js``."""
_DEFAULT_SNR_DB = 20.0
_IN_LEGEND = 6
"""Most robots that a legend names; of more, the numbers on the map do."""
_FIRST = {"pdr", "loss", "age", "air"}
"""Cards that say what they wait for. Who observes one end of a link alone never knows how much is delivered, and a PHY
may take no air."""
_SENDS, _SILENT = "stop sending", "sending is off: send again"


class PictureCounter(DataModel):  # type: ignore[misc]
    """Counts pictures at both ends, so that the server knows how far behind a viewer is."""

    drawn = Int(0)
    seen = Int(0)
    empty = String("")
    """Cards that are hidden since they have nothing to show, separated by spaces."""
    waits = String("")
    """Cards that say what they wait for, likewise."""
    old = String("")
    """Cards that show what was received some time ago, likewise."""
    ago = String("")
    """How long ago that was, '' where it is new."""
    said = String("")
    """State and alarms, which a screen reader says when they change."""


class LivePage:
    """The models of one document.

    :param instance: identifies the server, so that the browser notices when another server answers
    """

    def __init__(self, document: Document, monitor: RunMonitor, instance: str) -> None:
        self.document = document
        self._monitor = monitor
        self._counter = PictureCounter(name="pulse")
        self._counter.js_on_change("drawn", CustomJS(args={"pulse": self._counter}, code="pulse.seen = pulse.drawn"))
        self._style = style = InlineStyleSheet(css=(_TEMPLATES / "parts.css").read_text("utf-8"))
        self._html = {
            name: Div(name=name, stylesheets=[style], sizing_mode="stretch_width", disable_math=True)
            for name in ("tiles", "counters", "alarms", "topics", "heard", "team", "paths", "seen", "packets", "note")
        }
        self._sources = {
            name: ColumnDataSource({key: [] for key in columns.split()})
            for name, columns in {
                "series": "name colour t pdr goodput age queued",
                "sent": "name x y",
                "received": "name x y",
                "gap": "x y",
                "picture": "image x y dw dh",
                "grid": "image x y dw dh",
                "ends": "x y colour",
                "error": "name colour t m",
                "latency": "name colour ms share",
                "constellation": "re im",
                "spectrum": "khz db",
                "air": "t new repair report hello",
                "snr": "t db",
                "loss": "t share",
                "changes": "t",
                "strip": "left right robot colour",
                "places": "x y colour robot name",
                "beliefs": "x y colour",
            }.items()
        }
        self._html["tiles"].tags = [self._counter]  # it has no place on the page, but must be in the document
        self._shown: ChannelConfig | None = None
        self._following = False
        self._ready = False
        self._noise = Checkbox(label="noise", name="noise")
        self._pause = Toggle(label="Pause", name="pause")
        self._snr = _slider("snr", "SNR in the sampled band [dB]", (-5, 40), _DEFAULT_SNR_DB)
        self._offset = _slider("offset", "carrier offset [1/1000 of the sample rate]", (-20, 20), 0)
        self._loss = _slider("loss", "packets lost [%]", (0, 100), 0)
        self._silence = Toggle(label=_SENDS, name="silence", button_type="danger", sizing_mode="stretch_width")
        self._asked = AskedCard(monitor, style)
        self._listen()
        self._build(instance)
        self.draw(monitor.snapshot, monitor.radio)
        document.on_event(DocumentReady, lambda _event: self.ready())

    @property
    def behind(self) -> int:
        """Pictures sent that the browser has not drawn."""
        return int(self._counter.drawn - self._counter.seen) if self._ready else 0

    def ready(self) -> None:
        """The browser has the page."""
        self._counter.seen = self._counter.drawn
        self._ready = True
        self.draw(self._monitor.snapshot, self._monitor.radio)

    def offer(self, snapshot: Snapshot, radio: RadioView, always: bool = False) -> None:
        """Draw it when the document is free. Skip it while there is no viewer, or when the viewer is too far behind."""
        if self._ready and not self._pause.active and (always or self.behind < AHEAD):
            curves = always or not self._counter.drawn % CURVES_EVERY
            self.document.add_next_tick_callback(partial(self.draw, snapshot, radio, curves=curves))

    def draw(self, snapshot: Snapshot, radio: RadioView, *, curves: bool = True) -> None:
        """Show a snapshot. The caller holds the lock of the document.

        :param curves: whether the curves are new, too
        """
        self._html["tiles"].text = tiles_html(snapshot)
        self._html["counters"].text = counters_html(snapshot, radio.backlog, radio.snr_db)
        self._html["alarms"].text = alarms_html(snapshot)
        self._html["topics"].text = topics_html(snapshot)
        self._html["heard"].text = heard_html(snapshot)
        self._html["team"].text = team_html(snapshot)
        self._html["paths"].text = paths_html(snapshot)
        self._html["packets"].text = packets_html(snapshot)
        if curves:
            self._draw_curves(snapshot)
            self._draw_radio(radio)
        self._draw_paths(snapshot)
        self._draw_pictures(snapshot)
        if snapshot.team is not None:
            own = {topic.src_id: colour(topic.colour) for topic in reversed(snapshot.topics)}
            self._draw_team(snapshot.team, own)
        self._show_channel(radio)
        self._asked.draw(self._monitor.asked)
        empty = set(_empty_cards(snapshot, radio)) | ({"asked"} if self._monitor.asked is None else set())
        waits = empty & (_FIRST if snapshot.phase == "waiting" else _FIRST - {"pdr", "air"})
        self._counter.empty, self._counter.waits = " ".join(sorted(empty - waits)), " ".join(sorted(waits))
        self._counter.old = "constellation spectrum latency" if snapshot.old else ""
        self._counter.ago = f"{snapshot.silent_s:.0f} s" if snapshot.old else ""
        self._counter.said = ". ".join((state_text(snapshot), *snapshot.alarms))
        self._counter.drawn += 1

    def _draw_curves(self, snapshot: Snapshot) -> None:
        series = snapshot.series
        self._sources["series"].data = {
            "name": [line.name for line in series],
            "colour": [colour(line.colour) for line in series],
            "t": [_small(line.t) for line in series],
            "pdr": [_small(line.pdr) for line in series],
            "goodput": [_small(line.goodput_Bps / 1000) for line in series],
            "age": [_small(line.age_s) for line in series],
            "queued": [_small(line.queued) for line in series],
        }
        self._show(
            "error",
            ((path.name, colour(path.colour), _small(path.error_t), _small(path.errors_m)) for path in snapshot.paths),
        )
        air = snapshot.air
        if air is not None:
            kinds = {kind: _small(air.busy[kind] * 100) for kind in AIR_COLOURS} if air.busy else {}
            none = _small(np.full(len(air.t), np.nan))
            self._sources["air"].data = {"t": _small(air.t), **dict.fromkeys(AIR_COLOURS, none), **kinds}
            self._sources["snr"].data = {"t": _small(air.t), "db": _small(air.snr_db)}
            self._sources["loss"].data = {"t": _small(air.t), "share": _small(air.lost * 100)}
            self._sources["changes"].data = {"t": _small(air.changes)}
        curves = [topic for topic in snapshot.topics if topic.latency_cdf_s]
        self._sources["latency"].data = {
            "name": [topic.name for topic in curves],
            "colour": [colour(topic.colour) for topic in curves],
            "ms": [_small(np.array(topic.latency_cdf_s) * 1000) for topic in curves],
            "share": [_small(np.linspace(0, 1, len(topic.latency_cdf_s))) for topic in curves],
        }

    def _show(self, source: str, rows: Iterable[tuple[Any, ...]]) -> None:
        """Replace the data of a source by rows, each with a value for every column."""
        shown, rows = self._sources[source], list(rows)
        shown.data = {column: [row[place] for row in rows] for place, column in enumerate(shown.column_names)}

    def _draw_paths(self, snapshot: Snapshot) -> None:
        paths = snapshot.paths
        self._show("sent", ((path.name, _small(path.sent_x), _small(path.sent_y)) for path in paths))
        self._show("received", ((path.name, _small(path.received_x), _small(path.received_y)) for path in paths))
        pairs = [(path.truth, path.belief) for path in paths if path.truth is not None and path.belief is not None]
        self._show("gap", (([one[0], other[0]], [one[1], other[1]]) for one, other in pairs))
        ends = [(path.truth, _SENT) for path in paths] + [(path.belief, _RECEIVED) for path in paths]
        self._show("ends", ((*point, ink) for point, ink in ends if point is not None))

    def _draw_pictures(self, snapshot: Snapshot) -> None:
        """Pictures of cameras beside each other, and the newest map below the paths."""
        for name, is_map in (("picture", False), ("grid", True)):
            views = [view for view in snapshot.pictures if view.is_map == is_map]
            views = sorted(views, key=lambda view: view.age_s)[:1] if is_map else views
            lefts = [view.place[0] for view in views] if is_map else _beside([view.place[2] for view in views])
            self._show(name, ((view.pixels, left, *view.place[1:]) for view, left in zip(views, lefts, strict=True)))
        self._html["seen"].text = "<br>".join(escape(view.words) for view in snapshot.pictures)

    def _draw_team(self, team: TeamView, inks: dict[int, str]) -> None:
        """The newest slots of the channel, and for each robot where the others believe it is, with a line to it.

        :param inks: colours of the robots whose topics come here: those of the topics
        """
        inks = dict.fromkeys(team.robots, _SOFT) | inks
        sends = [send for send in team.sends if send.t > team.now - STRIP_S]
        self._sources["strip"].data = {
            "left": [send.t - team.now for send in sends],
            "right": [send.t + send.airtime_s - team.now for send in sends],
            "robot": [float(send.robot) for send in sends],
            "colour": [OUTCOME_COLOURS[send.outcome(len(team.robots))] for send in sends],
        }
        self._show(
            "places", ((*place, inks[robot], str(robot), f"robot {robot}") for robot, place in team.places.items())
        )
        self._legend.visible = len(team.robots) <= _IN_LEGEND
        known = [(team.places[of], there, inks[of]) for (_, of), there in team.beliefs.items() if of in team.places]
        self._show("beliefs", (([place[0], there[0]], [place[1], there[1]], ink) for place, there, ink in known))

    def _draw_radio(self, radio: RadioView) -> None:
        symbols = np.empty(0, np.complex64) if radio.symbols is None else radio.symbols
        self._sources["constellation"].data = {"re": _small(symbols.real), "im": _small(symbols.imag)}
        if radio.frequencies is not None and radio.spectrum_db is not None:
            self._sources["spectrum"].data = {
                "khz": _small(radio.frequencies / 1000),
                "db": _small(radio.spectrum_db),
            }
            self._spectrum_title.text = radio.busy

    # -- the channel --------------------------------------------------------------------------------------------

    def _listen(self) -> None:
        """Pass the viewer's settings to the monitor."""
        monitor = self._monitor

        def listen(widget: Any, attribute: str, change: Callable[[float], None]) -> None:
            def changed(_attribute: str, _old: Any, value: float) -> None:
                if not self._following:
                    change(value)
                    self._shown = monitor.channel

            widget.on_change(attribute, changed)

        listen(self._silence, "active", lambda silent: monitor.transmit(not silent))
        listen(self._noise, "active", lambda active: monitor.set_snr_db(float(self._snr.value) if active else None))
        listen(self._snr, "value", lambda value: monitor.set_snr_db(float(value)))
        listen(self._offset, "value", lambda value: monitor.set_frequency_offset(value / 1000))
        listen(self._loss, "value", lambda value: monitor.set_packet_loss(value / 100))

    def _show_channel(self, radio: RadioView) -> None:
        """Show the settings of other viewers. A widget that this viewer is dragging stays as it is."""
        self._following = True
        self._silence.active = not radio.transmits
        self._silence.label = _SENDS if radio.transmits else _SILENT
        self._following = False
        channel = self._monitor.channel
        if channel is not None and channel != self._shown:
            self._shown = channel
            self._following = True
            self._noise.active = channel.snr_db is not None
            if channel.snr_db is not None:
                self._snr.value = channel.snr_db
            self._offset.value = channel.frequency_offset * 1000
            self._loss.value = channel.packet_loss * 100
            self._following = False
        for widget in (self._noise, self._snr, self._offset):
            widget.disabled = not radio.has_samples
        for widget in (self._noise, self._snr, self._offset, self._loss):
            widget.visible = radio.changeable or channel is None
        text = self._monitor.refused
        if not text and channel is not None and radio.changeable and not radio.has_samples:
            text = "This PHY has no samples: only packets can be lost."
        self._html["note"].visible = bool(text)
        self._html["note"].text = f'<div class="note {"bad" if self._monitor.refused else ""}">{escape(text)}</div>'

    # -- making -------------------------------------------------------------------------------------------------

    def _build(self, instance: str) -> None:
        sources = self._sources
        map_ = _plot("map", "name", "x [m]", "y [m]", match_aspect=True)
        map_.multi_line("x", "y", source=sources["sent"], color=_SENT, line_width=6, alpha=0.4)
        map_.multi_line("x", "y", source=sources["received"], color=_RECEIVED, line_width=1.5)
        map_.multi_line("x", "y", source=sources["gap"], color=_SOFT, line_width=1.5, line_dash="dotted")
        map_.scatter("x", "y", source=sources["ends"], color="colour", line_color="white", size=12)
        map_.image_rgba("image", "x", "y", "dw", "dh", source=sources["grid"], alpha=0.7, level="underlay")
        camera = _plot("camera", "", "", "", match_aspect=True)
        camera.image_rgba("image", "x", "y", "dw", "dh", source=sources["picture"])
        camera.axis.visible = camera.grid.visible = False
        error = _plot("error", "name", "time [s]", "error [m]")
        error.multi_line("t", "m", source=sources["error"], color="colour", line_width=1.5)
        error.y_range.start = 0
        constellation = _plot(
            "constellation", "", "in phase", "quadrature", x_range=Range1d(-2.6, 2.6), y_range=Range1d(-1.9, 1.9)
        )
        constellation.scatter("re", "im", source=sources["constellation"], size=2.5, color=_SENT, alpha=0.35)
        spectrum = _plot("spectrum", "", "frequency [kHz]", "power [dB]", y_range=Range1d(-50, 3))
        self._spectrum_title = spectrum.title
        self._spectrum_title.text_color, self._spectrum_title.text_font_size = _SOFT, "11px"
        self._spectrum_title.text_font_style = "normal"
        spectrum.varea("khz", -200, "db", source=sources["spectrum"], color=_SENT, alpha=0.15)
        spectrum.line("khz", "db", source=sources["spectrum"], color=_SENT, line_width=1.2)
        latency = _plot("latency", "name", "latency [ms]", "share", x_axis_type="log", y_range=Range1d(0, 1.03))
        latency.multi_line("ms", "share", source=sources["latency"], color="colour", line_width=2)
        air = _plot("air", "", "time [s]", "busy [%]", y_range=DataRange1d(start=0, max_interval=100))
        air.varea_stack(
            list(AIR_COLOURS),
            x="t",
            color=list(AIR_COLOURS.values()),
            source=sources["air"],
            legend_label=list(AIR_COLOURS),
        )
        _legend_above(air)
        snr = _plot("snr", "", "time [s]", "SNR [dB]")
        snr.line("t", "db", source=sources["snr"], color=_SENT, line_width=1.8)
        loss = _plot("loss", "", "time [s]", "lost [%]", y_range=DataRange1d(start=0, max_interval=100))
        loss.line("t", "share", source=sources["loss"], color=_RECEIVED, line_width=1.8)
        strip = _plot("strip", "", "time [s]", "robot", x_range=Range1d(-STRIP_S, 0))
        strip.hbar("robot", left="left", right="right", height=0.8, color="colour", source=sources["strip"])
        beliefs = _plot("beliefs", "", "x [m]", "y [m]", match_aspect=True)
        beliefs.multi_line("x", "y", source=sources["beliefs"], color="colour", line_width=3)
        beliefs.scatter(
            "x", "y", source=sources["places"], color="colour", line_color="white", size=18, legend_field="name"
        )
        beliefs.text(
            *("x", "y", "robot"),
            source=sources["places"],
            text_color="white",
            text_font_size="11px",
            text_align="center",
            text_baseline="middle",
        )
        self._legend = _legend_above(beliefs)
        plots = [map_, camera, error, constellation, spectrum, latency, air, snr, loss, strip, beliefs]
        series: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
            ("pdr", "pdr", "share", {"y_range": Range1d(0, 1.1)}),
            ("goodput", "goodput", "kB/s", {}),
            ("age", "age", "age [s]", {"y_axis_type": "log"}),  # a map that is sent once is much older than all else
            ("queue", "queued", "messages", {}),
        )
        for name, values, unit, options in series:
            plot = _plot(name, "name", "time [s]", unit, **options)
            plot.multi_line("t", values, source=sources["series"], color="colour", line_width=1.8)
            if not options:
                plot.y_range.start = 0
            if name == "pdr":
                plot.hspan(y=GOOD, line_color=_SOFT, line_dash="dotted")
            plots.append(plot)
        mark = VSpan(x="t", line_color=_SOFT, line_dash="dashed")
        since_start = [plot for plot in plots if plot.below[0].axis_label == "time [s]" and plot is not strip]
        for plot in since_start:
            plot.add_glyph(sources["changes"], mark)
        channel = column(
            *(self._silence, self._noise, self._snr, self._offset, self._loss, self._html["note"]),
            name="channel",
            sizing_mode="stretch_width",
            spacing=12,
        )
        document = self.document
        document.title = "gr-ros2 · live"
        texts = [text for name, text in self._html.items() if name != "note"]
        with document.models.freeze():  # otherwise the document walks through all models for every root
            for root in (*plots, channel, self._asked.root, self._pause, *texts):
                document.add_root(root)
        document.template = Environment(loader=FileSystemLoader(_TEMPLATES), autoescape=False).get_template(
            "page.html.j2"
        )
        document.template_variables["instance"] = instance
        for widget in (self._pause, self._silence, self._noise, self._snr, self._offset, self._loss):
            widget.stylesheets = [self._style]
        words = [*(axis for plot in plots for axis in plot.axis), air.legend[0], self._legend]
        readable = CustomJS(
            args={"pulse": self._counter, "pause": self._pause, "words": words},
            code=(_TEMPLATES / "page.js").read_text("utf-8"),
        )
        document.js_on_event(DocumentReady, readable)
        document.js_on_event(ConnectionLost, CustomJS(code="window.viewerLost = true"))


def _legend_above(plot: Any) -> Any:
    (legend,) = plot.legend
    legend.orientation, legend.padding, legend.margin = "horizontal", 0, 0
    legend.background_fill_alpha = legend.border_line_alpha = 0
    legend.label_text_font_size, legend.label_text_color = "10px", _SOFT
    plot.add_layout(legend, "above")
    return legend


def _small(values: Any) -> Any:
    """The values as single-precision floats, which is more precise than a screen. No values become one NaN, which draws
    nothing: Bokeh compares new data with old data, and the truth value of an empty numpy array is not defined."""
    return np.asarray(values if len(values) else [np.nan], dtype=np.float32)


def _beside(widths: list[float]) -> list[float]:
    """Where pictures of these widths begin, with a gap between them."""
    return [sum(widths[:place]) + 0.05 * place for place in range(len(widths))]


def _slider(name: str, title: str, ends: tuple[float, float], value: float) -> Slider:
    start, end = ends
    return Slider(name=name, title=title, start=start, end=end, step=0.5, value=value, sizing_mode="stretch_width")


def _empty_cards(snapshot: Snapshot, radio: RadioView) -> Iterator[str]:
    """The cards that have nothing to show, by the names that the template gives them."""
    has = {
        "path": any(len(path.sent_x) or len(path.received_x) for path in snapshot.paths)
        or any(view.is_map for view in snapshot.pictures),
        "camera": any(not view.is_map for view in snapshot.pictures),
        "error": any(len(path.errors_m) for path in snapshot.paths),
        "pdr": any(np.isfinite(line.pdr).any() for line in snapshot.series),
        "age": any(topic.age_now_s is not None or topic.age_mean_s is not None for topic in snapshot.topics),
        "queue": any(np.isfinite(line.queued).any() for line in snapshot.series),
        "latency": any(topic.latency_cdf_s for topic in snapshot.topics),
        "constellation": radio.symbols is not None,
        "spectrum": radio.spectrum_db is not None,
        "air": snapshot.air is not None and bool(snapshot.air.busy),
        **dict.fromkeys(("strip", "beliefs", "team"), snapshot.team is not None),
        "snr": snapshot.air is not None and bool(np.isfinite(snapshot.air.snr_db).any()),
        "loss": snapshot.air is not None and bool(np.isfinite(snapshot.air.lost).any()),
    }
    yield from (card for card, filled in has.items() if not filled)


def _plot(name: str, hover: str, x: str, y: str, **options: Any) -> Any:
    plot = figure(
        name=name,
        sizing_mode="stretch_both",
        min_height=100,
        toolbar_location=None,
        tools=[HoverTool(tooltips=[("", f"@{hover}"), ("", "$x, $y")])] if hover else [],
        output_backend="canvas",
        min_border=2,
        **options,
    )
    plot.outline_line_color = plot.background_fill_color = plot.border_fill_color = None  # as the card, bright or dark
    plot.grid.grid_line_color, plot.grid.grid_line_alpha = _SOFT, 0.2
    plot.xaxis.axis_label, plot.yaxis.axis_label = x, y
    for axis in plot.axis:
        axis.axis_line_color = axis.major_tick_line_color = _SOFT
        axis.axis_label_text_color, axis.axis_label_text_font_size = _SOFT, "11px"
        axis.axis_label_text_font_style, axis.axis_label_standoff = "normal", 2
        axis.minor_tick_line_color = None
        axis.major_label_text_color = _SOFT
        axis.major_label_text_font_size = "11px"
        if isinstance(axis, LogAxis):  # by itself it writes all of .1, .2, ... .9 over each other
            axis.ticker = FixedTicker(ticks=[m * 10.0**e for e in range(-4, 6) for m in (1, 3)], minor_ticks=[])
            axis.formatter = NumeralTickFormatter(format="0.[0000]")
    return plot
