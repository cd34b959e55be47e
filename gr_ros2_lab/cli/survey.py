"""`gr-ros2 survey`: where a running link is good, as a table, a figure and GeoJSON, while the robot drives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from math import inf, isfinite
from pathlib import Path
from typing import Any

import click
import numpy as np

from gr_ros2.cli.console import LOG_S
from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.params import Number
from gr_ros2.cli.registry import shared_graph
from gr_ros2.cli.status import find_link, pid_option, status_of
from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import write_text, write_whole
from gr_ros2.core.watch import wait_until
from gr_ros2.middleware import Middleware, Qos, join_graph
from gr_ros2.middleware.type_definitions import DAMAGED
from gr_ros2.observe.positions import humble_types
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.wire import BROADCAST
from gr_ros2_lab.report.survey_figure import GridPicture, survey_figure
from gr_ros2_lab.survey.geojson import geojson
from gr_ros2_lab.survey.poses import FIX, TRANSFORMS, GeoFrame, GeoOrigin, pose_reader
from gr_ros2_lab.survey.recorder import Place, SurveyRecorder
from gr_ros2_lab.survey.table import Survey, SurveyRow, read_table, write_table

_FOUND_S = 10.0
"""s for which a topic is looked for on the graph."""
_LOOK_S = 0.1
_DEPTH = 10
_MAP, _STATIC = "nav_msgs/msg/OccupancyGrid", "/tf_static"
_KEEP_S = 10.0
"""s between two writings of the table, so that a robot that stops for ever leaves one."""


class NumberPair(click.ParamType):
    """Two numbers, such as ``3.5,-2``."""

    name = "a,b"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            one, other = (float(part) for part in str(value).split(","))
        except ValueError:
            one = other = inf
        if not (isfinite(one) and isfinite(other)):
            self.fail(f"{value!r}: write two numbers, such as 3.5,-2", param, ctx)
        return one, other


@click.command()
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--pose",
    metavar="TOPIC",
    help="Where this robot is, in its namespace or with a slash first: odometry, pose, NavSatFix, /tf. Default: none, "
    "so FILE is shown.",
)
@click.option("--robot", type=click.IntRange(0, BROADCAST - 1), help="Robot that is heard; default: the first one.")
@click.option(
    "--base",
    type=NumberPair(),
    help="Where that robot stands: x,y in m (of a NavSatFix latitude,longitude). Default: where this one set out.",
)
@click.option("--their-pose", metavar="TOPIC", help="Where that robot is, if it drives too.")
@click.option("--frame", default="base_link", show_default=True, help="Of this robot, in transforms.")
@click.option("--origin", type=NumberPair(), help="Latitude,longitude of x = y = 0, for GeoJSON; x is to the east.")
@click.option("--map", "grid", metavar="TOPIC", default="/map", show_default=True, help="Map below the figure.")
@click.option("--every", type=Number(0.1, 60), default=0.5, show_default=True, help="Seconds of one row.")
@click.option("--duration", type=Number(0, min_open=True), help="Seconds; default until Ctrl-C.")
@shared_graph("Of the robot's graph.", "that of the link")
@pid_option
def survey(
    *,
    file: Path,
    pose: str | None,
    robot: int | None,
    base: tuple[float, float] | None,
    their_pose: str | None,
    frame: str,
    origin: tuple[float, float] | None,
    grid: str,
    every: float,
    duration: float | None,
    middleware: str,
    domain_id: int | Auto,
    pid: int | None,
) -> None:
    """Record loss, SNR, rate and age of a running link over place, until Ctrl-C, while the robot drives.

    Writes FILE (CSV), which `channel: {trace: FILE}` of a scenario takes, a figure and, where it is known where on the
    earth the robot is, GeoJSON beside it. Without --pose, an existing FILE is shown and drawn again.
    """
    picture: GridPicture | None = None
    if pose is None:
        if not file.exists():
            raise ConfigError(f"{file}: no such survey to show; to drive one, name --pose TOPIC of this robot")
        rows = read_table(file)
    else:
        chosen = find_link(pid)
        own = status_of(chosen)["graph"]
        joined = own["domain_id"] if domain_id == AUTO else domain_id
        with join_graph(middleware, domain_id=joined, node_name="gr_ros2_survey") as graph:
            drive = _Drive(graph, SurveyRecorder(robot), chosen, own["namespace"])
            drive.start(pose, frame, base)
            if their_pose is not None:
                drive.follow(their_pose, frame, drive.recorder.there)
            drive.hear_map(grid)
            rows = drive.record(file, every, inf if duration is None else duration)
            picture = drive.picture
    _show(file, rows, picture, None if origin is None else GeoOrigin(*origin))


class _Drive:
    """Records what a link hears while a robot drives.

    :param pid: process of the link
    :param namespace: of the robot's topics
    :ivar picture: the map, if one came
    """

    def __init__(self, graph: Middleware, recorder: SurveyRecorder, pid: int, namespace: str) -> None:
        self._graph, self.recorder, self._pid, self._namespace = graph, recorder, pid, namespace
        self.picture: GridPicture | None = None
        self._lock = threading.Lock()
        self._earth = GeoFrame()

    def start(self, topic: str, frame: str, base: tuple[float, float] | None) -> None:
        """Take the places of this robot from a topic.

        :param base: where the other robot stands, in m, or in degrees where this one's places are
        :raises ConfigError: see :meth:`follow`
        """
        if base is not None and self._found(topic)[1] == FIX:
            self._earth, base = GeoFrame(GeoOrigin(*base)), (0.0, 0.0)
        self.recorder.base = base
        self.follow(topic, frame, self.recorder.here)

    def follow(self, topic: str, frame: str, take: Callable[[Place], None]) -> None:
        """Take places from a topic.

        :raises ConfigError: when nobody publishes it, or its type tells no place
        """
        name, type_name = self._found(topic)
        read = pose_reader(type_name, frame, self._earth)
        if read is None:
            raise ConfigError(
                f"--pose {name}: {type_name} tells no place; take Odometry, PoseStamped, PoseWithCovarianceStamped, "
                "NavSatFix or /tf"
            )

        def taken(payload: bytes) -> None:
            with self._lock:
                if (found := read(payload)) is not None:
                    take(Place(time.monotonic(), *found))

        self._graph.subscribe(name, type_name, Qos(depth=_DEPTH), taken)
        if type_name == TRANSFORMS:
            self._graph.subscribe(_STATIC, TRANSFORMS, Qos(None, "transient_local", _DEPTH), taken)

    def hear_map(self, topic: str) -> None:
        """Take the newest map of a topic, if one comes."""

        def taken(payload: bytes) -> None:
            try:
                grid: Any = humble_types().deserialize_cdr(payload, _MAP)
                cells = np.array(grid.data, float).reshape(grid.info.height, grid.info.width)
            except (*DAMAGED, ValueError):
                return
            place = grid.info.origin.position
            if cells.size and grid.info.resolution > 0:
                self.picture = GridPicture(cells, float(grid.info.resolution), (float(place.x), float(place.y)))

        self._graph.subscribe("/" + topic.lstrip("/"), _MAP, Qos(None, "transient_local", 1), taken)

    def record(self, file: Path, every: float, duration: float) -> list[SurveyRow]:
        """Look at the link again and again, until the time is over, or Ctrl-C."""
        console = make_console()
        begun = kept = said = time.monotonic()
        try:
            while (now := time.monotonic()) < begun + duration:
                with self._lock:
                    row = self.recorder.look(status_of(self._pid), now)
                if now >= kept + _KEEP_S:
                    kept = now
                    write_whole(file, self.recorder.rows, write_table)
                if row is not None and now >= said + LOG_S:
                    said = now
                    console.print(_line(row), soft_wrap=True)
                time.sleep(min(every, max(0.0, begun + duration - now)))
        except KeyboardInterrupt:
            pass  # the usual end
        for why, count in self.recorder.missed.items():
            if count:
                console.print(f"{count} looks had {why}, and count nowhere", soft_wrap=True)
        return self.recorder.finish()

    def _found(self, topic: str) -> tuple[str, str]:
        """The whole name of a topic, relative to the robot's namespace or else to the root, and its type, as soon as
        somebody publishes it.

        :raises ConfigError: when nobody does
        """
        names = [topic] if topic.startswith("/") else [f"{self._namespace}/{topic}", f"/{topic}"]

        def published() -> dict[str, str]:
            return {info.topic: info.type_name for info in self._graph.discover() if info.publishers}

        wait_until(lambda: not published().keys().isdisjoint(names), _FOUND_S, look_s=_LOOK_S)
        there = published()
        for name in names:
            if name in there:
                return name, there[name]
        raise ConfigError(
            f"--pose {topic}: nobody publishes {' or '.join(dict.fromkeys(names))}; on the graph are "
            f"{', '.join(sorted(there)[:20]) or 'no topics, and --domain-id takes another graph'}"
        )


def _line(row: SurveyRow) -> str:
    snr = f", SNR {row.snr_db:.1f} dB" if isfinite(row.snr_db) else ""
    lost = f", {row.loss:.0%} lost" if isfinite(row.loss) else ", nothing heard"
    return f"{row.t_s:.0f} s at {row.x_m:.1f}, {row.y_m:.1f} m: {row.packets:g} packets{lost}{snr}"


def _show(file: Path, rows: list[SurveyRow], picture: GridPicture | None, origin: GeoOrigin | None) -> None:
    """Write what follows from the rows, and say what they tell."""
    console = make_console()
    made = Survey(str(file), rows)
    write_whole(file, rows, write_table)
    drawn = file.with_suffix(".png")
    write_whole(drawn, survey_figure(made, rows, picture), lambda figure, path: figure.savefig(path, format="png"))
    written = [str(file), str(drawn)]
    if (text := geojson(rows, origin)) is not None:
        write_whole(file.with_suffix(".geojson"), text, write_text)
        written.append(str(file.with_suffix(".geojson")))
    console.print(f"{made.name}: {made.words()}", soft_wrap=True)
    console.print(f"written: {', '.join(written)}", soft_wrap=True)
    if text is None:
        console.print("no GeoJSON: nothing says where on the earth this is; --origin does", soft_wrap=True)
