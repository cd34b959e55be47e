"""Scenarios: one experiment as one YAML file, with single settings replaced on the command line.

Invariants: settings that must be equal at both ends of the link (`registry`, `packet_len`) are given once, at the top
level, and apply to all ends; `source` names where messages come from, `ros_source` and `ros_sink` configure the two
blocks; what runs a scenario reads its `all_robots`, never the short forms `back`, `reports` and `receivers`; `dump`
gives a mapping from which `scenario_from` makes the same scenario again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import Field, TypeAdapter, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY
from gr_ros2.settings.config import (
    LEVELS,
    STRICT,
    AnyLink,
    Decibels,
    ScenarioChannel,
    Seconds,
    Traffic,
    build,
)
from gr_ros2.settings.effect import ActsWhere, refuse_without_effect
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.files import ENDS, SHARED_KEYS, read_settings, with_shared
from gr_ros2.settings.registry import Registry, check_outputs
from gr_ros2.wire import BROADCAST
from gr_ros2_lab.run.builtin import SCENARIO_DIR, builtin_scenarios
from gr_ros2_lab.run.robot_settings import Back, Reports, RobotConfig, RobotSettings, all_to_all, both_ways, one_way
from gr_ros2_lab.sim.sim_settings import SimSettings

_GRAPH_KEYS = ("middleware", "domain_id")
"""Settings of a block that say on which ROS graph it is."""
_OWN_KEYS = ("namespace", "robot_id", "dst_id", *_GRAPH_KEYS)
"""Settings of a block that belong to its robot. The reverse direction does not take them over."""
_BACK_SEED = 100_003
"""Difference between the channel seeds of the two directions. It is larger than between any two repetitions."""


_T = TypeVar("_T")
Time = Literal["real", "unthrottled", "samples", "packets"]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Experiment:
    """What is run, once or several times.

    :param description: one line
    :param repetitions: runs, with seeds seed, seed + 1, ...; in a sweep of every cell
    :param time: what the clock of a run follows. `real`: the wall clock, packets pass at the pace of the air;
        `unthrottled`: the wall clock, packets pass as fast as the flowgraph runs, which measures its speed; `samples`:
        simulated time, as the samples of the flowgraph tell it, as fast as it can be computed; `packets`: simulated
        time of the packets alone, which are lost as measured on the flowgraph (docs/explanation/simulated-time.md).
        Simulated time has no ROS graphs, so what says how one is joined (`middleware`, domains, depths of subscriptions
        and publishers, `backpressure`, `use_sim_time`, `debug`) has no effect there
    """

    description: str = ""
    repetitions: Annotated[int, Field(ge=1, le=10_000)] = 1
    time: Time = "real"


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Scenario(Experiment, Traffic, AnyLink):
    """One experiment: input -> ROS Source -> PHY and channel -> ROS Sink -> output, and for how long.

    :param drain_s: s the link may go on delivering after ``duration_s``
    :param bag_speed: playback speed of a bag, 1 as recorded, 0 as fast as the link takes it
    :param sim: settings of the simulator, which a recording does not need; its seed is the scenario's unless given
    :param back: the reverse direction, where both robots talk; null = one way only
    :param reports: the reverse direction for reports alone (version 1); null = there is none
    :param receivers: channels of further receivers of the same sender; what is not set in one is as in ``channel``, but
        for the seed
    :param robots: robots that all send and receive, in real time each with a ROS graph of its own; a number stands for
        as many that differ in their names alone
    :param duplex: full = each robot sends on a channel of its own, and hears while it sends; half = all use one
        channel: who sends hears nothing meanwhile, and packets that overlap at a receiver disturb each other
    :param gains_db: gain from one robot to another, dB: one number for all, or a row for each robot (without ``robots``
        first that of ``ros_source``) with a number for each other, null where nothing arrives. Level and noise then
        follow from transmit power, noise figure and ``phy.sample_rate``; null = ``channel.snr_db`` between all
    :param task: what the robots do on what they hear of each other: `formation`, `rendezvous`, or `module:Class`, a
        subclass of :class:`gr_ros2_lab.sim.tasks.Task`; '' = each drives its own ways
    :param controller: who drives the robots of a task. `task`: the task itself; `ros`: a node on the graph of each
        robot, by ``cmd_vel`` (in real time)
    :param own_domains: ends whose ``domain_id`` is auto are on ROS domains that no other program of this computer uses;
        false = they are on ROS_DOMAIN_ID
    :param seed: of the simulator, the channel and the sender
    """

    drain_s: Seconds = 2.0
    bag_speed: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    sim: SimSettings = Field(default_factory=SimSettings)
    back: Back | None = None
    reports: Reports | None = None
    channel: ScenarioChannel = Field(default_factory=ScenarioChannel)
    receivers: tuple[ScenarioChannel, ...] = ()
    robots: Annotated[tuple[RobotConfig, ...], Field(max_length=BROADCAST)] = ()
    duplex: Literal["full", "half"] = "full"
    gains_db: Decibels | tuple[tuple[Decibels | None, ...], ...] | None = None
    task: str = ""
    controller: Literal["task", "ros"] = "task"
    localhost_only: bool | Auto = True
    own_domains: bool = True
    conditions: ClassVar[Any] = (
        ActsWhere(
            ("bag_speed",),
            lambda scenario: scenario.source != "sim",
            "the simulator plays no recording; leave it out, or set source: bag:PATH",
        ),
        ActsWhere(("state",), lambda _: False, "a run counts no starts of its robots; leave it out"),
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
        for key, name, table in (
            ("ros_source.middleware", self.ros_source.middleware, MIDDLEWARE),
            ("ros_sink.middleware", self.ros_sink.middleware, MIDDLEWARE),
            ("phy.name", self.phy.name, PHY),
        ):
            if name not in table:
                raise ValueError(f"{key} = {name!r}: no such {table.family}; known are {', '.join(table)}")
        if self.back is not None:
            self._check_back(self.back)
        if self.reports is not None and (not self.version or self.back is not None):
            raise ValueError("reports: version 0 has none, and with back they go along; set reports to null")
        if self.receivers and self.back is not None:
            raise ValueError("receivers: a two-way scenario has one receiver each way; leave back or receivers out")
        if self.medium != "exclusive" and self.duplex != "half":
            raise ValueError(f"medium = {self.medium!r}: each robot has a channel of its own; set duplex: half")
        if self.airtime.rule is not None and self.time == "unthrottled":
            raise ValueError("airtime: packets take no airtime with time = 'unthrottled'; set time to real, or packets")
        if self.airtime.listen_before_send:
            raise ValueError("airtime.listen_before_send: no receiver of a run measures power; leave it to live links")
        self._check_robots()
        self._check_positions()
        return self

    def _check_positions(self) -> None:
        others = [part.channel for part in (self.back, self.reports) if part is not None]
        for name in ScenarioChannel.__annotations__:
            if any(getattr(channel, name) != getattr(self.channel, name) for channel in (*others, *self.receivers)):
                key = f"channel.{name.removesuffix('_')}"
                raise ValueError(f"{key}: one world has one; give it in channel alone, not under back or receivers")
        placed, gains = self.channel.from_positions, self.gains_db is not None
        if (placed or gains) and not PHY.load(self.phy.name).has_samples:
            key = "channel.from = 'positions'" if placed else "gains_db"
            raise ValueError(f"{key}: phy {self.phy.name} has no samples, so no level; choose another")
        if not placed:
            return
        if gains:
            raise ValueError("gains_db: levels follow from positions; leave it out, or set channel.from: settings")
        if self.channel.walls_db and self.bag_path is not None:
            raise ValueError("channel.walls_db: a recording has no world to count walls in; leave it out")

    def _check_robots(self) -> None:
        if self.task and (not self.robots or self.time == "samples"):
            raise ValueError(
                f"task = {self.task!r}: robots act on what they hear in real time or at packets; set robots, and time: "
                "real or packets"
            )
        matrix, count = self.gains_db, len(self.robots) or 2 + len(self.receivers)
        if isinstance(matrix, tuple) and [len(row) for row in matrix] != [count] * count:
            raise ValueError(f"gains_db: {count} robots need {count} rows of {count} numbers")
        if not self.robots:
            return
        if not self.simulated:
            self._check_live_robots()
        if self.source != "sim" or self.back is not None or self.reports is not None or self.receivers:
            raise ValueError("robots: they all send and receive; set source to sim, leave back, reports, receivers out")
        ids = {robot.ros_source.src_id() for robot in self.robots}
        if count < 2 or len(ids) < count:
            raise ValueError(
                f"robots: {count} robots with {len(ids)} source ids; two or more robots, each with its own"
            )

    def _check_live_robots(self) -> None:
        """Whether the robots fit the medium that carries them in real time."""
        own = [robot.ros_source.domain_id for robot in self.robots]
        graphs = [domain for domain in own if domain != AUTO or not self.own_domains]
        if len(set(graphs)) < len(graphs):
            raise ValueError(
                "robots: each has a ROS graph of its own; set own_domains: true, or another domain_id for each"
            )
        if self.duplex == "full":
            return
        if self.time != "real":
            raise ValueError(
                f"robots: time = {self.time!r} with duplex = 'half': they share one channel at its pace; set time: real"
            )
        if not PHY.load(self.phy.name).has_samples:
            raise ValueError(
                f"robots: phy {self.phy.name} has no samples, which they share in real time; choose another"
            )
        if not self.version:
            raise ValueError("robots: on one channel in real time they need version 1; set version: 1")
        if self.channel.loses_packets:
            raise ValueError("channel: bursts cross as samples, so none is dropped whole; leave these settings out")

    def _check_back(self, back: Back) -> None:
        if self.source != "sim":
            raise ValueError(f"back: source = {self.source!r} speaks for one robot; two-way runs need source: sim")
        try:
            src_id = back.ros_source.src_id()
        except ConfigError as error:
            raise ValueError(f"back.ros_source: {error}") from error
        if src_id == self.ros_source.src_id():
            raise ValueError(
                f"back.ros_source: source id {src_id} is that of ros_source; set another namespace or robot_id"
            )

    @cached_property
    def all_robots(self) -> tuple[RobotSettings, ...]:
        """The robots of its runs, those included that short forms stand for. Those that offer messages come first."""
        if self.robots:
            leveled = self.gains_db is not None
            return all_to_all(self.robots, self.ros_sink, self.channel, leveled=leveled, seed=self.seed)
        if self.back is not None:
            return both_ways(self.ros_source, self.ros_sink, self.channel, self.back)
        return one_way(self.ros_source, self.ros_sink, (self.channel, *self.receivers), self.reports)

    @property
    def simulated(self) -> bool:
        """Whether its clock is simulated. A run then takes as long as its computation."""
        return self.time in ("samples", "packets")

    def load_registry(self) -> Registry:
        """The registry of both ends.

        :raises RegistryError: when the file is wrong; names file, line and problem
        :raises ConfigError: when a sink could not publish its topics, see
            :func:`gr_ros2.settings.registry.check_outputs`
        """
        registry = Registry.from_csv(self.registry)
        for way in (self, self.back):
            if way is not None:
                check_outputs(registry, way.ros_sink)
        return registry


def dump(scenario: Scenario) -> dict[str, Any]:
    """Every setting as JSON values, from which :func:`scenario_from` makes an equal scenario."""
    values: dict[str, Any] = TypeAdapter(Scenario).dump_python(scenario, mode="json", by_alias=True)
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
    :raises ConfigError: for an unknown key, a value out of range, or ends that disagree; names the key
    """
    values = dict(values)
    prefix = f"{where}: " if where else ""
    shared = {key: values[key] for key in SHARED_KEYS if key in values}
    values.update(with_shared(values, shared, prefix))
    for part in ("sim", "channel"):
        if isinstance(block := values.get(part, {}), Mapping) and "seed" in values:
            values[part] = {"seed": values["seed"], **block}
    channel = values.get("channel", {})
    if isinstance(channel, Mapping):
        if isinstance(reports := values.get("reports"), Mapping):
            values["reports"] = {**reports, "channel": _another(channel, reports.get("channel", {}), 1)}
        if isinstance(receivers := values.get("receivers"), list | tuple):
            values["receivers"] = [_another(channel, given, 2 + n) for n, given in enumerate(receivers)]
    robots = values.get("robots")
    count = robots if isinstance(robots, int) else len(robots) if isinstance(robots, list | tuple) else 0
    if count > BROADCAST:
        raise ConfigError(f"{prefix}robots = {count}: a robot has an id of 0..254; set up to {BROADCAST} robots")
    if isinstance(robots, int):
        robots = [{}] * robots
    if isinstance(robots, list | tuple):
        values["robots"] = [_robot(values, given, n, shared, prefix) for n, given in enumerate(robots, 1)]
        if isinstance(values.get("sim", {}), Mapping):
            values["sim"] = {"robots": max(len(robots), 1), **values.get("sim", {})}
    if isinstance(values.get("back"), Mapping):
        back = _way_back(values)
        values["back"] = {**back, **with_shared(back, shared, f"{prefix}back.")}
    return build(Scenario, values, where)


