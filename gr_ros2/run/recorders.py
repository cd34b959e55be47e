"""The recorders of a run: one for each receiver, because every receiver has losses of its own.

Invariant: each recorder gets the events of all senders, and those of its own receiver only.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

from gr_ros2.link.events import Delivered, ReceiverEvent, SenderEvent
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.phy import Phy
from gr_ros2.record.positions import position_reader
from gr_ros2.record.recorder import Recorder
from gr_ros2.record.result import ReceiverResult
from gr_ros2.record.team import TeamRecord
from gr_ros2.run.load import source_names
from gr_ros2.run.scenario import Scenario
from gr_ros2.settings.registry import Registry


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
