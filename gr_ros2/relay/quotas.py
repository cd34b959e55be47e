"""How much each neighbour may make a robot keep, so that none takes what the others need.

Invariants: sans-IO; at most ``most`` things and ``most_bytes`` are kept; where there are more, the neighbour with most
of them loses its oldest.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)


class Quotas(Generic[K]):
    """What is kept for neighbours, by name.

    :param most: things that are kept in all
    :param most_bytes: bytes of them
    """

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._of: dict[K, int] = {}
        self._sizes: dict[int, dict[K, int]] = {}
        self._bytes: dict[int, int] = {}

    def put(self, name: K, robot: int, size: int) -> list[K]:
        """Keep a thing of this many bytes that a robot brought, in the place of an older one of that name.

        :return: the names of those that are lost for it
        """
        self.drop(name)
        self._of[name] = robot
        self._sizes.setdefault(robot, {})[name] = size
        self._bytes[robot] = self._bytes.get(robot, 0) + size
        lost = []
        while len(self._of) > self._most or sum(self._bytes.values()) > self._most_bytes:
            largest = max(self._sizes, key=self._share)
            lost.append(next(iter(self._sizes[largest])))
            self.drop(lost[-1])
        return lost

    def drop(self, name: K) -> None:
        """A thing is kept no more."""
        robot = self._of.pop(name, None)
        if robot is not None:
            self._bytes[robot] -= self._sizes[robot].pop(name)
            if not self._sizes[robot]:
                del self._sizes[robot], self._bytes[robot]

    def _share(self, robot: int) -> float:
        return max(len(self._sizes[robot]) / self._most, self._bytes[robot] / self._most_bytes)
