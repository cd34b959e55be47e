"""The robots known over others: which start each is in, where its messages come together, and when it was there last.

*Trust.* Which start a robot is in and how far it is come from it alone as long as it is heard. Of a robot that is not
heard, a number or a start that came over others counts until the robot itself says less, or until something with a
lower one was made ``EXPIRES_S`` after it came.

Invariant: everything here is forgotten: at once where the robot is met, after ``FAR_S`` in any case.
"""

from __future__ import annotations

from collections.abc import Callable
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
from gr_ros2.relay.routes import Routes
from gr_ros2.wire.v1 import BROADCAST

FAR_S = 600.0
"""s after which a robot that is known over others only is forgotten, and with it what has come of it."""


class FarRobots:
    """The robots that this one knows over others.

    :param neighbours: the robots that are heard
    :param outcomes: takes what comes of it
    :param routes: over whom robots are reached
    :param make_inbox: makes the inbox of a far robot from its id, its boot number and the first packet that counts
    :param share: of the memory, for tables of far robots
    :ivar inboxes: of robots that are or were known over others only
    :ivar hops: over how many robots the newest message of each robot came; 0 for directly
    :ivar there: when each robot was there last, s
    """

    def __init__(
        self,
        neighbours: Neighbours,
        outcomes: Outcomes,
        routes: Routes,
        make_inbox: Callable[[int, int, int], Inbox],
        *,
        share: Share,
    ) -> None:
        self.inboxes: dict[int, Inbox] = {}
        self.hops: dict[int, int] = {}
        self.there: dict[int, float] = {}
        self._neighbours, self._outcomes, self._routes = neighbours, outcomes, routes
        self._make_inbox = make_inbox
        self._here: dict[int, tuple[int, float]] = {}
        """Robots that are reached over others: boot number, and when something of them last came, s."""
        self._quotas: Quotas[int] = Quotas(BROADCAST, share)
        self._first_made: dict[int, float] = {}
        """When that was made with which each start in ``inboxes`` began, s."""
        self._came: dict[int, float] = {}
        """When something of its present start came over others, s."""
        self._ahead: dict[int, float] = {}
        """When, s, a message of a robot came over others with a number that it had not reached itself."""

    # ---- looking

    def present(self, robot: int) -> Inbox | None:
        """The inbox of the present start of a robot: that of one that is heard, or else the latest that is known."""
        neighbour, far = self._neighbours.all.get(robot), self.inboxes.get(robot)
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
        return made <= max(heard, self._came.get(robot, -inf)) + EXPIRES_S

    def reaches(self, robot: int, boot: int, now: float) -> bool:
        """Whether a start of a robot is reached over others."""
        known, at = self._here.get(robot, (-1, -inf))
        return known == boot and now < at + self._routes.stale_s

    def reached(self, now: float, *, sealed: bool) -> list[HeardRobot]:
        """The robots that are not heard, but reached over others.

        :param sealed: whether packets are sealed
        """
        found = []
        for robot, (boot, at) in self._here.items():
            neighbour, inbox = self._neighbours.all.get(robot), self.inbox(robot, boot & 0xFFFF)
            if inbox is not None and (neighbour is None or neighbour.gone):
                hops, over = self.hops.get(robot, 0), self._routes.over(robot, now, lambda _: True)
                topics = len(inbox.announced.topics)
                two = self._neighbours.doubled(robot, now)
                found.append(HeardRobot(robot, now - at, False, boot, sealed, None, 0.0, 0, topics, hops, over, two))
        return found

    # ---- changing

    def met(self, neighbour: Neighbour, now: float) -> None:
        """A robot is heard: what is known of its start over others goes on there, and no other start is known. It may
        bring what is missing of others."""
        robot = neighbour.src_id
        if (far := self.inboxes.get(robot)) is not None:
            if far.boot == neighbour.boot:
                neighbour.inbox.adopt(far)
                self._ahead[robot] = self._came.get(robot, now)
            self.forget(robot, Fate.SENDER_RESTARTED)
        for inbox in self.inboxes.values():
            inbox.order.wait_anew(now)

    def overruled(self, neighbour: Neighbour, number: int) -> bool:
        """A robot itself has reached this number: whoever has said more was wrong, unless it may have made that after
        this packet. Returns whether somebody may have been wrong."""
        robot, sealed_after = neighbour.src_id, neighbour.inbox.deliveries.sealed_after
        if robot not in self._ahead or number < neighbour.inbox.newest:
            return False
        if sealed_after is not None and sealed_after(number) < self._ahead[robot]:
            return False
        if neighbour.inbox.overrule(number):
            del self._ahead[robot]
        return True

    def replaced(self, before: Neighbour, now: float) -> None:
        """A robot that is heard has started again. Until its new start is proven, what others bring of the one before
        goes on where that was."""
        if before.proven and before.src_id not in self.inboxes:
            self.inboxes[before.src_id] = before.inbox
            self.there.setdefault(before.src_id, now)

    def start(self, robot: int, boot: int, first: int, made: float) -> None:
        """A robot is in another start than was known.

        :param first: the first packet that counts
        :param made: when that was made which tells it, s
        """
        neighbour = self._neighbours.all.get(robot)
        self.forget(robot, Fate.SENDER_RESTARTED)
        if neighbour is None or neighbour.boot != boot or not neighbour.proven:
            self.inboxes[robot] = self._make_inbox(robot, boot, first)
            self._first_made[robot] = made

    def hold(self, robot: int, via: int, size: int) -> int:
        """A table of so many bytes is kept; returns how many robots are forgotten for it."""
        if robot not in self.inboxes:
            return 0
        lost = list(self._quotas.put(robot, via, size))
        for other in lost:
            self.forget(other, Fate.MEMORY)
        return len(lost)

    def begun(self, inbox: Inbox, number: int, made: float) -> Inbox:
        """Where a message goes. The number with which its start began over others was false if the message has a lower
        one and was made much later; this robot would say for ever that it has all up to there."""
        robot = inbox.src_id
        if number >= inbox.first - 1 or made <= self._first_made.get(robot, inf) + EXPIRES_S:
            return inbox
        anew = self.inboxes[robot] = self._make_inbox(robot, inbox.boot, number + 1)
        anew.adopt(inbox)
        self._first_made[robot] = made
        return anew

    def came(self, inbox: Inbox, number: int, made: float, now: float) -> None:
        """A message of a robot came over others."""
        robot = inbox.src_id
        neighbour = self._neighbours.all.get(robot)
        if neighbour is not None and number > neighbour.inbox.newest:
            self._ahead[robot] = now
        self._came[robot] = now
        self.there[robot] = max(self.there.get(robot, -inf), made)
        boot, at = self._here.get(robot, (-1, -inf))
        at = max(made, at if boot == inbox.boot else -inf)
        if now >= at + self._routes.stale_s:
            return  # it was there when that was made, which is too long ago
        known = neighbour is not None and not neighbour.gone
        if neighbour is not None:
            neighbour.timeout = None
        self._here[robot] = inbox.boot, at
        if boot != inbox.boot and not known:
            self._outcomes.events.append(Met(robot, inbox.boot, hears=False))

    def handle_timeout(self, now: float) -> None:
        """Give up robots of which nothing comes any more, and robots that are never heard themselves."""
        for inbox in self.inboxes.values():
            inbox.handle_timeout(now)
        stale_s = self._routes.stale_s
        for robot, (boot, at) in list(self._here.items()):
            if now >= at + stale_s:
                del self._here[robot]
                neighbour = self._neighbours.all.get(robot)
                if neighbour is None or neighbour.gone:
                    self._outcomes.events.append(Gone(robot, boot))

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do."""
        stale_s = self._routes.stale_s
        times = [at + stale_s for _, at in self._here.values()]
        times += [at for inbox in self.inboxes.values() if (at := inbox.next_timeout()) is not None]
        return min(times, default=None)

    def forget(self, robot: int, reason: Fate) -> None:
        """A start of a robot that was known over others is over."""
        self._quotas.drop(robot)
        self._first_made.pop(robot, None)
        if (inbox := self.inboxes.pop(robot, None)) is not None:
            inbox.close(reason)

    def forget_old(self, now: float) -> list[int]:
        """Forget the robots that were there too long ago; returns them."""
        old = [robot for robot, at in self.there.items() if now > max(at, self._came.get(robot, at)) + FAR_S]
        for robot in old:
            del self.there[robot]
            self._came.pop(robot, None)
            self.forget(robot, Fate.GIVEN_UP)
        return old
