"""A sweep as one YAML file, and its cells: the settings, the number of repetitions, and the axes of the figures.

Invariants: every cell is a scenario that :func:`gr_ros2_lab.run.scenario.load_scenario` accepts, with a PHY that can be
built; all cells are made before the first one runs; repetition n has the same seed in every cell, the scenario's plus
n.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import BackendMissingError, ConfigError
from gr_ros2.phy import Phy
from gr_ros2.settings.config import ScenarioChannel, Text, build, read_yaml
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.files import find_registry, parse_override
from gr_ros2_lab.record.team_numbers import TEAM_VALUES
from gr_ros2_lab.run.builtin import SCENARIO_DIR
from gr_ros2_lab.run.load import check_channels, make_phy, source_names
from gr_ros2_lab.run.robot_settings import senders_of
from gr_ros2_lab.run.scenario import Experiment, Scenario, Time, changed, dump, load_scenario

BUILTIN_DIR = Path(__file__).resolve().parents[2] / "sweeps"
"""Folder of the built-in sweeps."""

PDR = "pdr"
VALUES = {
    PDR: "PDR",
    "goodput_Bps": "goodput [B/s]",
    "latency_p50_s": "latency p50 [s]",
    "latency_p95_s": "latency p95 [s]",
    "latency_p99_s": "latency p99 [s]",
    "latency_max_s": "latency max [s]",
    "age_mean_s": "mean age [s]",
    "age_peak_s": "peak age [s]",
    "path_error_m": "path error [m]",
    "rms_error_m": "RMS error [m]",
    "airtime_per_message_s": "airtime per message delivered [s]",
    "airtime_per_byte_s": "airtime per byte delivered [s]",
    **TEAM_VALUES,
}
"""The numbers that a figure can show: column of the table -> label of an axis."""

OF_THE_LINK = (PDR, "goodput_Bps", "airtime_per_message_s", "airtime_per_byte_s", *TEAM_VALUES)
"""The numbers that exist for all topics together."""

OF_THE_SWEEP = (("repetitions",), ("time",))
"""Settings of a scenario that a sweep has for all its cells."""

Overrides = Mapping[str, Any]
"""Dotted key -> value, as on the command line after ``--set``."""

Keys = Annotated[tuple[str, ...], BeforeValidator(lambda keys: (keys,) if isinstance(keys, str) else keys)]
"""One key or several."""


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", str_strip_whitespace=True))
class Sweep(Experiment):
    """One scenario at many settings. The cells are every entry of ``list`` at every point of ``grid``."""

    scenario: Annotated[str, Field(min_length=1)]
    """a built-in name, or the path of a file seen from the sweep's"""
    set: dict[str, Any] = Field(default_factory=dict)
    """settings of all cells, over the scenario's"""
    grid: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(default_factory=dict)
    """dotted key -> the values it takes; all combinations are run"""
    list: tuple[dict[str, Any], ...] = ()
    """mappings of settings that belong together, each run in turn"""
    time: Time = "samples"
    x: Text = AUTO
    """key along the horizontal axis; auto = channel.snr_db, or the first that has numbers"""
    y: Text = AUTO
    """key up the vertical axis of the heat map; auto = the next that has numbers"""
    by: Keys = (AUTO,)
    """keys that make a curve each; auto = those without numbers, or the next one"""
    value: str = PDR
    """what the figures show, a name of ``VALUES``"""
    topic: str = ""
    """of which topic, an absolute name; '' all together"""

    @model_validator(mode="after")
    def _consistent(self) -> Sweep:
        if not self.grid and not self.list:
            raise ValueError("nothing to sweep; give grid, list or both")
        swept = self.keys
        for (key,) in OF_THE_SWEEP:
            if key in self.set or key in swept:
                raise ValueError(f"{key} is the same in all cells; write it at the top of the file")
        for key in swept:
            if key in self.set:
                raise ValueError(f"{key} stands in set and is swept; take it out of one of them")
            if swept.count(key) > 1:
                raise ValueError(f"{key} stands in grid and in list; take it out of one of them")
        for name, keys in (("x", (self.x,)), ("y", (self.y,)), ("by", self.by)):
            for key in keys:
                if key not in (AUTO, *swept):
                    raise ValueError(f"{name} = {key!r} is not swept; swept are {', '.join(swept)}")
        if self.value not in VALUES:
            raise ValueError(f"value = {self.value!r}: no such number; known are {', '.join(VALUES)}")
        return self

    @property
    def keys(self) -> Sequence[str]:
        """The swept keys. Those of the list come first."""
        return [*dict.fromkeys(key for entry in self.list for key in entry), *self.grid]

    @property
    def points(self) -> Sequence[Overrides]:
        """The settings of each cell, without the settings that all cells share."""
        axes = [[(key, value) for value in values] for key, values in self.grid.items()]
        return [{**entry, **dict(point)} for entry in self.list or ({},) for point in product(*axes)]


@plain_dataclass(frozen=True)
class SweepCell:
    """One point of a sweep.

    :param number: from 1
    :param point: the settings of this cell
    :param values: the value of every swept key in this cell, also where the point does not name it; numbers, truth
        values, texts or None
    :param runs: the scenario, once per repetition
    """

    number: int
    point: Overrides
    values: Overrides
    runs: Sequence[Scenario]

    @property
    def label(self) -> str:
        """The point in one line."""
        return label(self.point)


