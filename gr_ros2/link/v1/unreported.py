"""Repairs while nobody reports: how many are enough for the losses that are expected.

A long message that is delivered in order has its repairs while it is sent, if anything waits for it: no report will
call for them. A packet is over after as many repairs as the expected losses need, so that a robot that nobody hears
falls silent. Where packets are taken only after a proof (``proofs``) and idle slots are its own, it does not do so
before others had time to prove that they hear it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, sqrt

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.link.v1.sent_packets import Sent
from gr_ros2.wire.v1 import MAX_WINDOW


class Unreported:
    """The repairs of one sender that no report calls for.

    :param loss: share of packets that are expected to be lost
    :param slower: see ``Settings``
    :param proves: whether others take packets only after a proof, and idle slots take airtime from nobody
    """

    def __init__(self, loss: float, tuning: Tuning, *, proves: bool = False, slower: float = 1.0) -> None:
        self.loss, self._tuning = loss, tuning
        self._meeting_s = self._tuning.unreported_meeting_s * slower
        self._silent_from = inf if proves else -inf
        """When packets may be over, s; inf until the first one leaves."""
        self._owed = 0.0
        """Number of repairs of long messages that are due."""
        self._allows = self._enough(self._tuning.unreported_together) / self._tuning.unreported_together
        self._spare = 0.0
        """Number of repairs that may leave while all peers are out of range."""
        self._awaited = -1
        """Up to this number, they go before new packets: other messages wait for what was lost."""

    def sent(self, number: int, lifetimes: tuple[Lifetime, ...]) -> None:
        """A source packet left, and nobody reports."""
        long = awaited = False
        for lifetime in lifetimes:
            if lifetime.in_order:
                long |= lifetime.long
                awaited |= lifetime.awaited or not lifetime.long
        if long:
            self._owed += self._enough(MAX_WINDOW) / MAX_WINDOW
        self._spare += self._allows
        if awaited:
            self._awaited = number + MAX_WINDOW

    def due(self, newest: int) -> bool:
        """Whether a repair of a long message goes before new packets."""
        return self._owed >= self._tuning.unreported_owed and newest <= self._awaited

    def end(self) -> None:
        """Somebody reports, or nothing is left to repair."""
        self._owed = 0.0

    def repaired(self) -> None:
        """A combination leaves."""
        self._owed = max(self._owed - 1, 0.0)
        self._spare = max(self._spare - 1, 0.0)

    @property
    def spares(self) -> bool:
        """Whether a repair may leave while all peers are out of range."""
        return self._spare >= 1

    def cover(self, packets: Sequence[Sent], now: float) -> None:
        """These packets were combined, and nobody reports: those that were combined often enough are not needed."""
        if now < self._silent_from:
            if self._silent_from == inf:
                self._silent_from = now + self._meeting_s
            return
        share = 1 / (self._tuning.unreported_enough * self._enough(len(packets)))
        for record in packets:
            record.covered += share

    def _enough(self, count: int) -> float:
        """Number of repairs after which so many packets are complete at a peer with the expected loss, all but
        surely (five standard deviations)."""
        lost = count * self.loss
        return (lost + 5 * sqrt(lost) + 3) / (1 - min(self.loss, self._tuning.unreported_most_loss))
