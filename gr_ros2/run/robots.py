"""The robots of a scenario: the settings of each, and what lies between them, in real and simulated time.

Invariants: a robot that both sends and receives has one endpoint; a receiver that reports has a source id of its own;
starts are not counted, because no robot exists longer than its run; the robots that offer messages come first, in the
order of :meth:`Scenario.directions`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.factory import EndpointSetup, keys_of_run
from gr_ros2.link.airtime_limit import sustained
from gr_ros2.link.rate import Mcs
from gr_ros2.mac import access_of
from gr_ros2.medium.base import FixedPaths, Path, Surroundings
from gr_ros2.medium.gains import paths_between
from gr_ros2.medium.positions import Motion, Positions
from gr_ros2.run.load import source_names
from gr_ros2.run.scenario import RobotConfig, Scenario
from gr_ros2.run.task_run import TaskRun
from gr_ros2.settings.config import ChannelConfig, ScenarioChannel, SinkConfig, SourceConfig
from gr_ros2.settings.fields import AUTO
from gr_ros2.sim.fleet import Fleet
from gr_ros2.sim.recorded_motion import RecordedMotion
from gr_ros2.sim.world import World
from gr_ros2.wire import BROADCAST

Halves = tuple[SourceConfig | None, SinkConfig | None]
"""The settings of a robot's sending half and of its receiving half; None for a half that it does not have."""


def start_of_run(
    ways: Sequence[Scenario],
    *,
    any_length: bool,
    mcs_table: Sequence[Mcs] = (),
    half_duplex: bool = False,
    airtime_s: float = 0.0,
) -> EndpointSetup:
    """The start of every robot of a run.

    :param ways: one scenario per direction
    :param any_length: whether the PHY carries shorter packets in less time
    :param mcs_table: see :attr:`gr_ros2.phy.Phy.mcs_table`
    :param half_duplex: whether all robots use one channel
    :param airtime_s: of the longest packet
    """
    answered = _answered(ways)
    return EndpointSetup(
        ways[0].seed + 1,
        keys=keys_of_run(ways[0].ros_source),
        reports=answered,
        half_duplex=half_duplex,
        any_length=any_length,
        mcs_table=mcs_table,
        access=access_of(ways[0].medium, airtime_s, ways[0].seed),
        relay=ways[0].relay == "gain",
        airtime_share=sustained(ways[0].airtime.rule),
    )


def halves_of_robots(ways: Sequence[Scenario]) -> list[Halves]:
    """The settings of all robots. With one direction, the first sends and the others receive.

    :param ways: one scenario per direction
    """
    forward = ways[0]
    if len(ways) > 1:
        sinks = [way.ros_sink for way in ways]
        if len(ways) == 2:
            sinks.reverse()  # each block is configured with the direction that it belongs to
        return [(way.ros_source, sink) for way, sink in zip(ways, sinks, strict=True)]
    halves: list[Halves] = [(forward.ros_source, None)]
    own_id = forward.ros_source.src_id()
    for number in range(1 + len(forward.receivers)):
        sink = forward.ros_sink
        if _answered(ways) and sink.robot_id in (AUTO, own_id):
            sink = replace(sink, robot_id=_free_id(own_id, number))
        halves.append((None, sink))
    return halves


def surroundings(scenario: Scenario, sample_rate: float, task: TaskRun | None = None) -> Surroundings:
    """Who hears whom among the robots of a scenario.

    :param sample_rate: samples/s, which is the bandwidth of the noise
    :param task: moves them; None, where the scenario has one: as they move if they hear nothing
    :raises ConfigError: where levels follow from positions that nothing tells, or from what no link in real time has
    """
    if not scenario.simulated:
        shares = scenario.duplex == "half"
        for key, wanted, alone in (
            ("duplex", shares and not scenario.robots, "full"),
            ("channel.from", scenario.channel.from_positions and not shares, "settings"),
        ):
            if wanted:
                raise ConfigError(
                    f"{key}: time = {scenario.time!r} has that for robots with duplex = 'half' alone; set both, or "
                    f"time to packets or samples, or leave it {alone}"
                )
    fixed = _between(scenario, sample_rate) if scenario.robots else _directed(scenario)
    return _placed(scenario, fixed, sample_rate, task) if scenario.channel.from_positions else FixedPaths(fixed)


