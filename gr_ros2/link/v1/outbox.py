"""The messages that wait to be sent: the message side of an endpoint.

Which of them goes into the next packet says ``packing``, how long it is worth repairing ``lifetime``, and what is kept
for robots that join late ``kept``.

Invariants: every message is sent or ends in a Refused with its fate; a topic id is for the same robot as long as this
start lasts, so that no older table of a receiver lets it deliver what is for another one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import Any, Protocol

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.link.endpoint import CodedMessage, check_live_options
from gr_ros2.link.fates import Fate
from gr_ros2.link.instances import InstancesOf, no_instances
from gr_ros2.link.ledger import MessageObserver, SenderLedger
from gr_ros2.link.message_codec import FRAME, MessageCodec
from gr_ros2.link.queues import OVERLOAD_S, OVERLOADED, Dropped, PublisherQos
from gr_ros2.link.stats import SenderStats
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.kept import KeptMessages
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.packing import ENTRY, Packing
from gr_ros2.link.v1.peers import Peers
from gr_ros2.link.v1.sent_topics import RELAYED, SentTopic, SentTopics
from gr_ros2.settings.config import QueuePolicy, SendOptions
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import NewTopic, Registry, Topic
from gr_ros2.wire.v1 import MAX_MESSAGE, TABLE_TOPIC

LARGE = 4096
"""Bytes from which on a message is coded before it is submitted. Coding 4 kB takes some .1 ms, 5 MB a fourth of a
second, in which nothing else could leave."""


def _changed(message: Message) -> tuple[Fate, str]:
    """What becomes of a message that waits while its topic becomes video, or is that no longer."""
    if message.started:
        return Fate.ABANDONED, f"{message.remaining} bytes were left when the topic's options changed"
    return Fate.SUPERSEDED, "the topic's options changed before it could start"


class Owner(Protocol):
    """What an outbox tells its endpoint."""

    def submitted(self, topic_id: int, now: float) -> None:
        """A message of a topic has come."""

    def behind(self, now: float) -> bool:
        """Whether messages that wait do so because the computer is too slow for what comes."""

    @property
    def slow(self) -> bool:
        """Whether the computer was too slow lately, whatever waits now."""

    def topics_changed(self) -> None:
        """The table of topics has changed."""


class Outbox:
    """The messages of one sender.

    :param topics: topics that it may send; the announced table is made from them
    :param owner: is told what comes and changes
    :param peers: those that say what they have, so that it is known when a message is over
    :param boot: boot number of this start, for keys
    :param room: bytes of the longest body
    :param instances: tells the instances of a topic
    :ivar topics: what it sends
    :ivar ledger: what becomes of its messages
    :ivar sent: the same, with what waits
    :ivar asks: how often others have asked for what is kept of a topic, or for a key frame
    :ivar kept: what it keeps for robots that join late
    :ivar packing: what goes into the next packet
    """

    def __init__(
        self,
        topics: Registry | None,
        settings: Settings,
        owner: Owner,
        peers: Peers,
        *,
        boot: int,
        room: int,
        codec: MessageCodec | None,
        observer: MessageObserver | None,
        instances: InstancesOf = no_instances,
    ) -> None:
        self.topics = topics
        self.stats = SenderStats()
        self._settings = settings
        self._owner, self._peers = owner, peers
        self._room = room
        self._codec = codec
        self.ledger = SenderLedger(self.stats, observer)
        self.asks: Counter[int] = Counter()
        self._kept_frames: dict[tuple[int, int], tuple[int, bytes]] = {}
        """Serial and bytes of the newest frame of each chain of a latched topic, which may be sent again."""
        self.sent = SentTopics(codec, settings.commands, instances)
        self.kept = KeptMessages(self.sent, room, settings, self.stats, self._admit)
        self.packing = Packing(
            self.sent,
            self.stats,
            self._left,
            boot=boot,
            room=room,
            tuning=settings.tuning,
            shares=settings.shares,
            slow=lambda: settings.slower > 1,
        )
        self.packing.turns.join(TABLE_TOPIC)
        if settings.relay:
            self.sent.relay()
            for topic_id in self.sent:
                self.packing.turns.join(topic_id)
        if topics:
            self.sent.add(topics)
            self._tabulate()

    def add(self, topics: Sequence[NewTopic]) -> Registry:
        """Offer further topics. The robots that hear this one are told."""
        together = (Registry.empty() if self.topics is None else self.topics).extended(topics)
        added = together[-len(topics) :] if topics else ()
        if self._codec is not None:
            for topic in added:
                self._codec.add(topic)
        self.topics = together
        self.sent.add(added)
        self._tabulate()
        self._owner.topics_changed()
        return together

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """Take definitions of a type, by which its messages are coded. The robots that hear this one are told."""
        self.sent.learn(type_name, definitions)
        if self._codec is None:
            return
        self._codec.learn(type_name, definitions)
        self.tabulate()

    def offer(self, topic_id: int, *, offered: bool) -> None:
        self.sent[topic_id].hidden = not offered
        self.tabulate()

    def follow(self, topic_id: int, publishers: PublisherQos) -> bool:
        before = self.queue(topic_id)
        self.sent[topic_id].follow(publishers)
        self.sent.find_deadlines()
        self.tabulate()
        return self.queue(topic_id) != before

    def change(self, topic_id: int, options: SendOptions) -> tuple[Registry, Topic]:
        before = self.sent[topic_id]
        name, type_name = before.topic.name, before.topic.type_name
        check_live_options(name, before.topic.options, options)
        other_cloud = before.topic.options.cloud != options.cloud
        meant = replace(before.topic, options=options)
        known = [one for one in self.sent.named() if one.topic.stream == meant.stream]
        after = known[0] if known else self.sent[self.add([(name, type_name, options)])[-1].topic_id]
        if before.topic.as_frames != meant.as_frames:
            self.drop([Dropped(message, *_changed(message)) for message in before.queue])
            before.queue.clear()
        after.publishers = before.publishers
        after.change(options)
        if other_cloud and self._codec is not None:
            self._codec.add(after.topic)
        self.sent.find_deadlines()
        if self._tabulate() or after is not before:
            self._owner.topics_changed()
        assert self.topics is not None
        return self.topics, after.topic

    def prepare(self, topic_id: int, payload: bytes) -> CodedMessage | None:
        return None if self._codec is None or len(payload) < LARGE else self._coded(self._codec, topic_id, payload)

    def _coded(self, codec: MessageCodec, topic_id: int, payload: bytes) -> CodedMessage:
        expected = codec.canonical(topic_id, payload) if self.ledger.observed else None
        return CodedMessage(topic_id, payload, codec.encode(topic_id, payload), expected)

    def submit(
        self,
        topic_id: int,
        payload: bytes,
        now: float,
        lifespan_s: float = inf,
        dst_id: int | Auto = AUTO,
        *,
        waited_s: float = 0.0,
        publisher: Hashable = None,
        prepared: CodedMessage | None = None,
    ) -> None:
        topic = self.sent.get(topic_id)
        if topic is None or topic_id == TABLE_TOPIC:
            raise ConfigError(f"topic id {topic_id} is not among the {len(self.topics or ())} topics that are sent")
        self._owner.submitted(topic_id, now)
        if not topic.queue:
            if topic.has_turns:
                self.packing.turns.join(topic_id)
        elif topic.is_stream and self._owner.behind(now):
            self.drop(list(topic.queue.shed(now)))
        if not (waited_s and topic.is_stream and self._owner.slow):
            waited_s = 0.0  # one delay of a computer that keeps up costs no message
        over = waited_s > OVERLOAD_S
        serial = self.ledger.new(topic_id)
        codec = None if over else self._codec
        plain, keys = topic.spoken_of(payload, serial if publisher is None else publisher)
        if codec is None:
            prepared = None
        elif prepared is None or prepared.topic_id != topic_id or prepared.payload is not plain:
            prepared = self._coded(codec, topic_id, plain)
        self.ledger.accept(serial, topic_id, plain, now, None if prepared is None else prepared.expected)
        if over:
            self.ledger.refuse(serial, topic_id, Fate.OVERLOAD, OVERLOADED)
            return
        payload = plain
        if codec is not None and prepared is not None:
            payload = prepared.coded
            if topic.kept and topic.kept_depth > 1:
                payload = codec.numbered(payload, serial)
        if len(payload) > MAX_MESSAGE:
            self.ledger.refuse(serial, topic_id, Fate.TOO_LARGE, f"{len(payload)} bytes; at most {MAX_MESSAGE}")
            return
        coded = codec is not None
        message = Message(serial, topic_id, payload, topic.qos, now - waited_s, topic.weight, lifespan_s, coded=coded)
        message.dst_id = topic.dst_id if dst_id == AUTO else dst_id
        message.keys, message.plain = keys, plain if keys else b""
        if topic.kept:
            self.kept.keep(topic, message)
        self._admit(topic, message)

    def forget_kept(self, topic_id: int) -> None:
        self.kept.forget(topic_id)

    def stop(self, topic_id: int) -> None:
        queue = self.sent[topic_id].queue
        waiting = [message for message in queue if not message.started]
        for message in waiting:
            queue.remove(message)
        why = "nobody wanted the topic any more before it could start"
        self.drop([Dropped(message, Fate.SUPERSEDED, why) for message in waiting])
        self.kept.forget(topic_id)

    def queue(self, topic_id: int) -> tuple[QueuePolicy, float]:
        queue = self.sent[topic_id].queue
        return queue.policy, queue.deadline_s

    def overtakes(self, topic_id: int) -> bool:
        topic = self.sent[topic_id]
        return not topic.in_order and topic.queue.policy != "latest"  # which ends repairs of earlier ones

    def depth(self, topic_id: int) -> int:
        depth = self.sent[topic_id].topic.options.queue_depth
        return self._settings.queue_depth if depth == AUTO else depth

    def has_space(self, topic_id: int) -> bool:
        return self.sent[topic_id].queue.has_space(self.depth(topic_id))

    def queued(self) -> dict[int, int]:
        return {topic.topic.topic_id: len(topic.queue) for topic in self.sent.named()}

    @property
    def idle(self) -> bool:
        """Whether nothing waits."""
        passed = set(RELAYED) | ({TABLE_TOPIC} if self.packing.fills else set())
        return not any(topic.queue for topic_id, topic in self.sent.items() if topic_id not in passed)

    def reconfigure(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self._settings = settings

    def expire(self, now: float, interval: float) -> None:
        """Drop messages that would arrive too late.

        :param interval: s from one packet to the next, 0 if unknown
        """
        for queue in self.sent.deadlines:
            if queue:
                self.drop(list(queue.expire(now, interval, LEAD_S, self._room - ENTRY)))

    def _tabulate(self) -> bool:
        """Make the table of topics; returns whether it has changed."""
        return self.kept.tabulate(self.sent.table())

    def tabulate(self) -> None:
        """Announce the topics anew, if they have changed."""
        if self._tabulate():
            self._owner.topics_changed()

    def becomes_coded(self, topic_id: int) -> None:
        """Announce that frames of a topic follow. Its first turn does not wait until one is coded."""
        self.packing.turns.join(topic_id)
        self.tabulate()

    def submit_frame(
        self, topic: SentTopic, frame: bytes, came: float, now: float, *, key: bool, chain: int
    ) -> Message | None:
        """Queue a frame of a coded topic; None where it is too large."""
        topic_id = topic.topic.topic_id
        self._owner.submitted(topic_id, now)
        serial, before = self._kept_frames.get((topic_id, chain), (-1, b""))
        again = topic.kept and frame == before
        if again:
            self.stats.repeats += 1
        else:
            serial = self.ledger.new(topic_id)
            self.ledger.accept(serial, topic_id, frame, came)
        payload = FRAME + frame
        if len(payload) > MAX_MESSAGE:
            self.ledger.refuse(serial, topic_id, Fate.TOO_LARGE, f"{len(payload)} bytes; at most {MAX_MESSAGE}")
            return None
        message = Message(serial, topic_id, payload, topic.qos, came, topic.weight, coded=True, key=key)
        message.dst_id, message.repeat, message.keys = topic.dst_id, again, frozenset([chain])
        if topic.kept:
            self.kept.keep(topic, message)
            self._kept_frames[topic_id, chain] = serial, frame
        topic.queue.append(message)
        return message

    def _admit(self, topic: SentTopic, message: Message) -> None:
        if dropped := topic.queue.admit(message, self.depth(message.topic_id)):
            self.drop(dropped)

    def _left(self, message: Message, now: float) -> None:
        """A message has left whole."""
        topic = self.sent[message.topic_id]
        reported = bool(self._peers.all) or self._peers.confirm(in_order=topic.in_order)
        if message.begins:
            topic.lifetimes.beside(message.lifetime)
            return
        topic.lifetimes.left(
            message.lifetime,
            policy=topic.queue.policy,
            depth=topic.publishers.depth,
            reported=reported,
            waited_for=inf if message.repeat else now + self._settings.tuning.repair_worth * self._settings.hold_s,
        )
        if message.key:
            topic.lifetimes.restart(message.keys)
        if topic.kept or message.topic_id == TABLE_TOPIC:
            self.kept.left(message, now, reported=reported)

    def found(self, robot: int, now: float) -> None:
        """A robot is reached over others for the first time: what is kept for it is sent. It cannot ask."""
        for topic in self.sent.named():
            if topic.dst_id == robot and topic.kept:
                self.kept.ask(topic.topic.topic_id, now)

    def drop(self, dropped: list[Dropped[Message]]) -> None:
        """These messages are not sent, or not again."""
        for item in dropped:
            item.message.index = max(item.message.index, 1)
            item.message.lifetime.end()
            if not item.message.repeat:
                self.ledger.refuse(item.message.serial, item.message.topic_id, item.fate, item.detail)
