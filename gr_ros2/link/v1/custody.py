"""Messages for one robot: each robot on the way keeps them until the next one has them, their origin until they came.

This concerns messages of reliable topics with ``to``, and calls of services. A message is handed on as a message of
topic 242, which names the robot that is to take it on; it is cut, repaired and confirmed as messages of reliable topics
are. A robot on the way forgets it once the next one has confirmed every packet of it. Its origin keeps it until the
robot for which it is has it. That robot confirms the packets itself, or sends a *receipt* back, which is carried too.
If a robot to which it was handed is gone or starts again, or if no receipt comes in time, it is handed on again, over
another one if there is one. Messages that fit a packet do not wait for longer ones.

Invariants: a message that was taken is kept until the next robot has all of it, or until the memory is full; an own one
until it has come or is of no more use, which is told; those of one topic are handed on in their order; work per packet
is bounded by ``MOST_HELD``.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from gr_ros2.link.fates import Fate
from gr_ros2.link.key import Key
from gr_ros2.link.queues import Dropped
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.peers import Peers
from gr_ros2.link.v1.sent_packets import SentPackets
from gr_ros2.link.v1.sent_topics import LONG_CARRIED, SentTopics
from gr_ros2.relay.gain import Gains
from gr_ros2.relay.memory import Share
from gr_ros2.relay.quotas import Quotas
from gr_ros2.relay.routes import Routes
from gr_ros2.wire.ages import age_code, limit_code
from gr_ros2.wire.relayed import (
    FIRST_PLACE,
    MOST_HOPS,
    PLACES,
    RECEIPT_TOPIC,
    Receipt,
    Relayed,
    write_carried,
    write_receipts,
)
from gr_ros2.wire.v1 import BROADCAST, CARRIED_TOPIC

MOST_HELD = 1024
"""Messages of other robots that are held; with more, the oldest from the robot that handed over most are lost."""
WAITING = 8
"""Messages that wait in a queue of carried ones, and own ones of a topic that have not left. Further ones wait in the
queue of their topic, by its rules."""
WINDOW = PLACES // 2
"""Most places from the first own message of a topic for a robot that is kept until it has come, to the newest. Those
given up in between count: nobody could tell apart what is ``PLACES`` apart. Further ones wait likewise."""
PATIENCE_S = 30.0
"""s after which a message that has left is handed on again if no receipt has come; more where messages take longer."""
SLOW = 4
"""The same, as a multiple of the s that its first hop took."""
_TRIES = 6
"""The same is doubled with each try, so often at most."""
_ARRIVALS = 16
"""Own messages that have come, from which it follows how long others may take."""
_RECEIPTS, _MOST_RECEIPTS = 16, 256
"""Topics of which a receipt tells, and of which one waits for each robot."""
_COST = 2000
"""Bytes that a message of another robot takes beside its payload."""


class _Name(NamedTuple):
    origin: int
    start: int
    topic_id: int
    number: int
    place: int
    dst_id: int


def _name(message: Relayed) -> _Name:
    return _Name(message.origin, message.start, message.topic_id, message.number, message.place, message.dst_id)


@dataclass(slots=True, eq=False)
class _Held:
    """A message that is kept.

    :param came: the robot from which it came; the own one at its origin
    :param at: when it came, s
    :param made: when it was made, s
    :param until: when it is of no more use, s
    :param own: at its origin: the message as it was submitted
    :param taker: the robot to which it is handed
    :param out: the message that hands it on; None while no way is known
    :param low: first packet of it that the taker may lack
    :param last: packet in which it left whole, -1 before
    :param since: when it was handed on, s
    :param left: when it left whole, s
    :param due: when it is handed on again, s
    :param tries: how often it has left
    """

    message: Relayed
    came: int
    at: float
    made: float
    until: float
    own: Message | None
    long: bool
    taker: int = -1
    out: Message | None = None
    low: int = 0
    last: int = -1
    since: float = 0.0
    left: float = 0.0
    due: float = inf
    tries: int = 0

    @property
    def stream(self) -> tuple[int, ...]:
        """Messages of one robot, start and topic for one robot stay in order."""
        return self.message.origin, self.message.start, self.message.topic_id, self.message.dst_id

    @property
    def name(self) -> _Name:
        return _name(self.message)


class Custody:
    """The messages that this robot keeps until the next robot on their way has them.

    :param own: id and boot number of this robot
    :param topics: what it sends
    :param packets: what has left
    :param peers: the robots that report
    :param gains: knows who hears whom
    :param routes: over whom other robots are reached
    :param room: bytes of the longest body
    :param most: bytes of own messages of a topic that may be held
    :param share: of the memory, for those of others
    :param dropped: counts what is lost
    :param drop: called with own messages that are too late
    :param ended: called with own messages that have come, or of which this is not known and that are kept no longer
    """

    def __init__(
        self,
        own: tuple[int, int],
        topics: SentTopics,
        packets: SentPackets,
        peers: Peers,
        *,
        gains: Gains,
        routes: Routes,
        room: int,
        most: int,
        share: Share,
        dropped: Counter[str],
        drop: Callable[[list[Dropped[Message]]], None],
        ended: Callable[[int, int, int, bool], None],
    ) -> None:
        self.routes = routes
        self._src_id, self._start, self._boot = own[0], own[1] & 0xFFFF, own[1]
        self._topics, self._packets, self._peers, self._gains = topics, packets, peers, gains
        self._room, self._most, self._dropped, self._drop, self._ended = room, most, dropped, drop, ended
        self._quotas: Quotas[_Name] = Quotas(MOST_HELD, share, _COST)
        self._held: dict[_Name, _Held] = {}
        self._own: dict[tuple[int, int], list[_Held]] = {}
        """Own messages by topic and robot, in order."""
        self._newest: dict[tuple[int, int], tuple[int, int]] = {}
        """Number and place of the newest of them."""
        self._passed: dict[_Name, int] = {}
        """The robots that have taken on what was forgotten here."""
        self._receipts: dict[int, dict[tuple[int, int], Receipt]] = {}
        """By robot, and by its start and topic: what it is to be told."""
        self._arrivals = deque[float]((0.0,), maxlen=_ARRIVALS)
        """How long own messages took until it was known that they had come, s."""
        self._bytes = self._place = 0

    def __len__(self) -> int:
        return len(self._held)

    @property
    def held_bytes(self) -> int:
        """Bytes of the messages that are held."""
        return self._bytes

    # ---- what comes

    def take(self, message: Relayed, came: int, now: float, *, made: float, until: float = inf) -> None:
        """Take a message on that another robot hands over.

        :param made: when it was made, s
        :param until: when it is of no more use, s
        """
        held = _Held(message, came, now, made, until, None, self._is_long(message))
        name = held.name
        if name in self._held:
            self._dropped["relayed_before"] += 1
            self.handed_back(self._src_id, message, came, now)
        elif message.hops >= MOST_HOPS:
            self._dropped["too_many_hops"] += 1
        else:
            if name in self._passed:  # whoever took it on has lost it
                self.routes.doubt(message.dst_id, self._passed[name], now)
            self._hold(held)

    def handed_back(self, taker: int, message: Relayed, by: int, now: float) -> None:
        """A robot hands a message on that is held here: where it hands it back, it knows no other way.

        :param taker: to whom it hands it
        """
        held = self._held.get(_name(message))
        if held is not None and taker == self._src_id and held.taker == by and held.last >= 0:
            held.due = now

    def _hold(self, held: _Held) -> None:
        held.long = held.long or any(other.long and other.stream == held.stream for other in self._held.values())
        self._held[held.name] = held
        self._bytes += len(held.message.payload)
        if held.own is None:
            for lost in self._quotas.put(held.name, held.came, 2 * len(held.message.payload)):  # also as it leaves
                self._dropped["custody_full"] += 1
                self._forget(self._held[lost])

    def _is_long(self, message: Relayed) -> bool:
        return len(write_carried(0, message)) > self._room

    def _gather(self, now: float) -> None:
        """Take own messages on that are for one robot."""
        for topic in self._topics.named():
            queue = topic.queue
            queue.closed = False
            if not queue or not topic.in_order or topic.coded:
                continue
            full = set[int]()
            for message in [waiting for waiting in queue if not waiting.started]:
                assert isinstance(message, Message)
                robot = message.dst_id
                if robot == BROADCAST or robot in full or not self.routes.known(robot):
                    continue  # what is for a robot that was never reached is sent once, to whoever hears it
                if self._is_full(message):
                    queue.closed = True
                    full.add(robot)
                else:
                    queue.remove(message)
                    self._submit(message, now)

    def _is_full(self, message: Message) -> bool:
        stream = message.topic_id, message.dst_id
        own = self._own.get(stream)
        if not own:
            return False
        places = (self._newest[stream][1] - own[0].message.place) % PLACES + 1
        if places >= WINDOW or sum(held.last < 0 for held in own) >= WAITING:
            return True
        return sum(len(held.message.payload) for held in own) + len(message.payload) > self._most

    def _submit(self, message: Message, now: float) -> None:
        stream = message.topic_id, message.dst_id
        before, place = self._newest.get(stream, (-1, FIRST_PLACE - 1))
        place = FIRST_PLACE + (place + 1 - FIRST_PLACE) % PLACES
        number = max(self._packets.newest, before + (place == FIRST_PLACE))
        self._newest[stream] = number, place
        made, until = message.made, message.expires
        relayed = Relayed(
            self._src_id,
            self._start,
            number,
            place,
            message.topic_id,
            0,
            message.payload,
            message.coded,
            message.dst_id,
            limit=limit_code(until - made),
        )
        held = _Held(relayed, self._src_id, now, made, until, message, self._is_long(relayed))
        self._own.setdefault(stream, []).append(held)
        self._hold(held)

    # ---- what leaves

    def offer(self, now: float, leaves: float) -> None:
        """Put messages into the queues of what leaves next, as far as there is a way for them.

        :param leaves: when the packet leaves, s
        """
        self._gather(now)
        self._tell(now)
        for held in list(self._held.values()):
            left = held.last >= 0 or (held.out is not None and held.out.started)
            if now >= held.until:
                if held.own is None:
                    self._dropped["too_old"] += 1
                    self._forget(held)
                else:
                    self._end(held, arrived=False)
                continue
            if now >= held.due:
                self.routes.doubt(held.message.dst_id, held.taker, now)
                self._take_back(held)
            if held.out is None:
                self._hand_on(held, now)
            if not left and held.out is not None:
                held.out.payload = self._written(held, leaves)

    def _hand_on(self, held: _Held, now: float) -> None:
        topic_id = LONG_CARRIED if held.long else CARRIED_TOPIC
        queue, message, own = self._topics[topic_id].queue, held.message, held.own
        taker = self._way(message.dst_id, held.came, held.at, now)
        if taker is None or len(queue) >= WAITING:
            return
        held.taker, held.since = taker, now
        payload = self._written(held, now)
        if own is None:
            held.out = Message(-1, topic_id, payload, 0, held.at, repeat=True)
        else:
            key = Key(self._boot, message.number, message.place)
            held.out = Message(own.serial, topic_id, payload, own.qos, own.submitted, own.weight)
            held.out.repeat, held.out.carried = own.repeat or held.tries > 0 or held.low > 0, (own.topic_id, key)
        held.out.expires = held.until
        queue.append(held.out)

    def _written(self, held: _Held, leaves: float) -> bytes:
        """A message as it leaves at a time, s."""
        message, own = held.message, held.own
        waits = message.waits
        if own is not None:
            waits = (message.place - self._own[own.topic_id, own.dst_id][0].message.place) % PLACES
        hops, age = message.hops + (held.came != self._src_id), age_code(leaves - held.made)
        return write_carried(held.taker, message._replace(hops=hops, age=age, waits=waits))

    def _way(self, robot: int, came: int, at: float, now: float) -> int | None:
        """To whom a message is handed: not back to whom it came from, unless that is long ago; and to nobody before its
        first report, since it is not known from which packet on it listens."""

        def usable(via: int) -> bool:
            reports = via in self._peers.all and self._peers.all[via].newest >= 0
            return reports and self._gains.hears(via, now) and (via != came or now > at + self._gains.robots.stale_s)

        return self.routes.over(robot, now, usable)

    def left(self, message: Message, now: float) -> None:
        """A message of topic 242 has left whole, in the packet that is composed."""
        for held in self._held.values():
            if held.out is message:
                held.low, held.last, held.left = message.begin, self._packets.newest + 1, now
                if held.own is not None and held.taker != held.message.dst_id:
                    patience = max(PATIENCE_S, SLOW * (now - held.since), 2 * max(self._arrivals))
                    held.due = now + patience * 2 ** min(held.tries, _TRIES)
                held.tries += 1

    def repaired_for(self, message: Message) -> Callable[[int, float], bool]:
        """For a message that leaves whole in the packet that is composed: whether a part of it is being repaired for a
        robot at a time, s."""
        lifetime, first, last = message.lifetime, message.begin, self._packets.newest + 1

        def repaired(robot: int, now: float) -> bool:
            peer = self._peers.all.get(robot)
            if peer is None or now >= lifetime.expires:
                return False
            return self._packets.first_lacked(peer.bit, first, last, lifetime) <= last

        return repaired

    # ---- what other robots have

    def reported(self, robot: int, now: float) -> None:
        """A robot has said which packets it has: what it has whole is forgotten, except own messages for others."""
        peer = self._peers.all.get(robot)
        if peer is None:
            return
        for held in [held for held in self._held.values() if held.taker == robot]:
            if held.out is not None and 0 <= held.low <= held.last:
                held.low = self._packets.first_lacked(peer.bit, held.low, held.last, held.out.lifetime)
            if not 0 <= held.last < held.low or held.out is None or held.out.begin > peer.settled:
                continue  # it lacks a part, or waits there for what is missing before it
            if held.own is None:
                self._passed[held.name] = robot
                if len(self._passed) > MOST_HELD:
                    del self._passed[next(iter(self._passed))]
                self._forget(held)
            elif robot == held.own.dst_id and held is self._own[held.own.topic_id, robot][0]:
                self._arrived(held, now)

    def receipt(self, robot: int, receipt: Receipt) -> None:
        """Tell a robot what has come of its messages."""
        waiting = self._receipts.setdefault(robot, {})
        waiting[receipt.start, receipt.topic_id] = receipt
        if len(waiting) > _MOST_RECEIPTS:
            del waiting[next(iter(waiting))]

    def _tell(self, now: float) -> None:
        """Make receipts. Until one has left, the next one waits, and tells of all that has come by then."""
        under_way = {
            held.message.dst_id
            for held in self._held.values()
            if held.message.topic_id == RECEIPT_TOPIC and held.came == self._src_id and held.last < 0
        }
        for robot in [robot for robot in self._receipts if robot not in under_way]:
            waiting = self._receipts[robot]
            told = [waiting.pop(of) for of in list(waiting)[:_RECEIPTS]]
            if not waiting:
                del self._receipts[robot]
            self._place = FIRST_PLACE + (self._place + 1) % PLACES
            message = Relayed(
                self._src_id,
                self._start,
                self._packets.newest,
                self._place,
                RECEIPT_TOPIC,
                0,
                write_receipts(told),
                dst_id=robot,
            )
            self._hold(_Held(message, self._src_id, now, now, inf, None, long=False))

    def told(self, robot: int, receipts: list[Receipt], now: float) -> None:
        """A robot has told what has come of this one's messages."""
        for start, topic_id, number, place in receipts:
            if start != self._start:
                continue
            if (number, place) > self._newest.get((topic_id, robot), (-1, 0)):
                self._dropped["false_origin"] += 1  # no such message has been made
                for held in self._own.get((topic_id, robot), []):  # a robot that was told of one has refused these
                    held.due = min(held.due, max(now, held.left + PATIENCE_S)) if held.due < inf else inf
                continue
            own = self._own.get((topic_id, robot), [])
            while own and (own[0].message.number, own[0].message.place) <= (number, place):
                self._arrived(own[0], now)

    def _arrived(self, held: _Held, now: float) -> None:
        self.routes.trust(held.message.dst_id, held.taker)
        if held.last >= 0:
            self._arrivals.append(now - held.left)
        self._end(held, arrived=True)

    def _end(self, held: _Held, *, arrived: bool) -> None:
        """An own message is kept no longer."""
        own = held.own
        assert own is not None
        fate = Fate.ABANDONED if held.out is not None and held.out.started else Fate.STALE
        self._forget(held)
        if not arrived and not held.tries and not held.low:
            self._drop([Dropped(own, fate, "it waited too long for its way to another robot")])
        else:
            self._ended(own.serial, own.topic_id, own.dst_id, arrived)
        later = self._own.get((own.topic_id, own.dst_id), [])
        if not arrived and later and later[0].last >= 0:
            self._take_back(later[0])  # the robot for which it is waits for what is over

    def gone(self, robot: int) -> None:
        """A robot is gone, or has started again: what was handed to it is handed to another one."""
        for held in self._held.values():
            if held.taker == robot:
                self._take_back(held)

    def _take_back(self, held: _Held) -> None:
        if held.out is not None:
            queue = self._topics[held.out.topic_id].queue
            if held.out in queue:
                queue.remove(held.out)
            held.out.lifetime.end()
        held.taker, held.out, held.last, held.due = -1, None, -1, inf

    def _forget(self, held: _Held) -> None:
        del self._held[held.name]
        self._quotas.drop(held.name)
        if held.own is not None:
            stream = held.own.topic_id, held.own.dst_id
            self._own[stream].remove(held)
            if not self._own[stream]:
                del self._own[stream]
        self._bytes -= len(held.message.payload)
        self._take_back(held)
