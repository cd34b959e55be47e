"""Observers of a link. An observer cannot harm the link.

Invariants: an observer receives every event in order until its first exception; that ends only this observer
(:class:`gr_ros2.core.guard.Guard`), and the link and the other observers go on. An observer is called in the thread of
the event. A slow observer has to be attached through a bounded queue (``gr_ros2.observe.observers.RunObservers``).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, Protocol, TypeVar

from gr_ros2.core.guard import Guard
from gr_ros2.link.events import ReceiverEvent, SenderEvent


class LinkObserver(Protocol):
    """Receives the events of both ends of a link. It is called from the link's threads, in causal order, and must be
    fast."""

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        """An event of the sender with this source id."""

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """An event of the receiver, packets included. A delivery is reported after it was published."""


_Observer = TypeVar("_Observer", bound=LinkObserver)


class Observers(Generic[_Observer]):
    """Passes every event to several observers in their order, each under its own guard."""

    def __init__(self, observers: Iterable[_Observer] = ()) -> None:
        self._guarded: tuple[tuple[_Observer, Guard], ...] = ()
        for observer in observers:
            self.add(observer)

    def add(self, observer: _Observer, *, needed: bool = False) -> Guard:
        """Attach one more observer, from now on.

        :param needed: see :class:`Guard`
        """
        guard = Guard(name_of(observer), needed=needed)
        self._guarded += ((observer, guard),)
        return guard

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        """Pass an event of a sending half on to all."""
        for observer, guard in self._guarded:
            guard(observer.sender_event, src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Pass an event of a receiving half on to all."""
        for observer, guard in self._guarded:
            guard(observer.receiver_event, event, now)

    def incomplete(self) -> list[str]:
        """What observers missed and why, one line each; empty if they missed nothing."""
        lines = [line for _, guard in self._guarded for line in guard.incomplete()]
        return lines + [line for one, _ in self._guarded if isinstance(one, Observers) for line in one.incomplete()]


def name_of(observer: object) -> str:
    """Name of an observer in messages: its ``name``, or its class."""
    return str(getattr(observer, "name", type(observer).__name__))
