"""Scenarios: one experiment as one YAML file, with single settings replaced on the command line.

Invariants: a scenario is robots, a medium between them, and what is sent; what all robots share stands above them in
the file, and is a setting of each in a :class:`Scenario`; ``dump`` gives a mapping from which ``scenario_from`` makes
the same scenario again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import Field, TypeAdapter, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.backends import BackendTable
from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.paper.settings import PaperConfig, check, check_rows
from gr_ros2.phy import PHY
from gr_ros2.settings.config import (
    LEVELS,
    STRICT,
    AirConfig,
    PathConfig,
    Reach,
    Seconds,
    Traffic,
    build,
)
from gr_ros2.settings.effect import ActsWhere, refuse_without_effect
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.files import read_settings
from gr_ros2.settings.registry import Registry, check_outputs
from gr_ros2.settings.robot import ONE_RADIO, RobotConfig
from gr_ros2.wire import BROADCAST, FORMATS, Format
from gr_ros2_lab.run.builtin import SCENARIO_DIR, builtin_scenarios
from gr_ros2_lab.run.robot_settings import RobotSettings, ScenarioRobot, settings_of_all
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.sim.tasks import task_class

SHARED = tuple(item.name for item in fields(RobotConfig) if item.name != "robot")
"""Settings of robots that may stand above them."""
_EQUAL = ("packet_len", "registry", "key", "seal")
"""Those on which all robots have to agree."""

_T = TypeVar("_T")
Time = Literal["real", "samples", "packets"]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Experiment:
    """What is run, once or several times."""

    description: str = ""
    """one line"""
    repetitions: Annotated[int, Field(ge=1, le=10_000)] = 1
    """runs, with seeds one apart; in a sweep of every cell"""
    time: Time = "real"
    """what the clock follows: the wall clock, samples, or packets, which are lost as measured
    (docs/explanation/simulated-time.md). Only `real` has ROS graphs, on which `graph` and `publish.depth` act"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Scenario(Reach, Experiment, Traffic, AirConfig):
    """One experiment: robots, the medium between them, what they send, and for how long."""

    robots: Annotated[tuple[ScenarioRobot, ...], Field(max_length=BROADCAST)]
    """the robots, those that send first; or how many, which differ in their names alone"""
    paths: tuple[PathConfig, ...] = ()
    """the channels that differ: what is not set in one is as in ``channel``"""
    duplex: Literal["full", "half"] = "full"
    """full = each robot sends on a channel of its own; half = all use one, and packets that overlap disturb each
    other"""
    paper: PaperConfig | None = None
    """the robots are the paper's blocks; null = ROS Links"""
    drain_s: Seconds = 2.0
    """s the link may go on delivering after ``duration_s``"""
    bag_speed: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    """playback speed of a bag, 1 as recorded, 0 as fast as the link takes it"""
    sim: SimSettings = Field(default_factory=SimSettings)
    """settings of the simulator"""
    task: str = ""
    """what robots do on what they hear: `formation`, `rendezvous`, or `module:Class`, a subclass of
    :class:`gr_ros2_lab.sim.tasks.Task`; '' = each drives its own ways"""
    controller: Literal["task", "ros"] = "task"
    """who drives the robots: the task, or a node on each robot's graph, by ``cmd_vel`` (in real time)"""
    own_domains: bool = True
    """robots without `graph.domain_id` are on domains that no other program here uses; false = on ROS_DOMAIN_ID"""
    also: ClassVar[Any] = {RobotConfig: ("robot",)}
    """Settings of these may stand here too, but for some."""
    conditions: ClassVar[Any] = (
        ActsWhere(
            ("bag_speed",),
            lambda scenario: scenario.source != "sim",
            "the simulator plays no recording; leave it out, or set source: bag:PATH",
        ),
        ActsWhere(("robots.*.offer",), lambda _: False, "nobody asks for topics in a run; leave it out"),
        ActsWhere(("robots.*.topics.*.via",), lambda _: False, f"{ONE_RADIO}; leave it out"),
        ActsWhere(
            ("robots.*.backfill.topics",),
            lambda _: False,
            "no bag of a run takes what comes later; leave it out",
        ),
        ActsWhere(("robots.*.publish.stamps",), lambda _: False, "the robots of a run have one clock; leave it out"),
        ActsWhere(("robots.*.state",), lambda _: False, "a run counts no starts of its robots; leave it out"),
        ActsWhere(
            ("controller",),
            lambda scenario: scenario.task and scenario.time == "real",
            "stands in for that of a task in real time; set task and time: real",
        ),
        *LEVELS,
    )

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        refuse_without_effect(self)
        if self.source == "sim" and self.duration_s == 0:
            raise ValueError("duration_s = 0: the simulator has no end; set duration_s above 0")
        named: list[tuple[str, str, BackendTable[Any]]] = [("phy.name", self.phy.name, PHY)]
        named += [("graph.middleware", robot.graph.middleware, MIDDLEWARE) for robot in self.robots]
        for key, name, table in named:
            if name not in table:
                raise ValueError(f"{key} = {name!r}: no such {table.family}; known are {', '.join(table)}")
        if self.medium != "exclusive" and self.duplex != "half":
            raise ValueError(f"medium = {self.medium!r}: each robot has a channel of its own; set duplex: half")
        if self.medium != "exclusive" and self.paper is not None:
            raise ValueError(f"medium = {self.medium!r}: version 0 says nothing about slots; leave paper out")
        if self.airtime.listen_before_send:
            raise ValueError("airtime.listen_before_send: no receiver of a run measures power; leave it to live links")
        if self.airtime.rule is not None and any(robot.packet_rate == 0 for robot in self.robots):
            raise ValueError("packet_rate = 0: sends whatever airtime allows; set auto, or leave airtime out")
        self._check_robots()
        self.airtime.check_seal(encrypts=bool(self.key) and self.robots[0].seal == "encrypt")
        if self.paper is not None:
            for robot in self.robots:
                check(robot, self.paper)
        elif self.packet_len < (least := self.wire_format.min_packet_len):
            raise ValueError(f"packet_len = {self.packet_len}: robots need at least {least}")
        self._check_positions()
        self.all_robots  # noqa: B018 - says what does not go together
        return self

    def _check_positions(self) -> None:
        placed, gains = self.channel.from_positions, self.gains_db is not None
        if (placed or gains) and not PHY.load(self.phy.name).has_samples:
            key = "channel.from = 'positions'" if placed else "gains_db"
            raise ValueError(f"{key}: phy {self.phy.name} has no samples, so no level; choose another")
        if gains and any(path.trace for path in self.paths):
            raise ValueError("gains_db: levels follow from the trace; leave one of them out")
        if not placed:
            return
        if self.channel.walls_db and self.bag_path is not None:
            raise ValueError("channel.walls_db: a recording has no world to count walls in; leave it out")

    def _check_robots(self) -> None:
        robots, count = self.robots, len(self.robots)
        numbers = [robot.robot_id for robot in robots]
        if count < 2:
            raise ValueError(f"robots: {count} of them; a scenario has two or more")
        if twice := sorted({number for number in numbers if numbers.count(number) > 1}):
            raise ValueError(f"robots: two are robot {twice[0]}; give each a number of its own")
        for name in _EQUAL:
            if len({getattr(robot, name) for robot in robots}) > 1:
                raise ValueError(f"{name}: all robots have to agree on it; set it above robots")
        sends = [robot.sends for robot in robots]
        if not any(sends):
            raise ValueError("robots: none sends anything; set topics of the first one")
        if sends != sorted(sends, reverse=True):
            raise ValueError("robots: one that sends nothing stands before one that does; name those that send first")
        if self.source != "sim" and sum(sends) > 1:
            raise ValueError(
                f"robots: source = {self.source!r} speaks for one robot; set topics: [] of the others, or source: sim"
            )
        for path in self.paths:
            for number in (path.from_, path.to):
                if number is not None and number not in numbers:
                    raise ValueError(f"paths: there is no robot {number}; there are {', '.join(map(str, numbers))}")
        if self.task and (not all(sends) or self.time == "samples"):
            task_class(self.task)  # that there is no such task is said first
            raise ValueError(
                f"task = {self.task!r}: robots act on what they hear in real time or at packets; set time: real or "
                "packets, and let all of them send"
            )
        self.check_levels(count)
        if not self.simulated:
            self._check_live_robots()

    def _check_live_robots(self) -> None:
        """Whether the robots fit the medium that carries them in real time."""
        for sender in self.robots:
            graphs = [
                robot.graph.domain_id
                for robot in self.robots
                if robot is not sender and robot.receives and not (robot.graph.domain_id == AUTO and self.own_domains)
            ]
            if sender.sends and len(set(graphs)) < len(graphs):
                raise ValueError(
                    f"robots: what robot {sender.robot_id} sends comes out twice on one ROS graph; set own_domains: "
                    "true, or another graph.domain_id for each"
                )
        if self.duplex == "half" and not PHY.load(self.phy.name).has_samples:
            raise ValueError(
                f"robots: phy {self.phy.name} has no samples, which they share in real time; choose another"
            )

    @cached_property
    def all_robots(self) -> tuple[RobotSettings, ...]:
        """The robots of its runs. Those that offer messages come first."""
        return settings_of_all(
            self.robots,
            self.channel,
            self.paths,
            shared=self.duplex == "half",
            leveled=self.gains_db is not None,
            seed=self.seed,
        )

    @property
    def first(self) -> RobotConfig:
        """The first robot, which sends."""
        return self.robots[0]

    @property
    def wire_format(self) -> Format:
        """The wire format in which its robots write packets."""
        return FORMATS[1 if self.paper is None else 0]

    @property
    def compresses(self) -> bool:
        """Whether messages are coded."""
        return self.first.compression if self.paper is None else self.paper.compression

    @property
    def packet_len(self) -> int:
        """Bytes of the longest packet."""
        return self.robots[0].packet_len

    @property
    def registry(self) -> str:
        """File of the topics of all robots."""
        return self.robots[0].registry

    @property
    def key(self) -> str:
        """File of the keys of all robots."""
        return self.robots[0].key

    @property
    def reports(self) -> bool:
        """Whether a robot that sends messages may hear from a robot that receives them."""
        return any(robot.takes and robot.paths for robot in self.all_robots)

    @property
    def simulated(self) -> bool:
        """Whether its clock is simulated. A run then takes as long as its computation."""
        return self.time in ("samples", "packets")

    def load_registry(self) -> Registry:
        """The registry of all robots.

        :raises RegistryError: when the file is wrong; names file, line and problem
        :raises ConfigError: when a sink could not publish its topics, see
            :func:`gr_ros2.settings.registry.check_outputs`
        """
        if not self.registry:
            raise ConfigError("registry is missing; a scenario names the topics of its robots, as table4 does")
        registry = Registry.from_csv(self.registry)
        for robot in self.all_robots:
            if robot.takes:
                check_outputs(registry, robot.config.publish, announced=self.paper is None)
        if self.paper is not None:
            check_rows(registry)
        return registry


