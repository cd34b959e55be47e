"""Messages for one robot that is not heard: each robot on the way keeps them until the next one has them.

This concerns messages of reliable topics with ``to``, and calls of services. A message is handed on as a message of
topic 242, which names the robot that is to take it on; it is cut, repaired and confirmed as messages of reliable topics
are. Once that robot has confirmed every packet of it, it is forgotten here. If the robot is gone before, the message is
handed to another one, as soon as a way is known. Messages that fit a packet do not wait for longer ones.

Invariants: a message that was taken is kept until the next robot has all of it, or until the memory is full; those of
one topic are handed on in their order; work per packet is bounded by ``MOST_HELD``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from gr_ros2.link.fates import Fate
from gr_ros2.link.queues import Dropped
from gr_ros2.link.v1.key import Key
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.peers import Peers
from gr_ros2.link.v1.sent_packets import SentPackets
from gr_ros2.link.v1.sent_topics import LONG_CARRIED, SentTopics
from gr_ros2.relay.gain import Gains
from gr_ros2.relay.rooms import Rooms
from gr_ros2.relay.routes import STALE_S, Routes
from gr_ros2.wire.relayed import MOST_HOPS, Relayed, age_code, limit_code, write_carried
from gr_ros2.wire.v1 import BROADCAST, CARRIED_TOPIC

MOST_HELD = 1024
"""Messages of other robots that are held; with more, the oldest from the robot that handed over most are lost."""
WAITING = 8
"""Messages that wait in a queue of carried ones. Own ones beyond wait in the queue of their topic, by its rules."""
_FIRST_PLACE = 128
"""Own carried messages are named after the last packet before them, with places that no entry has."""


class _Name(NamedTuple):
    origin: int
    start: int
    topic_id: int
    number: int
    place: int


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

    @property
    def stream(self) -> tuple[int, ...]:
        """Messages of one robot, start and topic for one robot stay in order."""
        return self.message.origin, self.message.start, self.message.topic_id, self.message.dst_id


class Custody:
    """See the module.

    :param own: id and boot number of this robot
    :param topics: what it sends
    :param packets: what has left
    :param peers: the robots that report
    :param gains: knows who hears whom
    :param room: bytes of the longest body
    :param most: bytes of messages of others that may be held
    :param dropped: counts what is lost
    :param drop: called with own messages that are too late
    :ivar routes: over whom other robots are reached
    """

    def __init__(
        self,
        own: tuple[int, int],
        topics: SentTopics,
        packets: SentPackets,
        peers: Peers,
        *,
        gains: Gains,
        room: int,
        most: int,
        dropped: Counter[str],
        drop: Callable[[list[Dropped[Message]]], None],
    ) -> None:
        self.routes = Routes()
        self._src_id, self._boot = own
        self._topics, self._packets, self._peers, self._gains = topics, packets, peers, gains
        self._room, self._dropped, self._drop = room, dropped, drop
        self._rooms: Rooms[_Name] = Rooms(MOST_HELD, most)
        self._held: dict[_Name, _Held] = {}
        self._bytes = self._named = 0

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
        name = _Name(message.origin, message.start, message.topic_id, message.number, message.place)
        if name in self._held:
            self._dropped["relayed_before"] += 1
        elif message.hops >= MOST_HOPS:
            self._dropped["too_many_hops"] += 1
        else:
            self._hold(name, _Held(message, came, now, made, until, None, self._is_long(message)))

    def _hold(self, name: _Name, held: _Held) -> None:
        held.long = held.long or any(other.long and other.stream == held.stream for other in self._held.values())
        self._held[name] = held
        self._bytes += len(held.message.payload)
        if held.own is None:
            for lost in self._rooms.put(name, held.came, len(held.message.payload)):
                self._dropped["custody_full"] += 1
                self._forget(lost)

    def _is_long(self, message: Relayed) -> bool:
        return len(write_carried(0, message)) > self._room

    def _gather(self, now: float) -> None:
        """Take own messages on that are for a robot which is not heard."""
        for topic in self._topics.named():
            queue = topic.queue
            queue.closed = False
            if not queue or not topic.in_order:
                continue
            for message in [waiting for waiting in queue if not waiting.started]:
                assert isinstance(message, Message)
                if message.dst_id == BROADCAST or not self._far(message, now):
                    continue
                if sum(held.last < 0 for held in self._held.values() if held.own is not None) >= WAITING:
                    queue.closed = True
                    break
                queue.remove(message)
                self._submit(message, now)

    def _far(self, message: Message, now: float) -> bool:
        way = self._way(message.dst_id, self._src_id, now, now)
        stream = self._src_id, self._boot & 0xFFFF, message.topic_id, message.dst_id
        return way is not None and (way != message.dst_id or any(h.stream == stream for h in self._held.values()))

    def _submit(self, message: Message, now: float) -> None:
        number, place = self._packets.newest, _FIRST_PLACE + self._named % (256 - _FIRST_PLACE)
        self._named += 1
        start, of, to = self._boot & 0xFFFF, message.topic_id, message.dst_id
        relayed = Relayed(self._src_id, start, number, place, of, 0, message.payload, message.coded, to)
        relayed = relayed._replace(limit=limit_code(message.expires - message.submitted))
        name = _Name(self._src_id, start, of, number, place)
        made, until, long = message.submitted, message.expires, self._is_long(relayed)
        self._hold(name, _Held(relayed, self._src_id, now, made, until, message, long))

    # ---- what leaves

    def offer(self, now: float, leaves: float) -> None:
        """Put messages into the queues of what leaves next, as far as there is a way for them.

        :param leaves: when the packet leaves, s
        """
        self._gather(now)
        for name, held in list(self._held.items()):
            left = held.last >= 0 or (held.out is not None and held.out.started)
            if now >= held.until:
                if held.own is None:
                    self._dropped["too_old"] += 1
                elif not held.low and held.last < 0:
                    fate = Fate.ABANDONED if left else Fate.STALE
                    self._drop([Dropped(held.own, fate, "it waited too long for its way to another robot")])
                self._forget(name)
            elif held.out is None:
                self._hand_on(name, held, now)
            if not left and held.out is not None:
                held.out.payload = self._written(held, leaves)

    def _hand_on(self, name: _Name, held: _Held, now: float) -> None:
        topic_id = LONG_CARRIED if held.long else CARRIED_TOPIC
        queue, message, own = self._topics[topic_id].queue, held.message, held.own
        taker = self._way(message.dst_id, held.came, held.at, now)
        if taker is None or len(queue) >= WAITING:
            return
        held.taker = taker
        payload = self._written(held, now)
        if own is None:
            held.out = Message(-1, topic_id, payload, 0, held.at, repeat=True)
        else:
            key = Key(self._boot, name.number, name.place)
            held.out = Message(own.serial, topic_id, payload, own.qos, own.submitted, own.weight)
            held.out.repeat, held.out.carried = own.repeat or held.low > 0, (name.topic_id, key)
        held.out.expires = held.until
        queue.append(held.out)

    def _written(self, held: _Held, leaves: float) -> bytes:
        """A message as it leaves at a time, s."""
        hops, age = held.message.hops + (held.own is None), age_code(leaves - held.made)
        return write_carried(held.taker, held.message._replace(hops=hops, age=age))

    def _way(self, robot: int, came: int, at: float, now: float) -> int | None:
        """To whom a message is handed: not back to whom it came from, unless that is long ago."""

        def usable(via: int) -> bool:
            return via in self._peers.all and self._gains.hears(via, now) and (via != came or now > at + STALE_S)

        return self.routes.over(robot, now, usable)

    def left(self, message: Message) -> None:
        """A message of topic 242 has left whole, in the packet that is composed."""
        for held in self._held.values():
            if held.out is message:
                held.low, held.last = message.begin, self._packets.newest + 1

    # ---- what other robots have

    def reported(self, robot: int) -> None:
        """A robot has said which packets it has: what it has whole is forgotten here."""
        peer = self._peers.all.get(robot)
        if peer is None:
            return
        records = self._packets.records
        for name, held in [(name, held) for name, held in self._held.items() if held.taker == robot]:
            while held.out is not None and 0 <= held.low <= held.last:
                record = records.get(held.low)
                if record is not None and not record.confirmed & peer.bit and held.out.lifetime in record.lifetimes:
                    break
                held.low += 1
            if 0 <= held.last < held.low:
                self._forget(name)

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
        held.taker, held.out, held.last = -1, None, -1

    def _forget(self, name: _Name) -> None:
        held = self._held.pop(name)
        self._rooms.drop(name)
        self._bytes -= len(held.message.payload)
        self._take_back(held)
