"""What a run records of itself, in real time and in simulated time: one recorder for each receiver, because every
receiver has losses of its own, the team where robots share a channel, and the result that follows from them.

Invariant: each recorder gets the events of all senders, and those of its own receiver only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from gr_ros2.core.guard import Guard
from gr_ros2.link.events import Delivered, ReceiverEvent, SenderEvent
from gr_ros2.observe.observers import Change, LiveLink, LiveRun, RunObservers
from gr_ros2.observe.positions import position_reader
from gr_ros2.phy import Phy
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2_lab.medium.base import Surroundings
from gr_ros2_lab.record.recorder import Recorder
from gr_ros2_lab.record.result import ChangeResult, LatenessResult, ReceiverResult, Result
from gr_ros2_lab.record.team import TeamRecord
from gr_ros2_lab.record.trace import Trace
from gr_ros2_lab.run.load import published_names, source_names
from gr_ros2_lab.run.outcome import Outcome, phy_numbers
from gr_ros2_lab.run.robot_settings import senders_of
from gr_ros2_lab.run.scenario import Scenario, dump
from gr_ros2_lab.run.task_run import TaskRun

if TYPE_CHECKING:
    from gr_ros2.gr.sending import SendingBlock


def make_recorder(
    registry: Registry,
    senders: Sequence[RobotConfig],
    on_delivery: Callable[[Delivered, float, float | None], None] | None = None,
) -> Recorder:
    """The recorder of a run.

    :param senders: the robots whose messages it counts
    :param on_delivery: see :class:`gr_ros2_lab.record.recorder.Recorder`
    """
    return Recorder(
        registry,
        {robot.robot_id: robot.namespace for robot in senders},
        {robot.robot_id: source_names(robot, registry).values() for robot in senders},
        on_delivery=on_delivery,
    )


def make_team(registry: Registry, scenario: Scenario, phy: Phy) -> TeamRecord | None:
    """What follows the robots of a scenario that share a channel; None where they do not."""
    if scenario.duplex != "half":
        return None
    senders = senders_of(scenario.all_robots)
    readers = {
        (robot.robot_id, topic_id): reader
        for robot in senders
        for topic_id in source_names(robot, registry).values()
        if (reader := position_reader(registry[topic_id].type_name)) is not None
    }
    return TeamRecord([robot.robot_id for robot in senders], phy.airtime, readers)


def receivers_of(scenario: Scenario, around: Surroundings) -> dict[int, list[int]]:
    """The places of the robots that have a recorder, with those of the robots whose messages it counts. The first is
    that of the result. Two robots share one. Each of several that receive counts what it can hear, or messages of all
    where they are relayed."""
    robots = scenario.all_robots
    senders = [number for number, robot in enumerate(robots) if robot.config.sends]
    if len(robots) == 2:
        return {1: senders}
    relays, reached = scenario.relay != "off", {one: set(around.reached(one)) for one in senders}
    return {
        number: [one for one in senders if one != number and (relays or number in reached[one])]
        for number, robot in enumerate(robots)
        if robot.takes
    }


class RunRecords:
    """Who observes what of a run, and its result.

    :param around: who hears whom
    :param task: of robots that act on what they hear; is told what comes out of their links
    :param on_delivery: see :func:`make_recorder`; of what the first receiver gets
    """

    def __init__(
        self,
        scenario: Scenario,
        registry: Registry,
        phy: Phy,
        around: Surroundings,
        *,
        run_observers: RunObservers,
        task: TaskRun | None = None,
        on_delivery: Callable[[Delivered, float, float | None], None] | None = None,
    ) -> None:
        self._scenario, self._registry, self._phy = scenario, registry, phy
        self._config = dump(scenario)
        self._senders = senders = senders_of(scenario.all_robots)
        self.run_observers = run_observers
        receivers = receivers_of(scenario, around)
        self._places = {number: place for place, number in enumerate(receivers)}
        heard = [[senders[number] for number in numbers] for numbers in receivers.values()]
        self.recorder = make_recorder(registry, heard[0], on_delivery)
        self._recorders = [self.recorder, *(make_recorder(registry, others) for others in heard[1:])]
        self._guards = [Guard("Recorder", needed=True) for _ in self._recorders]
        self._hearing: dict[int, list[int]] = {robot.robot_id: [] for robot in senders}
        """Which recorders get what a robot sends; all that of one that offers nothing."""
        for place, others in enumerate(heard):
            for robot in others:
                self._hearing[robot.robot_id].append(place)
        self.team = make_team(registry, scenario, phy)
        self._changes: list[Change] = []
        self._task, self._acting = task, Guard(f"task {scenario.task}", needed=True)

    def of(self, number: int) -> RobotObserver:
        """What observes a robot.

        :param number: its place among the robots of the run
        """
        return RobotObserver(self, number, self._scenario.all_robots[number].robot_id, self.place(number))

    def place(self, number: int) -> int:
        """That of the recorder of what a robot receives; 0 = that of the result, which has reports to a sender too."""
        return self._places.get(number, 0)

    def sent(self, src_id: int, event: SenderEvent) -> None:
        for place in self._hearing.get(src_id, range(len(self._recorders))):
            self._guards[place](self._recorders[place].sender_event, src_id, event)
        self.run_observers.sender_event(src_id, event)
        if self.team is not None:
            self.team.sender_event(src_id, event)

    def received(self, robot: RobotObserver, event: ReceiverEvent, now: float) -> None:
        self._guards[robot.place](self._recorders[robot.place].receiver_event, event, now)
        if not robot.place:
            self.run_observers.receiver_event(event, now)
        if self.team is not None:
            self.team.receiver_event(robot.src_id, event, now)
        if self._task is not None and isinstance(event, Delivered):
            self._acting(self._task.delivered, robot.number, event, now)

    def live_run(
        self,
        clock: Callable[[], float] = time.monotonic,
        sources: Mapping[int, SendingBlock] | None = None,
        links: Sequence[LiveLink] = (),
        alarms: Callable[[], Sequence[str]] = tuple,
    ) -> LiveRun:
        """The run as its observers see it.

        :param sources, links, alarms: see :class:`LiveRun`; a run in simulated time has none
        """
        robots = self._scenario.all_robots
        first = robots[next(iter(self._places))].config.namespace
        # Two robots share a recorder; of more, what an observer sees is what the first one receives.
        seen_by = f", as {first or 'receiver 1'} receives it" if len(robots) > 2 else ""
        return LiveRun(
            name=self._scenario.name + seen_by,
            duration_s=self._scenario.duration_s,
            packet_len=self._scenario.packet_len,
            registry=self._registry,
            topics={
                (robot.robot_id, topic_id): name
                for robot in self._senders
                for name, topic_id in source_names(robot, self._registry).items()
            },
            sources=sources or {},
            links=links,
            fates=self.recorder.ledger.fates,
            clock=clock,
            airtime=self._phy.airtime if self._phy.has_airtime else None,
            alarms=alarms,
            team=None if self.team is None else self.team.view,
            heard=None
            if len(robots) == 2
            else frozenset(src_id for src_id, places in self._hearing.items() if 0 in places),
            changed=self._changes.append,
        )

    def check(self) -> None:
        """:raises GrRos2Error: if a recorder has failed, see :meth:`gr_ros2.core.guard.Guard.check`"""
        for guard in (*self._guards, self._acting):
            guard.check()

    def progress(self) -> tuple[int, int]:
        """Messages sent and delivered so far, at all receivers together."""
        sent, delivered = zip(*(recorder.progress() for recorder in self._recorders), strict=True)
        return sum(sent), sum(delivered)

    def unresolved(self) -> int:
        """Messages whose result is open, at all receivers together."""
        return sum(recorder.ledger.unresolved() for recorder in self._recorders)

    def outcome(
        self,
        *,
        begin: float,
        end: float,
        played: float,
        drained: bool,
        channels: int,
        began: float,
        lateness: Callable[[Trace], LatenessResult | None] = lambda _: None,
        **rest: Any,
    ) -> Outcome:
        """Close the ledgers and compute the result.

        :param begin, end: s on the run's clock, when submission began and ended
        :param played: s during which messages were submitted
        :param drained: see :meth:`gr_ros2_lab.record.recorder.Recorder.finish`
        :param channels: how many the robots used
        :param began: s, monotonic, when the run was started
        :param rest: further fields of the result
        """
        topics = self.recorder.finish(played, end, drained)
        names = {
            name: other
            for robot in self._senders
            for name, other in published_names(self._scenario, robot, self._registry).items()
        }
        trace = self.recorder.trace(begin, end, names)
        numbers = partial(phy_numbers, self._phy, channels)
        result = Result(
            scenario=self._scenario.name,
            seed=self._scenario.seed,
            duration_s=played,
            config=self._config,
            topics=topics,
            receivers=tuple(
                ReceiverResult(
                    number,
                    recorder.finish(played, end, drained),
                    self._scenario.all_robots[robot].namespace,
                    packets=recorder.ledger.packets(),
                    phy=numbers(recorder),
                )
                for number, (recorder, robot) in enumerate(zip(self._recorders, self._places, strict=True), 1)
                if number > 1
            ),
            packets=self.recorder.ledger.packets(),
            phy=numbers(self.recorder),
            wall_s=time.monotonic() - began,
            lateness=lateness(trace),
            task={} if self._task is None else self._task.numbers(played),
            changes=tuple(ChangeResult(at - begin, setting, value) for at, setting, value in self._changes),
            **rest,
        )
        return Outcome(result, trace, self.team)


@dataclass(frozen=True)
class RobotObserver:
    """Passes on what one robot sends and receives.

    :param number: its place among the robots of the run
    :param src_id: -1 for none
    :param place: of its recorder
    """

    records: RunRecords
    number: int
    src_id: int
    place: int

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        self.records.sent(src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        self.records.received(self, event, now)
