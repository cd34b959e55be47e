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


Start = tuple[int, int]
"""A robot, and the boot number of one start of it."""


class OwnHellos:
    """The newest hellos of this robot, by which others prove that they hear it.

    :param own: id of this robot
    """

    def __init__(self, own: int) -> None:
        self._own = own
        self._left: dict[bytes, float] = {}
        """When they left, by their ends."""
        self._proving: dict[bytes, frozenset[Start]] = {}
        """The starts of others of which each of them says that they were heard."""
        self._told: dict[Start, float] = {}
        """When the burst of the newest of them that says so began, s."""

    def said(self, data: bytes, now: float, proving: frozenset[Start] = frozenset(), at: float | None = None) -> None:
        """A hello leaves: from now on, other robots can prove that they have heard it.

        :param proving: the starts of others of which it says that they were heard
        :param at: when its burst begins, s; None for now
        """
        self._left[data[-ECHO_LEN:]], self._proving[data[-ECHO_LEN:]] = now, proving
        self._told.update(dict.fromkeys(proving, now if at is None else at))
        if len(self._left) > _ECHOES:
            oldest = next(iter(self._left))
            del self._left[oldest], self._proving[oldest]
        if len(self._told) > _ECHOES:
            del self._told[next(iter(self._told))]

    def knows(self, start: Start, entries: Sequence[EntryV1], since: float) -> bool:
        """Whether a start of another robot has got the proof that it was heard, or could not have it yet.

        :param entries: of its newest hello
        :param since: what began after this time in s, it could not know of when it wrote this hello
        """
        if self._told.get(start, -inf) > since:
            return True
        echoes = [entry.echo for entry in entries if isinstance(entry, Heard) and entry.src_id == self._own]
        return any(start in self._proving.get(echo, ()) for echo in echoes)

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
