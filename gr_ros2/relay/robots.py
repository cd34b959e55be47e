"""The other robots, one record for each: when it was there, and whom it hears. For how long that counts stands here.

A robot is a *neighbour* for ``NEAR_S`` after it was heard; from then on others are believed about it, too. After
``GONE_S`` of silence it is gone: nothing is repaired for it until it is back, and what was handed to it is handed to
another one. One that is not heard is *reached* over others for ``STALE_S`` after it was last there. After ``QUIET_S``
nothing of it is sent on any more, and after ``KNOWN_S`` it is forgotten. The parts keep what is theirs under its id,
and ask here, or are told, when it ends. (Medium access counts in slots instead: see ``mac``.)

Invariants: sans-IO, the caller passes in times; nothing that may be a recording moves them; memory is bounded by the
ids.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import inf

NEAR_S = 3.0
"""s for which a robot that was heard counts as a neighbour."""
GONE_S = 10.0
"""s of silence after which a robot is regarded as gone."""
STALE_S = 15.0
"""s for which a way to a robot counts: tables are relayed every 5 s at least, and two may be lost."""
QUIET_S = 60.0
"""s after which nothing of a robot is sent on any more: its table comes every 5 s from who hears it."""
KNOWN_S = 600.0
"""s after which a robot that is known over others only is forgotten, and with it what has come of it."""


class OtherRobot:
    """Another robot.

    :ivar met: when its present start was heard first, s
    :ivar met_over: when its present start was first known over others, where it is not heard itself, s
    :ivar doubled: when a start of it sent something although another one had begun, s
    :ivar heard: when it was heard last, s
    :ivar there: when it was there last, as it or others show, s
    :ivar came: when something of its present start came over others, s
    :ivar hops: over how many robots its newest message came; 0 for directly
    :ivar hears: the robots that it says it hears -> the count of its packets when it last named each
    :ivar packets: those of it that were heard
    """

    __slots__ = ("came", "doubled", "heard", "hears", "hops", "met", "met_over", "packets", "there")

    def __init__(self) -> None:
        self.met = self.met_over = self.doubled = -inf
        self.heard = self.there = self.came = -inf
        self.hears: dict[int, int] = {}
        self.packets = self.hops = 0


class OtherRobots:
    """The robots that one robot hears, or reaches over others.

    :param slower: by how much longer than written they are waited for, where they send seldom
    :ivar all: by id
    """

    def __init__(self, slower: Callable[[], float] = lambda: 1.0) -> None:
        self.slower = slower
        self.all: dict[int, OtherRobot] = {}

    def of(self, src_id: int) -> OtherRobot:
        """The record of a robot."""
        robot = self.all.get(src_id)
        if robot is None:
            robot = self.all[src_id] = OtherRobot()
        return robot

    def hear(self, src_id: int, now: float, names: Iterable[int] = (), heard: int = 0) -> bool:
        """A packet of a robot was heard; returns whether it was a neighbour before.

        :param names: robots that it says it hears
        :param heard: how many it hears in all: a name counts for as many packets as it takes to name all twice
        """
        robot = self.of(src_id)
        before = now - robot.heard < self.near_s
        robot.heard = robot.there = now
        robot.packets += 1
        for name in names:
            robot.hears[name] = robot.packets
        if len(robot.hears) > heard:
            robot.hears = {name: at for name, at in robot.hears.items() if robot.packets - at <= heard + 2}
        return before

    @property
    def near_s(self) -> float:
        """s for which a robot that was heard counts as a neighbour."""
        return NEAR_S * self.slower()

    @property
    def stale_s(self) -> float:
        """s for which a way to a robot counts."""
        return STALE_S * self.slower()

    def is_near(self, src_id: int, now: float) -> bool:
        """Whether a robot is a neighbour."""
        robot = self.all.get(src_id)
        return robot is not None and now - robot.heard < self.near_s

    def near(self, now: float) -> list[int]:
        """The neighbours."""
        near_s = self.near_s
        return [src_id for src_id, robot in self.all.items() if now - robot.heard < near_s]

    def heard_by(self, src_id: int) -> list[int]:
        """The robots that were heard here and that a robot says it hears."""
        robot = self.all.get(src_id)
        return [] if robot is None else [name for name in robot.hears if name in self.all and self.all[name].packets]

    def apart(self, origin: int, now: float) -> list[int]:
        """The neighbours that do not say that they hear another one."""
        return [src_id for src_id in self.near(now) if src_id != origin and origin not in self.all[src_id].hears]

    def quiet(self, now: float) -> list[int]:
        """The robots of which nothing is sent on any more."""
        since = now - QUIET_S * self.slower()
        return [src_id for src_id, robot in self.all.items() if -inf < robot.there < since]

    def forget(self, now: float) -> list[int]:
        """The robots that were there too long ago, which are forgotten; each is returned once."""
        old = [src_id for src_id, robot in self.all.items() if -inf < max(robot.there, robot.came) < now - KNOWN_S]
        for src_id in old:
            self.all[src_id].there = self.all[src_id].came = -inf
        return old
