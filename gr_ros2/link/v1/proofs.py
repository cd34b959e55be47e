"""What proves that another robot's packets were sealed after this robot started.

The other robot echoes the end of a hello of this start, and says at which number it was then (*heard*): what it sends
above that number was sealed after that hello. So what was recorded before is refused, whether this robot heard it or
not. A robot that cannot hear this one can prove nothing; see ``replays``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import inf

from gr_ros2.wire.control import ECHO_LEN, Heard
from gr_ros2.wire.v1 import REPAIR_IDS, EntryV1

_ECHOES = 64
"""Hellos of this robot that can be echoed, and proofs kept of each other robot."""


class OwnHellos:
    """The newest hellos of this robot, by which others prove that they hear it.

    :param own: id of this robot
    """

    def __init__(self, own: int) -> None:
        self._own = own
        self._left: dict[bytes, float] = {}
        """When they left, by their ends."""

    def said(self, data: bytes, now: float) -> None:
        """A hello leaves: from now on, other robots can prove that they have heard it."""
        self._left[data[-ECHO_LEN:]] = now
        if len(self._left) > _ECHOES:
            del self._left[next(iter(self._left))]

    def proofs(self, number: int, entries: Sequence[EntryV1], before: float) -> list[tuple[int, float]]:
        """What entries prove: packets of their sender above a number were sealed after a time in s.

        :param number: at which the entries stand
        :param before: hellos up to this time in s prove nothing: another start of the sender may have echoed them
        """
        left = self._left
        found = [entry for entry in entries if isinstance(entry, Heard) and entry.src_id == self._own]
        proofs = [(number - (number - entry.since & 0xFFFF), left[entry.echo]) for entry in found if entry.echo in left]
        return [(since, at) for since, at in proofs if since >= 0 and at > before]


class Proofs:
    """What one start of another robot has proven.

    :param not_before: hellos of this robot up to this time in s prove nothing: an earlier start heard them
    :ivar proven: packets above this number were sealed after this robot started; None as long as nothing proves it
    """

    def __init__(self, not_before: float) -> None:
        self.not_before = not_before
        self.proven: int | None = None
        self._place = -1, 0
        """Number and repair id of the packet that proves this; of several at one number, those of the newest."""
        self._newest: deque[tuple[int, float]] = deque(maxlen=_ECHOES)
        """(number, time in s): packets above this number were sealed after this time."""

    def take(self, number: int, at: float, place: tuple[int, int]) -> None:
        """Packets above a number were sealed after a time, s.

        :param place: number and repair id of the packet that says so
        """
        if self.proven is None or number < self.proven or place[0] == self._place[0]:
            self._place = place
        self.proven = number if self.proven is None else min(self.proven, number)
        if not self._newest or (number >= self._newest[-1][0] and at > self._newest[-1][1]):
            self._newest.append((number, at))

    def covers(self, number: int, repair_id: int) -> bool:
        """Whether a control packet was sealed after this robot started: above that number, or at it, where the proof
        itself stands there, not before the proof. Repair ids go up, and begin again at 0 after the last one."""
        if self.proven is None or number > self.proven:
            return self.proven is not None
        return number == self._place[0] and (repair_id - self._place[1]) % REPAIR_IDS < REPAIR_IDS // 2

    def sealed_after(self, number: int) -> float:
        """Time in s after which a packet was sealed; -inf if nothing proves it."""
        return next((at for since, at in reversed(self._newest) if since < number), -inf)
