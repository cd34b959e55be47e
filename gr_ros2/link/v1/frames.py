"""The frames of a sender's coded topics (:mod:`gr_ros2.link.frames`): what of them has left, and who has them.

Invariants: memory is the numbers of the packets that carry frames which somebody who reports lacks; a packet without
frames costs nothing but its count.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from math import inf
from typing import Protocol

from gr_ros2.link.fates import Fate
from gr_ros2.link.frames import LONG_S, FrameState
from gr_ros2.link.ledger import SenderLedger
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.neighbours import Neighbour
from gr_ros2.link.v1.peers import Peer, Peers
from gr_ros2.link.v1.sent_packets import SentPackets
from gr_ros2.link.v1.sent_topics import SentTopic, SentTopics
from gr_ros2.link.v1.used_air import UsedAir

_LEAST_FREE = 0.1
"""Part of the channel that coded topics may count on; else they would never learn that more is free."""
SILENT_S, REPORTS = 0.5, 4
"""A robot is silent when no report has come for so many s, and for so many of its mean times between two."""
FILLS_S = 1.0
"""s for which a frame says that more will come."""


class Outlet(Protocol):
    """What frames need of the message side.

    :ivar ledger: what becomes of its messages
    :ivar asks: how often others have asked for what is kept of a topic, or for a key frame
    """

    ledger: SenderLedger
    asks: Counter[int]

    def submit_frame(
        self, topic: SentTopic, frame: bytes, came: float, now: float, *, key: bool, chain: int
    ) -> Message | None:
        """Put a frame into the queue of its topic; None if it is too large."""

    def becomes_coded(self, topic_id: int) -> None:
        """Announce that frames of a topic follow."""


class SentFrames:
    """The coded topics of one sender.

    :param packets, peers: what has left, and what reports tell of it
    :param used: what of the air is used
    :param neighbours: the robots that are heard
    :param relayed: see :class:`gr_ros2.link.frames.FrameSide`
    :ivar sent: frames of each coded topic that have begun to leave or wait, until all who report have them
    """

    def __init__(
        self,
        topics: SentTopics,
        outlet: Outlet,
        packets: SentPackets,
        peers: Peers,
        used: UsedAir,
        *,
        neighbours: Mapping[int, Neighbour],
        relayed: bool,
    ) -> None:
        self.relayed = relayed
        self._topics, self._outlet, self._packets, self._peers = topics, outlet, packets, peers
        self._used, self._neighbours = used, neighbours
        self.sent: dict[int, deque[Message]] = {}
        self._ages: dict[int, float] = {}
        self._submitted = -inf
        """When the newest frame came, s."""

    def begin(self, topic_id: int, output: str = "") -> None:
        """Send frames of a topic from now on."""
        self._topics[topic_id].become_frames(output)
        self.sent.setdefault(topic_id, deque())
        self._used.leave_out(topic_id)
        self._ages.setdefault(topic_id, 0.0)
        self._outlet.becomes_coded(topic_id)

    def end(self, topic_id: int) -> None:
        """No frame of a topic follows, and those that have left are of no more use."""
        sent = self.sent[topic_id]
        while sent:
            sent.popleft().lifetime.end()

    def asks(self, topic_id: int) -> int:
        """How often a robot has asked for the topic, within what is answered."""
        return self._outlet.asks[topic_id]

    @property
    def reports(self) -> bool:
        """Whether any robot reports."""
        return bool(self._peers)

    def progress(self, topic_id: int, now: float) -> FrameState:
        """How it stands."""
        queue = self._topics[topic_id].queue
        waiting = sum(message.remaining for message in queue)
        lags = self._lags(topic_id, now)
        silent = bool(lags) and not any(self._heard(peer, now) for peer in self._reporting)
        joined = self._peers.joined + self.asks(topic_id)
        lacked, behind = min(lags, default=0.0), max(lags, default=0.0)
        return FrameState(self._free(now), waiting, lacked, behind, silent, self._ages[topic_id], joined, self.reports)

    def submit(self, topic_id: int, frame: bytes, came: float, now: float, *, key: bool, chain: int = 0) -> bool:
        """Send a frame; False where it is too large. A key frame ends those that somebody has long lacked."""
        message = self._outlet.submit_frame(self._topics[topic_id], frame, came, now, key=key, chain=chain)
        if message is None:
            return False
        for before in self.sent[topic_id] if key else ():
            if before.keys == message.keys and now - before.left_at > LONG_S:
                before.lifetime.end()
        self.sent[topic_id].append(message)
        self._submitted = now
        return True

    def fill(self, now: float) -> bool:
        """Whether frames have been coming lately, which fill what others leave of the channel."""
        return now - self._submitted < FILLS_S

    def refuse(self, topic_id: int, fate: Fate, detail: str) -> None:
        """A message is not coded."""
        ledger = self._outlet.ledger
        ledger.refuse(ledger.new(topic_id), topic_id, fate, detail)

    def watched(self, topic_id: int) -> None:
        """Somebody has begun to watch a topic, and needs a key frame."""
        self._outlet.asks[topic_id] += 1

    def lost(self, src_id: int, topic_id: int) -> None:
        """A frame of another robot could not be decoded: that robot is asked for a key frame."""
        if (neighbour := self._neighbours.get(src_id)) is not None:
            neighbour.lost_frames.add(topic_id)

    def _free(self, now: float) -> float:
        """bytes/s that other topics leave."""
        capacity = self._used.capacity(now)
        return max(_LEAST_FREE * capacity, capacity - self._used.rate(now))

    @property
    def _reporting(self) -> list[Peer]:
        """The robots that have reported since they came."""
        return [peer for peer in self._peers.all.values() if not peer.joins]

    def _heard(self, peer: Peer, now: float) -> bool:
        """Whether a robot has reported lately."""
        return now - peer.heard <= max(SILENT_S, REPORTS * max(peer.interval, peer.calm))

    def _lags(self, topic_id: int, now: float) -> list[float]:
        """For how long each robot has lacked a frame, s. One that was heard lately lacks what it lacked then."""
        sent, records, everybody = self.sent[topic_id], self._packets.records, self._packets.everybody
        oldest = dict.fromkeys((peer.bit for peer in self._reporting), inf)
        for message in list(sent):
            lacking = 0
            for number in list(message.numbers):
                record = records.get(number)
                missing = 0 if record is None else everybody & ~record.confirmed
                if missing:
                    lacking |= missing
                else:
                    message.numbers.remove(number)
            if message.lifetime.left and (not message.numbers or message.lifetime.expires == -inf):
                sent.remove(message)
                self._ages[topic_id] = now - message.submitted
            elif lacking:
                for bit in oldest:
                    if lacking & bit:
                        oldest[bit] = min(oldest[bit], message.left_at)
        return [
            max(0.0, (peer.heard if self._heard(peer, now) else now) - oldest[peer.bit]) for peer in self._reporting
        ]
