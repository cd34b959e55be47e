"""The robots known over others: which start each is in, and where its messages come together.

*Trust.* Which start a robot is in and how far it is come from it alone as long as it is heard. Of a robot that is not
heard, a number or a start that came over others counts until the robot itself says less, or until something with a
lower one was made ``EXPIRES_S`` after it came.

Invariant: everything here is forgotten: at once where the robot is met, in any case when ``relay.robots`` forgets it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf

from gr_ros2.link.endpoint import HeardRobot
from gr_ros2.link.events import Gone, Met
from gr_ros2.link.fates import Fate
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.neighbours import Neighbour, Neighbours
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.relay.gain import EXPIRES_S
from gr_ros2.relay.memory import Share
from gr_ros2.relay.quotas import Quotas
from gr_ros2.relay.robots import OtherRobots
from gr_ros2.relay.routes import Routes
from gr_ros2.wire.v1 import BROADCAST


@dataclass(slots=True)
class _Far:
    """What is known of a robot over others.

    :param inbox: of the start that is or was known over others only; None for none
    :param first_made: when that was made with which this start began, s
    :param boot: number of the start that is reached over others; -1 for none
    :param at: when something of that start was made last, s
    :param ahead: when a message came over others with a number that the robot had not reached itself, s; inf for never
    """

    inbox: Inbox | None = None
    first_made: float = inf
    boot: int = -1
    at: float = -inf
    ahead: float = inf


class FarRobots:
    """The robots that this one knows over others.

    :param robots: all other robots
    :param neighbours: the robots that are heard
    :param outcomes: takes what comes of it
    :param routes: over whom robots are reached
    :param make_inbox: makes the inbox of a far robot from its id, its boot number and the first packet that counts
    :param share: of the memory, for tables of far robots
    """

    def __init__(
        self,
        robots: OtherRobots,
        neighbours: Neighbours,
        outcomes: Outcomes,
        routes: Routes,
        make_inbox: Callable[[int, int, int], Inbox],
        *,
        share: Share,
    ) -> None:
        self._robots, self._neighbours, self._outcomes, self._routes = robots, neighbours, outcomes, routes
        self._make_inbox = make_inbox
        self._all: dict[int, _Far] = {}
        self._quotas: Quotas[int] = Quotas(BROADCAST, share)

    # ---- looking

    @property
    def inboxes(self) -> dict[int, Inbox]:
        """Those of robots that are or were known over others only, by robot."""
        return {robot: far.inbox for robot, far in self._all.items() if far.inbox is not None}

    def _of(self, robot: int) -> _Far:
        return self._all.setdefault(robot, _Far())

    def present(self, robot: int) -> Inbox | None:
        """The inbox of the present start of a robot: that of one that is heard, or else the latest that is known."""
        known = self._all.get(robot)
        neighbour, far = self._neighbours.all.get(robot), None if known is None else known.inbox
        if neighbour is None or not neighbour.proven:
            return far
        return neighbour.inbox if far is None or not neighbour.gone or neighbour.boot >= far.boot else far

    def inbox(self, robot: int, start: int) -> Inbox | None:
        """Where messages of a start of a robot come together, directly or over others; None for one that is not the
        present start."""
        inbox = self.present(robot)
        return None if inbox is None or inbox.boot & 0xFFFF != start else inbox

    def believes(self, robot: int, made: float) -> bool:
        """Whether what was known of a robot still counts when something else of it was made, s."""
        neighbour = self._neighbours.all.get(robot)
        heard = -inf if neighbour is None or not neighbour.proven else neighbour.heard
        return made <= max(heard, self._robots.of(robot).came) + EXPIRES_S

    def reaches(self, robot: int, boot: int, now: float) -> bool:
        """Whether a start of a robot is reached over others."""
        far = self._all.get(robot)
        return far is not None and far.boot == boot and now < far.at + self._robots.stale_s

    def reached(self, now: float, *, sealed: bool) -> list[HeardRobot]:
        """The robots that are not heard, but reached over others.

        :param sealed: whether packets are sealed
        """
        found = []
        for robot, far in self._all.items():
            neighbour, inbox = self._neighbours.all.get(robot), self.inbox(robot, far.boot & 0xFFFF)
            if far.boot >= 0 and inbox is not None and (neighbour is None or neighbour.gone):
                hops, over = self._robots.of(robot).hops, self._routes.over(robot, now, lambda _: True)
                topics, silent_s = len(inbox.announced.topics), now - far.at
                two = self._neighbours.doubled(robot, now)
                found.append(
                    HeardRobot(robot, silent_s, False, far.boot, sealed, None, 0.0, 0, topics, hops, over, two)
                )
        return found

    # ---- changing

    def met(self, neighbour: Neighbour, now: float) -> None:
        """A robot is heard: what is known of its start over others goes on there, and no other start is known. It may
        bring what is missing of others."""
        robot = neighbour.src_id
        known = self._all.get(robot)
        if known is not None and known.inbox is not None:
            if known.inbox.boot == neighbour.boot:
                neighbour.inbox.adopt(known.inbox)
                came = self._robots.of(robot).came
                known.ahead = came if came > -inf else now
            self.forget(robot, Fate.SENDER_RESTARTED)
        for inbox in self.inboxes.values():
            inbox.order.wait_anew(now)

    def overruled(self, neighbour: Neighbour, number: int, began: float) -> bool:
        """A robot itself has reached this number: whoever has said more was wrong, unless it may have made that after
        this packet. Returns whether somebody may have been wrong."""
        far, sealed_after = self._all.get(neighbour.src_id), neighbour.inbox.deliveries.sealed_after
        if far is None or far.ahead == inf or number < neighbour.inbox.newest:
            return False
        if sealed_after is not None and sealed_after(number) < far.ahead:
            return False
        if neighbour.inbox.overrule(number, began):
            far.ahead = inf
        return True

    def replaced(self, before: Neighbour, now: float) -> None:
        """A robot that is heard has started again. Until its new start is proven, what others bring of the one before
        goes on where that was."""
        far, robot = self._of(before.src_id), self._robots.of(before.src_id)
        if before.proven and far.inbox is None:
            far.inbox = before.inbox
            robot.there = robot.there if robot.there > -inf else now

    def start(self, robot: int, boot: int, first: int, made: float) -> None:
        """A robot is in another start than was known.

        :param first: the first packet that counts
        :param made: when that was made which tells it, s
        """
        neighbour = self._neighbours.all.get(robot)
        self.forget(robot, Fate.SENDER_RESTARTED)
        if neighbour is None or neighbour.boot != boot or not neighbour.proven:
            far = self._of(robot)
            far.inbox, far.first_made = self._make_inbox(robot, boot, first), made

    def hold(self, robot: int, via: int, size: int) -> int:
        """A table of so many bytes is kept; returns how many robots are forgotten for it."""
        if robot not in self._all or self._all[robot].inbox is None:
            return 0
        lost = list(self._quotas.put(robot, via, size))
        for other in lost:
            self.forget(other, Fate.MEMORY)
        return len(lost)

    def begun(self, inbox: Inbox, number: int, made: float) -> Inbox:
        """Where a message goes. The number with which its start began over others was false if the message has a lower
        one and was made much later; this robot would say for ever that it has all up to there."""
        robot = inbox.src_id
        far = self._of(robot)
        if number >= inbox.first - 1 or made <= far.first_made + EXPIRES_S:
            return inbox
        anew = far.inbox = self._make_inbox(robot, inbox.boot, number + 1)
        anew.adopt(inbox)
        far.first_made = made
        return anew

    def came(self, inbox: Inbox, number: int, made: float, now: float) -> None:
        """A message of a robot came over others."""
        src_id = inbox.src_id
        neighbour, far, robot = self._neighbours.all.get(src_id), self._of(src_id), self._robots.of(src_id)
        if neighbour is not None and number > neighbour.inbox.newest:
            far.ahead = now
        robot.came, robot.there = now, max(robot.there, made)
        at = max(made, far.at if far.boot == inbox.boot else -inf)
        if now >= at + self._robots.stale_s:
            return  # it was there when that was made, which is too long ago
        known = neighbour is not None and not neighbour.gone
        if neighbour is not None:
            neighbour.timeout = None
        new, far.boot, far.at = far.boot != inbox.boot, inbox.boot, at
        if new and not known:
            self._outcomes.events.append(Met(src_id, inbox.boot, hears=False))

    def handle_timeout(self, now: float) -> None:
        """Give up robots of which nothing comes any more, and robots that are never heard themselves."""
        for inbox in self.inboxes.values():
            inbox.handle_timeout(now)
        stale_s = self._robots.stale_s
        for robot, far in self._all.items():
            if far.boot >= 0 and now >= far.at + stale_s:
                boot, far.boot = far.boot, -1
                neighbour = self._neighbours.all.get(robot)
                if neighbour is None or neighbour.gone:
                    self._outcomes.events.append(Gone(robot, boot))

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do."""
        stale_s = self._robots.stale_s
        times = [far.at + stale_s for far in self._all.values() if far.boot >= 0]
        times += [at for inbox in self.inboxes.values() if (at := inbox.next_timeout()) is not None]
        return min(times, default=None)

    def forget(self, robot: int, reason: Fate) -> None:
        """A start of a robot that was known over others is over."""
        self._quotas.drop(robot)
        far = self._all.get(robot)
        if far is not None and far.inbox is not None:
            inbox, far.inbox, far.first_made = far.inbox, None, inf
            inbox.close(reason)

    def drop(self, robot: int) -> None:
        """A robot is not known any more."""
        self.forget(robot, Fate.GIVEN_UP)
        self._all.pop(robot, None)
