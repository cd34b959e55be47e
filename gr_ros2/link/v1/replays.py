"""The packet numbers below which nothing is accepted, stored so that they outlast a restart.

Of a robot that cannot prove when it sealed a packet (``proofs``), a number is stored before a packet above it is used.
So after a restart of this robot, every packet that it heard before is refused, but not what it never heard. The newest
boot number of every robot is stored too.

Invariant: where only the store keeps replays out, no packet is used at a number that is not stored.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gr_ros2.core.errors import GrRos2Error, NotStoredError

Save = Callable[[int, int, int], None]
"""Stores robot id, boot number and the packet number below which nothing more is accepted. Stores before it returns.

:raises GrRos2Error: it cannot be stored
"""

_RESERVE = 16
_MOST_RESERVED = 1 << 14
_SAVING_S = 0.25
_RETRY_S = 10.0
"""s after which a state file that could not be written is tried again where nothing waits for it."""


@dataclass(slots=True, eq=False)
class Floor:
    """The number of one start of one robot below which nothing is accepted after a restart of this robot.

    :param failed: whether storing it failed the last time
    """

    src_id: int
    boot: int
    number: int = 0
    reserve: int = _RESERVE
    saved: float = 0.0
    failed: bool = False


class Floors:
    """The stored numbers of all robots.

    :param stored: what ``save`` has stored, by robot id: boot number and packet number
    :param dropped: counts failures of ``save`` (``state_not_written``)
    """

    def __init__(self, stored: Mapping[int, tuple[int, int]], save: Save | None, dropped: Counter[str]) -> None:
        self._stored = dict(stored)
        self._save = save
        self._dropped = dropped

    @property
    def stores(self) -> bool:
        """Whether anything is stored."""
        return self._save is not None

    def of(self, src_id: int) -> tuple[int, int]:
        """Boot and packet number that are stored of a robot; (-1, 0) for none."""
        return self._stored.get(src_id, (-1, 0))

    def guard(self, floor: Floor, number: int, now: float) -> None:
        """Store that a robot has reached this number, before the packet is used.

        :raises NotStoredError: it cannot be stored
        """
        if number < floor.number:
            return
        soon = now - floor.saved < _SAVING_S
        if soon and not floor.failed:
            floor.reserve = min(2 * floor.reserve, _MOST_RESERVED)
        if (soon and floor.failed) or not self.store(floor, number + floor.reserve, now):
            raise NotStoredError(
                f"packet {number} of robot {floor.src_id} is not used, because the state file cannot be written: "
                "after a restart it could be replayed"
            )

    def settle(self, floor: Floor, exact: int, heard: float, now: float, *, counts: bool) -> None:
        """Store the exact number reached by a robot that is quiet.

        :param heard: when it was heard last, s
        :param counts: whether only the stored number keeps replays of it out
        """
        quiet = now - max(heard, floor.saved) > 2 * _SAVING_S
        if floor.failed and now - floor.saved > _RETRY_S:
            self.store(floor, exact if counts else 0, now)
        elif counts and floor.number > exact and quiet:
            floor.reserve = _RESERVE
            self.store(floor, exact, now)

    def store(self, floor: Floor, number: int, now: float) -> bool:
        """Store the number below which nothing is accepted; returns whether that worked."""
        floor.saved, floor.failed = now, False
        if self._save is not None:
            try:
                self._save(floor.src_id, floor.boot, number)
            except GrRos2Error:
                self._dropped["state_not_written"] += 1
                floor.failed = True
                return False
        floor.number = number
        self._stored[floor.src_id] = (floor.boot, number)
        return True
