"""How long a message is worth repairing.

The topic decides. With ``latest``, it is until newer messages of all its instances have left whole. With a lifespan, it
is until that has passed. Otherwise it is until ``depth`` newer messages have left, or enough newer ones to fill a
repair, and not longer after the next message than a receiver waits for it. Receivers that report say when they have a
message: then a message that is delivered in order is repaired until they have it, and any other until ``depth`` newer
ones have left.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import inf

from gr_ros2.link.instances import ALL, Keys, replaced
from gr_ros2.settings.config import QueuePolicy

MOST_LIFETIMES = 4096
"""Newer messages of the same topic after which a message is not repaired any more: a bound on memory."""


@dataclass(slots=True, eq=False)
class Lifetime:
    """How long a message is worth repairing.

    :param expires: time in s at which it is of no more use
    :param in_order: whether later messages wait for it; on a channel that many share, also the table of topics
    :param long: whether it takes many packets, so that others go before it
    :param awaited: whether a later message of its topic waits already
    :param left: whether it has left whole
    :param chained: whether it is of use only to who has followed so far: it is not kept for those out of range
    :param fresh: whether the next message of its topic is its repair on a channel that many share
    :param completes: it is being sent again to robots for which it was sent too fast, and is not replaced meanwhile
    :param keys: the instances that it speaks of
    :param topic_id: its topic
    :param order: the packet in which it began, and its place there
    """

    expires: float = inf
    in_order: bool = False
    long: bool = False
    awaited: bool = False
    left: bool = False
    fresh: bool = False
    chained: bool = False
    completes: bool = False
    keys: Keys = ALL
    topic_id: int = -1
    order: tuple[int, int] = (0, 0)

    def end(self) -> None:
        """It was replaced by a newer message, or needs no repair."""
        if not self.completes:
            self.expires = -inf


class Lifetimes:
    """The messages of one topic that have left and are not replaced yet."""

    def __init__(self) -> None:
        self._left: deque[Lifetime] = deque()

    def left(self, lifetime: Lifetime, *, policy: QueuePolicy, depth: int, reported: bool, waited_for: float) -> None:
        """A message has left whole: older messages that it replaces are over.

        :param depth: of the publishers' history, 0 for unbounded or unknown
        :param reported: whether receivers report
        :param waited_for: time in s until which receivers that do not report wait for the message before it
        """
        earlier, most = self._left, MOST_LIFETIMES
        if policy == "latest":
            for old in replaced(earlier, lifetime.keys):
                earlier.remove(old)
                old.end()
        elif reported:
            most = most if lifetime.in_order else depth or most  # what comes in order is waited for
        elif earlier:
            earlier[-1].expires = min(earlier[-1].expires, waited_for)
        earlier.append(lifetime)
        while len(earlier) > most:
            earlier.popleft().end()

    def beside(self, lifetime: Lifetime) -> None:
        """The beginning of a message has left again, which is of use only with the rest."""
        self._left.append(lifetime)

    def restart(self, keys: Keys) -> None:
        """The newest message of these instances needs no earlier one, and whoever has it needs none."""
        for old in [lifetime for lifetime in self._left if lifetime.keys == keys][:-1]:
            self._left.remove(old)
            old.end()