@plain_dataclass(frozen=True)
class SweepPlan:
    """A sweep whose cells have been checked, so that they can run.

    :param name: of the file
    """

    name: str
    sweep: Sweep
    cells: Sequence[SweepCell]

    @property
    def keys(self) -> Sequence[str]:
        """The swept keys."""
        return self.sweep.keys

    @property
    def real_time(self) -> bool:
        """Whether some of its runs are in real time and need the whole machine."""
        return any(not scenario.simulated for cell in self.cells for scenario in cell.runs)


def load_sweep(name_or_path: str | Path, overrides: Sequence[str] = ()) -> SweepPlan:
    """Read a built-in sweep or a YAML file and make all its cells.

    :param overrides: `key=value` for all cells, over the file's own ``set``; those of ``OF_THE_SWEEP`` replace its own
    :raises ConfigError: when there is no such sweep or a setting is wrong; names the cell and the key
    """
    path, where = _path(name_or_path), str(name_or_path)
    given = [(text, *parse_override(text)) for text in overrides]
    own = {keys[0]: value for _, keys, value in given if keys in OF_THE_SWEEP}
    sweep = read_sweep(name_or_path, own)
    return SweepPlan(
        path.stem,
        sweep,
        _cells(sweep, path.parent, [text for text, keys, _ in given if keys not in OF_THE_SWEEP], where),
    )


def read_sweep(name_or_path: str | Path, own: Mapping[str, Any] = MappingProxyType({})) -> Sweep:
    """Read a built-in sweep or a YAML file, without making its cells.

    :param own: settings of the sweep, over those of the file
    :raises ConfigError: when there is no such sweep, or one of its keys is unknown or wrong
    """
    return build(Sweep, {**read_yaml(_path(name_or_path)), **own}, str(name_or_path))


def builtin_sweeps() -> list[str]:
    """Names of the sweeps that come with gr-ros2."""
    return sorted(path.stem for path in BUILTIN_DIR.glob("*.yaml"))


def _path(name_or_path: str | Path) -> Path:
    if str(name_or_path) in builtin_sweeps():
        return BUILTIN_DIR / f"{name_or_path}.yaml"
    path = Path(name_or_path)
    if not path.is_file():
        raise ConfigError(
            f"sweep {str(name_or_path)!r} is neither a file nor built in; built in are {', '.join(builtin_sweeps())}"
        )
    return path


def label(point: Overrides) -> str:
    """Settings in one line."""
    return ", ".join(f"{key}={value if isinstance(value, str) else _json(value)}" for key, value in point.items())


def _cells(sweep: Sweep, folder: Path, overrides: Sequence[str], where: str) -> Sequence[SweepCell]:
    builtin = (SCENARIO_DIR / f"{sweep.scenario}.yaml").is_file()
    name = sweep.scenario if builtin else folder / Path(sweep.scenario).expanduser()
    try:
        load_scenario(name)  # an error in the scenario itself is reported without a cell
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    fixed = [f"time={sweep.time}", *_texts(sweep.set, folder), *overrides]
    points = sweep.points
    cells: list[SweepCell] = []
    phys: dict[str, Phy] = {}
    for number, point in enumerate(points, start=1):
        try:
            settings = [*fixed, *_texts(point, folder)]
            first = load_scenario(name, settings)
            _check(sweep, first, phys)
            runs = [first]
            runs += [load_scenario(name, settings, seed=first.seed + n) for n in range(1, sweep.repetitions)]
            if len(runs) > 1 and runs[1].channel.seed == first.channel.seed:
                raise ConfigError("channel.seed is fixed, so repetitions would repeat the same noise; leave it out")
        except BackendMissingError:
            raise
        except ConfigError as error:
            raise ConfigError(f"{where}: cell {number} of {len(points)} ({label(point)}): {error}") from error
        config = dump(first)
        cells.append(SweepCell(number, point, {key: _value(config, point, key) for key in sweep.keys}, runs))
    return cells


def _check(sweep: Sweep, scenario: Scenario, phys: dict[str, Phy]) -> None:
    """Find errors before the first run that would otherwise appear only when a run begins.

    :param phys: PHYs made for earlier cells; they are reused because computing the load for a sample rate takes time
    """
    registry = scenario.load_registry()
    beside_channel = repr(changed(scenario, ScenarioChannel, lambda _: ScenarioChannel()))
    if beside_channel not in phys:
        phys[beside_channel] = make_phy(scenario, registry)
    check_channels(scenario, phys[beside_channel])
    names = [name for robot in senders_of(scenario.all_robots) for name in source_names(robot, registry)]
    if sweep.topic and sweep.topic not in names:
        raise ConfigError(f"topic = {sweep.topic!r}: not sent; sent are {', '.join(names)}")
    if not sweep.topic and len(names) > 1 and sweep.value not in OF_THE_LINK:
        raise ConfigError(f"value = {sweep.value!r} has each topic for itself; set topic to one of {', '.join(names)}")


def _texts(point: Overrides, folder: Path) -> list[str]:
    """Settings in the form of the command line. A registry's path is relative to the sweep's file."""
    found = {**point, "registry": find_registry(str(point["registry"]), folder)} if "registry" in point else point
    return [f"{key}={_json(value)}" for key, value in found.items()]


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, default=str)


def _at(values: Any, key: str) -> Any:
    for part in key.split("."):
        values = values.get(part) if isinstance(values, Mapping) else None
    return values


def _value(config: Any, point: Overrides, key: str) -> Any:
    """The value of a key in a cell. A number that stands for a list (`robots`) stays a number."""
    value = _at(config, key)
    if isinstance(value, list) and isinstance(point.get(key), int):
        return point[key]
    return value if value is None or isinstance(value, (bool, int, float, str)) else _json(value)
