"""What a run records of itself, in real time and in simulated time: one recorder for each receiver, because every
receiver has losses of its own, the team where robots share a channel, and the result that follows from them.

Invariant: each recorder gets the events of all senders, and those of its own receiver only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from gr_ros2.core.guard import Guard
from gr_ros2.link.events import Delivered, ReceiverEvent, SenderEvent
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.phy import Phy
from gr_ros2.record.positions import position_reader
from gr_ros2.record.recorder import Recorder
from gr_ros2.record.result import LatenessResult, ReceiverResult, Result
from gr_ros2.record.team import TeamRecord
from gr_ros2.record.trace import Trace
from gr_ros2.run.load import published_names, source_names
from gr_ros2.run.observers import LiveLink, LiveRun, RunObservers
from gr_ros2.run.outcome import Outcome, phy_numbers
from gr_ros2.run.robots import recorder_of
from gr_ros2.run.scenario import Scenario, dump
from gr_ros2.run.task_run import TaskRun
from gr_ros2.settings.registry import Registry

if TYPE_CHECKING:
    from gr_ros2.gr import RosSource


def make_recorder(
    registry: Registry,
    ways: Sequence[Scenario],
    on_delivery: Callable[[Delivered, float, float | None], None] | None = None,
) -> Recorder:
    """The recorder of a run.

    :param ways: one scenario per direction
    :param on_delivery: see :class:`gr_ros2.record.recorder.Recorder`
    """
    return Recorder(
        registry,
        {way.ros_source.src_id(): way.ros_source.namespace for way in ways},
        {way.ros_source.src_id(): source_names(way, registry).values() for way in ways},
        on_delivery=on_delivery,
    )


def make_team(registry: Registry, ways: Sequence[Scenario], phy: Phy) -> TeamRecord | None:
    """What follows the robots of a scenario that share a channel; None where they do not.

    :param ways: one scenario per direction
    """
    if ways[0].duplex != "half":
        return None
    readers = {
        (way.ros_source.src_id(), topic_id): reader
        for way in ways
        for topic_id in source_names(way, registry).values()
        if (reader := position_reader(registry[topic_id].type_name)) is not None
    }
    return TeamRecord([way.ros_source.src_id() for way in ways], phy.airtime, readers)


class Ear:
    """Passes on what one receiver can hear: the events of some senders, and all of its own.

    :param sources: source ids of those senders
    """

    def __init__(self, observer: LinkObserver, sources: Collection[int]) -> None:
        self._observer, self._sources = observer, frozenset(sources)

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        if src_id in self._sources:
            self._observer.sender_event(src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        self._observer.receiver_event(event, now)


class FurtherRecorders:
    """The recorders of the further receivers. Attach it as an observer of the run, from which it takes what is sent.

    :param registry, ways: see :func:`make_recorder`
    :param ears: for each further receiver the directions that it can hear; None: each receiver of the first direction
        hears all
    :param names: of the receivers; None numbers them
    """

    def __init__(
        self,
        registry: Registry,
        ways: Sequence[Scenario],
        ears: Sequence[Sequence[int]] | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        if ears is None:
            ears = [range(len(ways)) for _ in ways[0].receivers]
        self._recorders = [make_recorder(registry, [ways[number] for number in heard]) for heard in ears]
        self._names = names or [""] * len(ears)
        self._observers = [Observers[LinkObserver]() for _ in self._recorders]
        self._guards = [
            observers.add(recorder, needed=True)
            for observers, recorder in zip(self._observers, self._recorders, strict=True)
        ]

        self._hearing: dict[int, list[Observers[LinkObserver]]] = {}
        for observers, heard in zip(self._observers, ears, strict=True):
            for number in heard:
                self._hearing.setdefault(ways[number].ros_source.src_id(), []).append(observers)
        self._offering = {way.ros_source.src_id() for way in ways}

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        for observers in self._hearing.get(src_id, self._observers if src_id not in self._offering else ()):
            observers.sender_event(src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Ignore what the first receiver gets."""

    def at(self, number: int) -> LinkObserver:
        """What observes a further receiver.

        :param number: from 1
        """
        return self._observers[number - 1]

    def check(self) -> None:
        """:raises GrRos2Error: if a recorder has failed, see :meth:`gr_ros2.core.guard.Guard.check`"""
        for guard in self._guards:
            guard.check()

    def unresolved(self) -> int:
        """See :meth:`gr_ros2.record.ledger.Ledger.unresolved`."""
        return sum(recorder.ledger.unresolved() for recorder in self._recorders)

    def finish(
        self, duration_s: float, t_end: float, drained: bool, numbers: Callable[[Recorder], dict[str, Any]]
    ) -> tuple[ReceiverResult, ...]:
        """See :meth:`gr_ros2.record.recorder.Recorder.finish`.

        :param numbers: of the PHY, by the recorder of a receiver
        """
        return tuple(
            ReceiverResult(
                number,
                recorder.finish(duration_s, t_end, drained),
                name,
                packets=recorder.ledger.packets(),
                phy=numbers(recorder),
            )
            for number, (recorder, name) in enumerate(zip(self._recorders, self._names, strict=True), 2)
        )


