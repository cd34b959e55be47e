"""An endpoint in real time: the lock that protects it, and the thread that sends, which sleeps and is woken."""

from __future__ import annotations

import threading
from collections.abc import Callable
from math import inf
from typing import Generic, TypeVar

from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.events import SenderEvent
from gr_ros2.phy.threads import wait_until_s

_E_co = TypeVar("_E_co", bound=Endpoint, covariant=True)
SHORTEST_WAIT_S = 2e-4
"""s for which the sending thread sleeps at least."""


class LiveEnd(Generic[_E_co]):
    """An endpoint that the blocks of one flowgraph share, and the one lock that protects it.

    :param make: makes the endpoint, given its observer
    :ivar work: notified when a packet may leave; who sleeps there says so in ``sleeps_until``
    :ivar sleeps_until: time in s at which the sending thread looks again by itself; -inf while it is awake
    :ivar looked: time in s at which the sending thread last began to look for packets
    :ivar observer: called with each event of the sending half, while the lock is held
    """

    def __init__(self, make: Callable[[Callable[[SenderEvent], None]], _E_co]) -> None:
        self.lock = threading.Lock()
        self.work = threading.Condition(self.lock)
        self.sleeps_until = self.looked = -inf
        self.changed = True
        """Whether something has happened since the endpoint last had no packet."""
        self._departs = inf
        """When a packet may leave if nothing happens, s; a credit for it provided."""
        self.look: Callable[[], None] = lambda: None
        """Called when packets have left or come, with the lock held: a picture may have to be encoded."""
        self._foreseen = False
        """Whether the sending thread sleeps until the next packet may leave, a credit for it provided."""
        self.observer: Callable[[SenderEvent], None] | None = None
        self.endpoint = make(self._tell)

    def wake(self, *, credited: bool = False) -> None:
        """Wake the sending thread if a packet may leave before it looks again; the caller holds the lock.

        A needless wake-up takes as much time as several packets.

        :param credited: whether nothing has come but a credit
        """
        self.changed |= not credited or self._departs == inf
        if self.sleeps_until == -inf or (credited and self._foreseen):
            return
        at = self.endpoint.next_departure()
        if at is None:
            self._foreseen = False
        elif at < self.sleeps_until or self.endpoint.urgent:
            self.work.notify()

    def rouse(self) -> None:
        """Have the sending thread look, whatever there is; the caller holds the lock."""
        self.changed = True
        self.work.notify()

    def due(self, now: float) -> bool:
        """Whether the endpoint is to be asked for a packet; the caller, the sending thread, holds the lock.

        It is asked after each event and after each packet, since some of what it may send it looks for only then; and
        when one is due.
        """
        return self.changed or (self._departs <= now and not self.endpoint.pace.out_of_credit)

    def nothing(self) -> None:
        """The endpoint had no packet; the caller, the sending thread, holds the lock."""
        self.changed = False
        at = self.endpoint.next_departure(credited=True)
        self._departs = inf if at is None else at

    def sleep(self, clock: Callable[[], float], until: float = inf) -> None:
        """Wait, as the sending thread, until a packet may leave; the caller holds the lock.

        :param clock: gives the time in s
        :param until: when it wakes up at the latest, s
        """
        now, at = clock(), self._departs
        # What is due later is waited for also without a credit, so that one that comes before need not wake the thread.
        self._foreseen = now < at < inf
        if at <= now and self.endpoint.pace.out_of_credit:
            at = inf
        self.sleeps_until = until = min(at, until)
        self.work.wait(wait_until_s(until, now, SHORTEST_WAIT_S))
        self.looked = clock()  # before it counts as awake: `stalled_s` takes no lock
        self.sleeps_until = -inf

    def stalled_s(self, now: float) -> float:
        """s for which the sending thread has been at one thing, or asleep beyond the time at which it meant to look
        again. Takes no lock, which that thread may hold."""
        until = self.sleeps_until
        return max(0.0, now - (self.looked if until == -inf else until))

    def _tell(self, event: SenderEvent) -> None:
        if self.observer is not None:
            self.observer(event)