def _robot(values: Mapping[str, Any], given: Any, number: int, shared: Mapping[str, Any], prefix: str) -> Any:
    """The settings of a robot. Those of its block that it does not have are the scenario's."""
    block = given.get("ros_source", {}) if isinstance(given, Mapping) else None
    if not isinstance(block, Mapping) or not isinstance(values.get("ros_source", {}), Mapping):
        return given  # build() says what is wrong with it
    kept = {key: value for key, value in values.get("ros_source", {}).items() if key not in _OWN_KEYS}
    # The ids 0..254 are enough for 255 robots if the last one has the first id.
    last = {"robot_id": 0} if number == BROADCAST else {}
    source = {**kept, "namespace": f"/robot_{number}", **last, **block}
    block = with_shared({"ros_source": source}, shared, f"{prefix}robots[{number - 1}].")["ros_source"]
    return {**given, "ros_source": block}


def _way_back(values: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of ``back``. Settings that it does not have are taken over from the forward direction."""
    back = dict(values["back"])
    parts = {part: values.get(part, {}) for part in (*ENDS, "channel")}
    if not all(isinstance(part, Mapping) for part in (*parts.values(), *(back.get(name, {}) for name in parts))):
        return back  # build() says what is wrong with it
    for end, other in zip(ENDS, reversed(ENDS), strict=True):
        kept = {key: value for key, value in parts[end].items() if key not in _OWN_KEYS}
        graph = {key: parts[other][key] for key in _GRAPH_KEYS if key in parts[other]}
        back[end] = {**kept, **graph, **back.get(end, {})}
    back["channel"] = _another(parts["channel"], back.get("channel", {}), 1)
    return back


def _another(channel: Mapping[str, Any], given: Any, place: int) -> Any:
    """A further channel. Settings that are not given are as in the first channel, except for the seed."""
    if not isinstance(given, Mapping):
        return given  # build() says what is wrong with it
    seed = channel.get("seed", 0)
    own = {"seed": seed + place * _BACK_SEED} if isinstance(seed, int) else {}
    return {**channel, **own, **given}


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
    values.update((key, value) for key, value in settings.items() if value is not None)
    return scenario_from(values, str(name_or_path))