def _placed(scenario: Scenario, paths: Sequence[Sequence[Path]], sample_rate: float, task: TaskRun | None) -> Positions:
    """The robots of a scenario where they are."""
    channel = scenario.channel
    # The losses of a path are measured at levels that its channel must be able to have.
    bare = [[replace(path, channel=_on_the_way(path.channel)) for path in heard] for heard in paths]
    robots = scenario.robots or (RobotConfig(),) * len(paths)
    motion, world = _motion(scenario, len(paths), task)
    return Positions(
        channel,
        motion,
        sample_rate,
        *zip(*(channel.levels(robot) for robot in robots), strict=True),
        paths=bare,
        world=world,
    )


def _on_the_way(channel: ChannelConfig) -> ChannelConfig:
    return channel.on_the_way if isinstance(channel, ScenarioChannel) else channel


def _motion(scenario: Scenario, count: int, task: TaskRun | None) -> tuple[Motion, World | None]:
    """Where the robots of a scenario are, and among which obstacles."""
    if scenario.task:
        task = task or TaskRun(scenario, scenario.load_registry())
        return task.at, task.world
    named: list[str | None] = [way.ros_source.namespace for way in scenario.directions()]
    named += [None] * (count - len(named))
    if scenario.bag_path is not None:
        topics = source_names(scenario, scenario.load_registry())
        recorded = RecordedMotion(scenario.bag_path, named, speed=scenario.bag_speed or 1.0, topics=topics)
        return recorded.at, None
    fleet = Fleet.of(scenario.sim)
    free = [f"/robot_{number}" for number in fleet.robot_ids if f"/robot_{number}" not in named]
    places = [name or (free.pop(0) if free else "/") for name in named]
    numbers = {f"/robot_{number}": number for number in fleet.robot_ids}
    for name in places:
        if name not in numbers:
            raise ConfigError(
                f"channel.from = 'positions': {name} is none of the {len(numbers)} simulated robots, so nobody knows "
                f"where it is; set sim.robots to {count} or more, and namespaces /robot_1, /robot_2, …"
            )
    ids = [numbers[name] for name in places]
    return (lambda now: fleet.at(now, ids)), fleet.world


def _between(scenario: Scenario, sample_rate: float) -> list[list[Path]]:
    """The paths between robots that all send and receive."""
    levels = [scenario.channel.levels(robot) for robot in scenario.robots]
    return paths_between(scenario.channel, scenario.gains_db, levels, sample_rate)


def _directed(scenario: Scenario) -> list[list[Path]]:
    """The paths of the short forms: one sender and its receivers, or two robots."""
    ways = scenario.directions()
    if len(ways) > 1:
        return [[Path(1 - number, way.channel)] for number, way in enumerate(ways)]
    forward = [Path(number, channel) for number, channel in enumerate((scenario.channel, *scenario.receivers), 1)]
    if scenario.reports is None:
        return [forward, *([] for _ in forward)]
    delay_s = scenario.reports.delay_s
    return [forward, *([Path(0, channel, delay_s)] for channel in scenario.report_channels())]


def ears_of(scenario: Scenario, around: Surroundings) -> list[list[int]]:
    """For each recorder of a run the robots whose packets it counts: first that of the result, then those of further
    receivers. Two robots share one recorder; each of several has its own, for the robots that it can hear, or for all
    where messages are relayed."""
    ways = len(scenario.directions())
    if ways <= 2:
        return [list(range(ways)) for _ in range(1 + len(scenario.receivers))]
    if scenario.relay != "off":
        return [[number for number in range(ways) if number != receiver] for receiver in range(ways)]
    heard: list[list[int]] = [[] for _ in range(ways)]
    for number in range(ways):
        for receiver in around.reached(number):
            heard[receiver].append(number)
    return heard


def recorder_of(scenario: Scenario, robot: int) -> int:
    """The place in :func:`ears_of` of the recorder of what a robot receives."""
    if scenario.robots:
        return robot if len(scenario.robots) > 2 else 0
    return 0 if scenario.back is not None else max(robot - 1, 0)


def _answered(ways: Sequence[Scenario]) -> bool:
    return len(ways) > 1 or ways[0].reports is not None


def _free_id(taken: int, number: int) -> int:
    """A source id for a receiver that reports and has no id of its own."""
    return BROADCAST - 1 - number - (BROADCAST - 1 - number <= taken)