def dump(scenario: Scenario) -> dict[str, Any]:
    """Every setting as JSON values, from which :func:`scenario_from` makes an equal scenario. What all robots have in
    common stands above them."""
    values: dict[str, Any] = TypeAdapter(Scenario).dump_python(scenario, mode="json", by_alias=True)
    first, *others = values["robots"]
    for name in SHARED:
        if all(robot[name] == first[name] for robot in others):
            values[name] = first[name]
            for robot in values["robots"]:
                del robot[name]
    return values


def changed(scenario: Scenario, kind: type[_T] | tuple[type[_T], ...], change: Callable[[_T], _T]) -> Scenario:
    """The scenario with every part of a kind changed, of all its robots: all sources, for instance, or all channels.

    :param kind: a class of settings, or several; those with parts of this kind may be of it too
    """

    def inside(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(inside(one) for one in value)
        if not is_dataclass(value) or isinstance(value, type):
            return value
        value = replace(value, **{item.name: inside(getattr(value, item.name)) for item in fields(value)})
        return change(value) if isinstance(value, kind) else value

    made: Scenario = inside(scenario)
    return made


def scenario_from(values: Mapping[str, Any], where: str = "") -> Scenario:
    """Make a scenario from a mapping.

    :param where: name of the mapping in errors, for instance its file name
    :raises ConfigError: for an unknown key, a value out of range, or robots that disagree; names the key
    """
    values = dict(values)
    shared = {name: values.pop(name) for name in SHARED if name in values}
    build(RobotConfig, {"robot": 1, **shared}, where)  # says what is wrong once, rather than for each robot
    for part in ("sim", "channel"):
        if isinstance(block := values.get(part, {}), Mapping) and "seed" in values:
            values[part] = {"seed": values["seed"], **block}
    channel = values.get("channel", {})
    if isinstance(channel, Mapping) and isinstance(paths := values.get("paths"), list | tuple):
        among = {item.name for item in fields(PathConfig)} - {"from_"}
        kept = {name: value for name, value in channel.items() if name in among}
        values["paths"] = [{**kept, **path} if isinstance(path, Mapping) else path for path in paths]
    robots = values.get("robots")
    if isinstance(robots, int) and not isinstance(robots, bool):
        if robots > BROADCAST:
            prefix = f"{where}: " if where else ""
            raise ConfigError(f"{prefix}robots = {robots}: a robot has an id of 0..254; set up to {BROADCAST} robots")
        robots = [{}] * robots
    if isinstance(robots, list | tuple):
        values["robots"] = [_robot(shared, given, n) for n, given in enumerate(robots, 1)]
        if isinstance(values.get("sim", {}), Mapping):
            values["sim"] = {"robots": max(len(robots), 1), **values.get("sim", {})}
    return build(Scenario, values, where)


def _robot(shared: Mapping[str, Any], given: Any, number: int) -> Any:
    """The settings of a robot. Those that it does not have are as above the robots."""
    if not isinstance(given, Mapping):
        return given  # build() says what is wrong with it
    merged = {**shared, **given}
    for part in ("graph", "publish"):
        above, own = shared.get(part, {}), given.get(part, {})
        if isinstance(above, Mapping) and isinstance(own, Mapping):
            merged[part] = {**above, **own}
    if isinstance(merged["graph"], Mapping):
        merged["graph"] = {"localhost_only": True, **merged["graph"]}
    if "robot" not in given:  # the numbers 0..254 are enough for 255 robots if the last one has the first number
        merged["robot"] = f"/robot_{number}" if number < BROADCAST else 0
        if number == BROADCAST:
            merged["graph"] = {"namespace": f"/robot_{number}", **merged["graph"]}
    return merged


def load_scenario(name_or_path: str | Path, overrides: Sequence[str] = (), **settings: Any) -> Scenario:
    """Read a built-in scenario or a YAML file.

    :param name_or_path: name of a built-in scenario, otherwise the path of a file
    :param overrides: `key=value` with dotted keys and YAML values (`phy.sample_rate=2e5`), in this order
    :param settings: top-level settings that override all others; None leaves a setting as it is
    :raises ConfigError: when there is no such scenario, or a setting is wrong
    """
    path = SCENARIO_DIR / f"{name_or_path}.yaml"
    if str(name_or_path) not in builtin_scenarios():
        path = Path(name_or_path)
        if not path.is_file():
            raise ConfigError(
                f"scenario {str(name_or_path)!r} is neither a file nor built in; "
                f"built in are {', '.join(builtin_scenarios())}"
            )
    values = read_settings(path, overrides)
    given = {key: value for key, value in settings.items() if value is not None}
    values.update(given)
    scenario = scenario_from(values, str(name_or_path))
    if scenario.task:
        task_class(scenario.task)
    changed = [*overrides, *(f"{key}={value}" for key, value in given.items() if key not in _UNSPOKEN)]
    if _contradicted(changed):
        # To build it again for a text would take as long as the first time.
        object.__setattr__(scenario, "description", _described(scenario, changed))
    return scenario


_UNSPOKEN = frozenset(
    ("name", "description", "seed", "duration_s", "repetitions", "time", "drain_s", "bag_speed", "own_domains", "graph")
)
"""Settings of which no description of a scenario speaks."""


def _contradicted(overrides: Sequence[str]) -> bool:
    """Whether the description of a scenario may not be true any more."""
    return any(override.partition("=")[0].partition(".")[0].strip() not in _UNSPOKEN for override in overrides)


def _described(scenario: Scenario, overrides: Sequence[str]) -> str:
    phy, channel, robots = scenario.phy, scenario.channel, len(scenario.robots)
    rate = "" if phy.sample_rate == AUTO else f" at {phy.sample_rate:,.0f} samples/s"
    snr = "" if channel.snr_db is None else f", SNR {channel.snr_db:g} dB"
    lost = f", {channel.packet_loss:.0%} of the packets lost" if channel.packet_loss else ""
    shared = f", one channel, {scenario.medium}" if scenario.duplex == "half" else ""
    return f"{robots} robots, {phy.name}{rate}{snr}{lost}{shared}; {scenario.name} with {', '.join(overrides)}"
