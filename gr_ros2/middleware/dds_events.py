"""What a participant's thread waits for, and what it does when that happens.

Invariants: what was attached first is served first, so that a publisher's QoS, which discovery brings, is known before
its messages; nothing is served once it is detached, and no lock is held meanwhile.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import count

from gr_ros2.middleware.cdr_dds import Entity, WaitSet

Step = Callable[[], object]


class DdsEvents:
    """The events of one participant, from any thread; one thread waits for them."""

    def __init__(self, participant: Entity) -> None:
        self._waitset = WaitSet(participant)
        self._lock = threading.Lock()
        self._steps: dict[int, tuple[Entity, Step]] = {}
        self._numbers = count(1)

    def attach(self, key: Entity, entities: Iterable[Entity], step: Step) -> None:
        """Take a step each time one of some entities has something new.

        :param key: the entity by which this is detached
        """
        with self._lock:
            number = next(self._numbers)
            self._steps[number] = key, step
        for entity in entities:
            self._waitset.attach(entity, number)
        self.wake()

    def detach(self, key: Entity) -> None:
        """Take the step of an entity no more. An entity that is not attached is ignored."""
        with self._lock:
            for number in [number for number, (entity, _) in self._steps.items() if entity == key]:
                del self._steps[number]

    def wake(self) -> None:
        """End the current wait."""
        self._waitset.wake()

    def wait(self, timeout_s: float | None) -> Iterator[Step]:
        """The steps that are due, after a wait of ``timeout_s`` at most; None waits for ever.

        :raises DdsError: when there is nothing to wait for any more
        """
        triggered = self._waitset.wait(timeout_s)

        def due() -> Iterator[Step]:
            for number in sorted(triggered):
                with self._lock:
                    found = self._steps.get(number)
                if found is not None:  # not detached by the step before
                    yield found[1]

        return due()
