"""The recorders of a run: one for each receiver, because every receiver has losses of its own.

Invariant: each recorder gets the events of all senders, and those of its own receiver only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gr_ros2.link.events import Delivered, ReceiverEvent, SenderEvent
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.record.recorder import Recorder
from gr_ros2.record.result import ReceiverResult
from gr_ros2.registry import Registry
from gr_ros2.run.load import source_names
from gr_ros2.run.scenario import Scenario


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


class FurtherRecorders:
    """The recorders of the further receivers. Attach it as an observer of the run, from which it takes what is sent.

    :param registry, ways: see :func:`make_recorder`
    """

    def __init__(self, registry: Registry, ways: Sequence[Scenario]) -> None:
        self._recorders = [make_recorder(registry, ways) for _ in ways[0].receivers]
        self._observers = [Observers[LinkObserver]() for _ in self._recorders]
        self._guards = [
            observers.add(recorder, needed=True)
            for observers, recorder in zip(self._observers, self._recorders, strict=True)
        ]

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        for observers in self._observers:
            observers.sender_event(src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Ignore what the first receiver gets."""

    def at(self, number: int) -> LinkObserver:
        """What observes a further receiver.

        :param number: from 1
        """
        return self._observers[number - 1]

    def check(self) -> None:
        """:raises GrRos2Error: if a recorder has failed, see :meth:`gr_ros2.guard.Guard.check`"""
        for guard in self._guards:
            guard.check()

    def unresolved(self) -> int:
        """See :meth:`gr_ros2.record.ledger.Ledger.unresolved`."""
        return sum(recorder.ledger.unresolved() for recorder in self._recorders)

    def finish(self, duration_s: float, t_end: float, drained: bool) -> tuple[ReceiverResult, ...]:
        """See :meth:`gr_ros2.record.recorder.Recorder.finish`."""
        return tuple(
            ReceiverResult(number, recorder.finish(duration_s, t_end, drained))
            for number, recorder in enumerate(self._recorders, 2)
        )
