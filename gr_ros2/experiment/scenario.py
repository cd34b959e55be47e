"""Scenarios: one experiment as one YAML file, with single settings replaced on the command line.

Laws: what both ends of the link must agree on (`registry`, `packet_len`) stands once, at the top level, and both
ends follow it; `source` names where messages come from, `ros_source` and `ros_sink` configure the two blocks;
`dump` gives a mapping from which `scenario_from` makes the same scenario again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import ConfigDict, Field, TypeAdapter, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.config import (
    ChannelConfig,
    Count,
    PacketLen,
    PhyConfig,
    Seconds,
    SinkConfig,
    SourceConfig,
    build,
    read_yaml,
)
from gr_ros2.errors import ConfigError
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY
from gr_ros2.registry import Registry
from gr_ros2.sim.settings import SimSettings

BUILTIN_DIR = Path(__file__).resolve().parent.parent / "scenarios"
"""Where the built-in scenarios and registries lie."""

SHARED_KEYS = ("registry", "packet_len")
"""Settings both ends of the link must agree on."""

_BAG = "bag:"
_NUMBER = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+")


@dataclass(frozen=True)
class _Common:
    """What several parts take over from the top level, to be found wrong once and not in every part."""

    packet_len: PacketLen = 220
    seed: Count = 0


@dataclass(frozen=True, config=ConfigDict(extra="forbid", str_strip_whitespace=True))
class Scenario:
    """One experiment: input -> ROS Source -> PHY and channel -> ROS Sink -> output, and for how long.

    :param name: what the result and the tables call it
    :param registry: CSV path, relative to the YAML file (on the command line: to the current directory), or the
        name of a built-in one such as `table4`
    :param description: one line
    :param source: where messages come from: `sim`, the simulated robots, or `bag:PATH`, a recording
    :param bag_speed: playback speed of a bag, 1 as recorded, 0 as fast as the link takes it
    :param sim: settings of the simulator; its seed is the scenario's unless given
    :param packet_len: bytes on the wire, 14..4095, the same on both ends
    :param ros_source: the sending block
    :param ros_sink: the receiving block
    :param phy: which physical layer, and how fast
    :param channel: what lies between transmitter and receiver; its seed is the scenario's unless given
    :param duration_s: s during which messages are submitted; 0 = until the bag ends
    :param drain_s: s the link may go on delivering after that
    :param seed: of the simulator, the channel and the sender
    :param pace: `airtime` lets samples pass at their sample rate, as on the air; `flow` as fast as the flowgraph runs
    :param paced: the PHY grants the source one packet at a time; false offers every packet at once, as the paper does
    :param localhost_only: DDS stays on the loopback interface
    """

    name: Annotated[str, Field(min_length=1)]
    registry: Annotated[str, Field(min_length=1)]
    description: str = ""
    source: str = "sim"
    bag_speed: Seconds = 1.0
    sim: SimSettings = Field(default_factory=SimSettings)
    packet_len: PacketLen = 220
    ros_source: SourceConfig = Field(default_factory=SourceConfig)
    ros_sink: SinkConfig = Field(default_factory=SinkConfig)
    phy: PhyConfig = Field(default_factory=PhyConfig)
    channel: ChannelConfig = Field(default_factory=ChannelConfig)
    duration_s: Seconds = 15.0
    drain_s: Seconds = 2.0
    seed: Count = 0
    pace: Literal["airtime", "flow"] = "airtime"
    paced: bool = True
    localhost_only: bool = True

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        if self.source != "sim" and not self.source.removeprefix(_BAG).strip():
            raise ValueError(f"source = {self.source!r}: the path of the bag is missing; write bag:PATH")
        if self.source != "sim" and not self.source.startswith(_BAG):
            raise ValueError(f"source = {self.source!r}: write sim or bag:PATH")
        if self.source == "sim" and self.duration_s == 0:
            raise ValueError("duration_s = 0: the simulator has no end; set duration_s above 0")
        for key, name, table in (
            ("ros_source.middleware", self.ros_source.middleware, MIDDLEWARE),
            ("ros_sink.middleware", self.ros_sink.middleware, MIDDLEWARE),
            ("phy.name", self.phy.name, PHY),
        ):
            if name not in table:
                raise ValueError(f"{key} = {name!r}: no such {table.family}; known are {', '.join(table)}")
        return self

    @property
    def bag_path(self) -> Path | None:
        """The recording to play, None when the simulator is the source."""
        return Path(self.source.removeprefix(_BAG).strip()).expanduser() if self.source.startswith(_BAG) else None

    def load_registry(self) -> Registry:
        """The registry both ends work with.

        :raises RegistryError: file, line, what is wrong
        """
        return Registry.from_csv(self.registry)


def dump(scenario: Scenario) -> dict[str, Any]:
    """Every setting as JSON values, from which :func:`scenario_from` makes an equal scenario."""
    values: dict[str, Any] = TypeAdapter(Scenario).dump_python(scenario, mode="json")
    return values


def scenario_from(values: Mapping[str, Any], where: str = "") -> Scenario:
    """Make a scenario from a mapping.

    :param where: what to call the mapping in errors, for instance its file name
    :raises ConfigError: for an unknown key, a value out of range, or ends that disagree; names it
    """
    values = dict(values)
    build(_Common, {key: values[key] for key in ("packet_len", "seed") if key in values}, where)
    prefix = f"{where}: " if where else ""
    shared = {key: values[key] for key in SHARED_KEYS if key in values}
    for end in ("ros_source", "ros_sink"):
        block = values.get(end, {})
        if not isinstance(block, Mapping):
            continue  # build() says what is wrong with it
        for key in SHARED_KEYS:
            if key in block and block[key] != shared.get(key):
                raise ConfigError(f"{prefix}{end}.{key} = {block[key]!r}: both ends share it; set {key} instead")
        values[end] = {**block, **shared}
    for part in ("sim", "channel"):
        if isinstance(block := values.get(part, {}), Mapping) and "seed" in values:
            values[part] = {"seed": values["seed"], **block}
    return build(Scenario, values, where)


def load_scenario(name_or_path: str | Path, overrides: Sequence[str] = (), **settings: Any) -> Scenario:
    """Read a built-in scenario or a YAML file.

    :param name_or_path: name of a built-in scenario, otherwise the path of a file
    :param overrides: `key=value` with dotted keys and YAML values (`phy.sample_rate=2e5`), in this order
    :param settings: top-level settings that win over all others; None leaves one as it is
    :raises ConfigError: when there is no such scenario, or a setting is wrong
    """
    path = BUILTIN_DIR / f"{name_or_path}.yaml"
    if not _is_builtin(str(name_or_path)):
        path = Path(name_or_path)
        if not path.is_file():
            raise ConfigError(
                f"scenario {str(name_or_path)!r} is neither a file nor built in; "
                f"built in are {', '.join(sorted(_builtin_names()))}"
            )
    values = {"name": path.stem, **read_yaml(path)}
    if isinstance(values.get("registry"), str):
        values["registry"] = find_registry(values["registry"], path.parent)
    for override in overrides:
        keys, value = parse_override(override)
        if keys == ("registry",):
            value = find_registry(str(value), Path())
        _replace(values, keys, value, override)
    values.update((key, value) for key, value in settings.items() if value is not None)
    return scenario_from(values, str(name_or_path))


def builtin_scenarios() -> Iterator[Scenario]:
    """The scenarios that come with gr-ros2, by name."""
    for name in sorted(_builtin_names()):
        yield load_scenario(name)


def find_registry(name: str, directory: Path) -> str:
    """The absolute path of a registry: a file seen from a directory, or else a built-in one, with or without `.csv`.

    :raises ConfigError: when there is neither
    """
    path = Path(name).expanduser()
    for candidate in (directory / path, BUILTIN_DIR / path, BUILTIN_DIR / f"{name}.csv"):
        if candidate.is_file():
            return str(candidate.resolve())
    known = ", ".join(sorted(path.stem for path in BUILTIN_DIR.glob("*.csv")))
    raise ConfigError(f"registry = {name!r}: no such file; built in are {known}")


def parse_override(text: str) -> tuple[tuple[str, ...], Any]:
    """`phy.sample_rate=2e5` as (("phy", "sample_rate"), 200000.0).

    :raises ConfigError: when it has no `=`, an empty key, or a value that is no YAML
    """
    key, equals, value = text.partition("=")
    keys = tuple(part.strip() for part in key.split("."))
    if not equals or not all(keys):
        raise ConfigError(f"--set {text}: write key=value, with dots between nested keys")
    value = value.strip()
    if _NUMBER.fullmatch(value):  # YAML 1.1 takes 2e5 for a string
        return keys, float(value)
    try:
        parsed = yaml.safe_load(value) if value else ""
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {text}: the value is no YAML ({' '.join(str(error).split())})") from error
    # Without braces a mapping was not meant: the colon belongs to a text such as bag:PATH.
    return keys, value if isinstance(parsed, dict) and not value.startswith("{") else parsed


def _replace(values: dict[str, Any], keys: tuple[str, ...], value: Any, override: str) -> None:
    for depth, key in enumerate(keys[:-1], start=1):
        inner = values.get(key, {})
        if not isinstance(inner, Mapping):
            raise ConfigError(f"--set {override}: {'.'.join(keys[:depth])} has no settings below it")
        values[key] = dict(inner)
        values = values[key]
    values[keys[-1]] = value


def _builtin_names() -> list[str]:
    return [path.stem for path in BUILTIN_DIR.glob("*.yaml")]


def _is_builtin(name: str) -> bool:
    return name in _builtin_names()
