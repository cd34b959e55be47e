"""The robots of a scenario as they run, in real and simulated time: how each starts, and who hears whom.

Invariants: a robot that both sends and receives has one endpoint; starts are not counted, because no robot exists
longer than its run.
"""

from __future__ import annotations

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.core.tuning import Tuning
from gr_ros2.gr.factory import Start, keys_of_run
from gr_ros2.link.air import Air
from gr_ros2.link.airtime_limit import sustained
from gr_ros2.mac import access_of
from gr_ros2.phy import PHY, Phy
from gr_ros2_lab.medium.base import FixedPaths, Surroundings
from gr_ros2_lab.medium.gains import at_gains
from gr_ros2_lab.medium.measured import measured_channel
from gr_ros2_lab.medium.positions import Motion, Positions
from gr_ros2_lab.run.load import source_names
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.run.task_run import TaskRun
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.recorded_motion import RecordedMotion
from gr_ros2_lab.sim.world import World
from gr_ros2_lab.survey.table import Survey


def start_of_run(scenario: Scenario) -> Start:
    """The start of every robot of a run."""
    return Start(scenario.seed + 1, keys_of_run(scenario.first))


def air_of_run(scenario: Scenario, phy: Phy, tuning: Tuning = Tuning()) -> Air:
    """What the endpoints of all robots of a run know of their radios."""
    return Air(
        hears=scenario.reports,
        half_duplex=scenario.duplex == "half",
        any_length=phy.any_length,
        mcs_table=phy.mcs_table,
        access=access_of(scenario.medium, phy.airtime(), scenario.seed, tuning=tuning),
        relay=scenario.relay == "gain",
        airtime_s=phy.airtime(),
        airtime_share=sustained(scenario.airtime.rule),
    )


def surroundings(scenario: Scenario, sample_rate: float, task: TaskRun | None = None) -> Surroundings:
    """Who hears whom among the robots of a scenario.

    :param sample_rate: samples/s, which is the bandwidth of the noise
    :param task: moves them; None, where the scenario has one: as they move if they hear nothing
    :raises ConfigError: where levels follow from positions that nothing tells, or from what no link in real time has
    """
    robots = scenario.all_robots
    samples = PHY.load(scenario.phy.name).has_samples
    paths, levels = [robot.paths for robot in robots], [robot.levels for robot in robots]

    def places(survey: Survey) -> Motion:
        return _motion(scenario, task, stands=survey.begin[2:])[0]

    if (measured := measured_channel(scenario.channel, paths, places, samples=samples)) is not None:
        return measured
    if not scenario.channel.from_positions:
        return FixedPaths(at_gains(paths, scenario.gains_db, levels, sample_rate))
    # The losses of a path are measured at levels that its channel must be able to have.
    bare = [[path.bare for path in heard] for heard in paths]
    motion, world = _motion(scenario, task)
    return Positions(scenario.channel, motion, sample_rate, *zip(*levels, strict=True), paths=bare, world=world)


def hearer_of(around: Surroundings, sender: int) -> int:
    """The first robot that may hear one, which stands for all who do; itself where none does."""
    return next(iter(around.reached(sender)), sender)


def _motion(scenario: Scenario, task: TaskRun | None, stands: Floats | None = None) -> tuple[Motion, World | None]:
    """Where the robots of a scenario are, and among which obstacles.

    :param stands: where a robot is of which a recording tells nothing, m; None: where the first robot set out
    """
    if scenario.task:
        task = task or TaskRun(scenario, scenario.load_registry())
        return task.at, task.world
    named = [robot.namespace if robot.config.sends else None for robot in scenario.all_robots]
    if scenario.bag_path is not None:
        topics = source_names(scenario.first, scenario.load_registry())
        recorded = RecordedMotion(
            scenario.bag_path, named, speed=scenario.bag_speed or 1.0, topics=topics, stands=stands
        )
        return recorded.at, None
    fleet = Fleet.of(scenario.sim)
    free = [f"/robot_{number}" for number in fleet.robot_ids if f"/robot_{number}" not in named]
    places = [name or (free.pop(0) if free else "/") for name in named]
    numbers = {f"/robot_{number}": number for number in fleet.robot_ids}
    for name in places:
        if name not in numbers:
            raise ConfigError(
                f"channel.from = 'positions': {name} is none of the {len(numbers)} simulated robots, so nobody knows "
                f"where it is; set sim.robots to {len(named)} or more, and namespaces /robot_1, /robot_2, …"
            )
    ids = [numbers[name] for name in places]
    return (lambda now: fleet.at(now, ids)), fleet.world
