"""How much each neighbour may make a robot keep, so that none takes what the others need.

Invariants: sans-IO; at most ``most`` things are kept, and as many bytes as their share of the memory allows; where
there are more, the neighbour with most of them loses its oldest.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Generic, TypeVar

from gr_ros2.relay.memory import Share

K = TypeVar("K", bound=Hashable)


class Quotas(Generic[K]):
    """What is kept for neighbours, by name.

    :param most: things that are kept in all
    :param share: of the memory
    :param cost: bytes that a thing takes beside those that are told
    """

    def __init__(self, most: int, share: Share, cost: int = 0) -> None:
        self._most, self._memory, self._cost = most, share, cost
        self._of: dict[K, int] = {}
        self._sizes: dict[int, dict[K, int]] = {}
        self._bytes: dict[int, int] = {}

    def put(self, name: K, robot: int, size: int) -> list[K]:
        """Keep a thing of this many bytes that a robot brought, in the place of an older one of that name.

        :return: the names of those that are lost for it
        """
        self.drop(name)
        size += self._cost
        self._memory.held += size
        self._of[name] = robot
        self._sizes.setdefault(robot, {})[name] = size
        self._bytes[robot] = self._bytes.get(robot, 0) + size
        lost = []
        while len(self._of) > self._most or self._memory.full:
            largest = max(self._sizes, key=self._share)
            lost.append(next(iter(self._sizes[largest])))
            self.drop(lost[-1])
        return lost

    def drop(self, name: K) -> None:
        """A thing is kept no more."""
        robot = self._of.pop(name, None)
        if robot is not None:
            size = self._sizes[robot].pop(name)
            self._bytes[robot] -= size
            self._memory.held -= size
            if not self._sizes[robot]:
                del self._sizes[robot], self._bytes[robot]

    def _share(self, robot: int) -> float:
        return max(len(self._sizes[robot]) / self._most, self._bytes[robot] / self._memory.memory.most)
