"""Over which robot a message comes nearer to another one.

Every message of another robot says how many have sent it on, so whoever carries it stands so far from its origin. A
robot hands a message for that origin to the one that stands nearest and hears it. One to which messages were handed
that did not arrive comes last.

Invariants: sans-IO, the caller passes in times; memory is bounded by the ids.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from gr_ros2.relay.robots import OtherRobots

DOUBT_S = 300.0
"""s for which a robot over which messages did not arrive comes after all others."""


class Routes:
    """The distances of the robots that are heard from all others.

    :param robots: says for how long a distance counts
    """

    def __init__(self, robots: OtherRobots) -> None:
        self._robots = robots
        self._ways: dict[int, dict[int, tuple[int, float]]] = {}
        """By robot, and by the one that is heard: how many stand between them, this one included, and when that was
        last so, s."""
        self._doubted: dict[tuple[int, int], float] = {}
        """Until when a robot counts as no good way to another one, by this one and by it, s."""

    def note(self, robot: int, via: int, hops: int, now: float) -> None:
        """A message of a robot has come over another one.

        :param hops: robots that have sent it on; 0 where ``via`` has made it
        :param now: when ``via`` sent it, s; not later, where that is not known
        """
        ways = self._ways.setdefault(robot, {})
        before, at = ways.get(via, (hops, now))
        if hops < before or now > at + self._robots.stale_s:
            ways[via] = hops, now
        elif hops == before:  # a detour says nothing about the shortest way
            ways[via] = hops, max(at, now)

    def known(self, robot: int) -> bool:
        """Whether a way to a robot was ever known."""
        return robot in self._ways

    def doubt(self, robot: int, via: int, now: float) -> None:
        """What was handed to ``via`` for ``robot`` has not arrived."""
        self._doubted[robot, via] = now + DOUBT_S

    def trust(self, robot: int, via: int) -> None:
        """What was handed to ``via`` for ``robot`` has arrived."""
        self._doubted.pop((robot, via), None)

    def over(self, robot: int, now: float, usable: Callable[[int], bool]) -> int | None:
        """The robot to which a message for ``robot`` is to be handed; None if no way is known. Of those over which
        messages did not arrive, the one of which this was noticed first has its turn.

        :param usable: whether a robot may be taken
        """
        since = now - self._robots.stale_s
        open_ways = [
            (until if now < (until := self._doubted.get((robot, via), -inf)) else -inf, hops, via)
            for via, (hops, at) in self._ways.get(robot, {}).items()
            if since <= at and usable(via)
        ]
        return min(open_ways)[2] if open_ways else None

    def hops(self, robot: int, now: float) -> int | None:
        """Robots between this one and another; 0 if it is heard, None if nothing is known."""
        since = now - self._robots.stale_s
        return min((hops for hops, at in self._ways.get(robot, {}).values() if since <= at), default=None)