class RunRecords:
    """Who observes what of a run, and its result.

    :param phys: one per direction
    :param ears: see :func:`gr_ros2.run.robots.ears_of`
    :param task: of robots that act on what they hear; is told what comes out of their links
    :param on_delivery: see :func:`make_recorder`; of what the first receiver gets
    """

    def __init__(
        self,
        scenario: Scenario,
        registry: Registry,
        phys: Sequence[Phy],
        ears: Sequence[Sequence[int]],
        *,
        run_observers: RunObservers,
        task: TaskRun | None = None,
        on_delivery: Callable[[Delivered, float, float | None], None] | None = None,
    ) -> None:
        self._scenario, self._registry, self._phy = scenario, registry, phys[0]
        self._config = dump(scenario)
        self.ways = ways = scenario.directions()
        self.run_observers = run_observers
        heard = [ways[number] for number in ears[0]]
        self.recorder = make_recorder(registry, heard, on_delivery)
        called = [robot.ros_source.namespace for robot in scenario.robots] if len(ears) == len(ways) else None
        self.further = FurtherRecorders(registry, ways, ears[1:], called and called[1:])
        self.team = make_team(registry, ways, phys[0])
        self._task, self._acting = task, Guard(f"task {scenario.task}", needed=True)
        self.all = Observers[LinkObserver]()
        """Observes the first receiver, and what everybody sends."""
        own = self.recorder if len(ways) < 3 else Ear(self.recorder, [way.ros_source.src_id() for way in heard])
        self._recorded = self.all.add(own, needed=True)
        self.all.add(self.further)
        self.all.add(run_observers)

    def of(self, number: int, src_id: int) -> LinkObserver:
        """What observes a robot.

        :param number: its place among the robots of the run
        :param src_id: -1 for none
        """
        recorder = recorder_of(self._scenario, number)
        receiving = self.further.at(recorder) if recorder else self.all
        act = None if self._task is None else partial(self._acting, self._task.delivered, number)
        return RobotObserver(self.all, receiving, self.team, src_id, act)

    def live_run(
        self,
        clock: Callable[[], float] = time.monotonic,
        sources: Mapping[int, RosSource] | None = None,
        links: Sequence[LiveLink] = (),
    ) -> LiveRun:
        """The run as its observers see it.

        :param sources, links: see :class:`LiveRun`; a run in simulated time has none
        """
        return LiveRun(
            name=self._scenario.name,
            duration_s=self._scenario.duration_s,
            packet_len=self._scenario.packet_len,
            registry=self._registry,
            topics={
                (way.ros_source.src_id(), topic_id): name
                for way in self.ways
                for name, topic_id in source_names(way, self._registry).items()
            },
            sources=sources or {},
            links=links,
            ledger=self.recorder.ledger,
            clock=clock,
            team=self.team,
        )

    def check(self) -> None:
        """:raises GrRos2Error: if a recorder has failed, see :meth:`gr_ros2.core.guard.Guard.check`"""
        self._recorded.check()
        self._acting.check()
        self.further.check()

    def unresolved(self) -> int:
        """Messages whose result is open, at all receivers together."""
        return self.recorder.ledger.unresolved() + self.further.unresolved()

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
        :param drained: see :meth:`gr_ros2.record.recorder.Recorder.finish`
        :param channels: how many the robots used
        :param began: s, monotonic, when the run was started
        :param rest: further fields of the result
        """
        topics = self.recorder.finish(played, end, drained)
        names = {name: other for way in self.ways for name, other in published_names(way, self._registry).items()}
        trace = self.recorder.trace(begin, end, names)
        numbers = partial(phy_numbers, self._phy, channels)
        result = Result(
            scenario=self._scenario.name,
            seed=self._scenario.seed,
            duration_s=played,
            config=self._config,
            topics=topics,
            receivers=self.further.finish(played, end, drained, numbers),
            packets=self.recorder.ledger.packets(),
            phy=numbers(self.recorder),
            wall_s=time.monotonic() - began,
            lateness=lateness(trace),
            task={} if self._task is None else self._task.numbers(played),
            **rest,
        )
        return Outcome(result, trace, self.team)


class RobotObserver:
    """Passes on what one robot sends and receives.

    :param sending, receiving: observe its two halves
    :param team: follows it, where it shares a channel
    :param act: is called with what is delivered to it
    """

    def __init__(
        self,
        sending: LinkObserver,
        receiving: LinkObserver,
        team: TeamRecord | None,
        src_id: int,
        act: Callable[[Delivered, float], None] | None,
    ) -> None:
        self._sending, self._receiving, self._team, self._src_id, self._act = sending, receiving, team, src_id, act

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        self._sending.sender_event(src_id, event)
        if self._team is not None:
            self._team.sender_event(src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        self._receiving.receiver_event(event, now)
        if self._team is not None:
            self._team.receiver_event(self._src_id, event, now)
        if self._act is not None and isinstance(event, Delivered):
            self._act(event, now)
