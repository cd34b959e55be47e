"""The topics that a robot sends, and the table in which it announces them."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

from gr_ros2.core.errors import CodecError, ConfigError
from gr_ros2.link.frames import MARK
from gr_ros2.link.instances import ALL, InstanceKeys, InstancesOf, Keys, no_instances
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.queues import UNKNOWN_QOS, PublisherQos, TopicQueue, qos_class, queue_for
from gr_ros2.link.v1.delivery import MAX_AGE_S
from gr_ros2.link.v1.lifetime import Lifetime, Lifetimes
from gr_ros2.link.v1.message import Message
from gr_ros2.settings.commands import is_command
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import BACKFILL_TYPE, CALLS_TYPE, Topic
from gr_ros2.wire import QOS_BULK
from gr_ros2.wire.ages import NO_AGE, age_code
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import BROADCAST, CARRIED_TOPIC, RELAYED_TOPIC, TABLE_TOPIC

LONG_CARRIED = CARRIED_TOPIC + 1
"""The queue of carried messages that take several packets: short ones do not wait for them."""
RELAYED_IN_ORDER, RELAYED_TABLES = LONG_CARRIED + 1, LONG_CARRIED + 2
"""The queues of messages of reliable topics of other robots, and of their tables; on the air they are of topic 241."""
RELAYED = (RELAYED_TOPIC, RELAYED_IN_ORDER, RELAYED_TABLES)
"""The queues of what is sent on of other robots; each has one message at most."""
ON_AIR = {LONG_CARRIED: CARRIED_TOPIC, RELAYED_IN_ORDER: RELAYED_TOPIC, RELAYED_TABLES: RELAYED_TOPIC}
"""The topics of queues that have no topic id of their own."""

_STARTS = 2
"""Messages kept for each of several publishers: one that has started again counts as another, and does not displace a
third one's."""


@dataclass(frozen=True, slots=True, eq=False)
class Late:
    """A message that left too fast for some robots.

    :param submitted: when it was submitted, s
    :param numbers: its packets
    """

    submitted: float
    numbers: list[int]
    lifetime: Lifetime


@dataclass(slots=True, eq=False)
class SentTopic:
    """One topic, or the rows of the table of topics.

    :param qos: QoS class of its messages
    :param latched: whether its newest messages are kept for robots that join late, however old they are
    :param hidden: whether the table leaves it out: a service whose server is not there
    :param command: whether its messages are commands
    :param publishers: the QoS that its publishers offer
    :param newest: when the newest of its messages that have left was submitted, s
    :param lifetimes: its messages that have left
    :param coded: whether its messages are frames (:mod:`gr_ros2.link.frames`)
    :param output: of frames, the type that comes out, '' = the topic's
    :param instances: what its messages speak of; None = all of the same
    :ivar behind: the robots that did not get its newest message, as it was sent too fast for them, and when the newest
        one that they got was submitted, s
    :ivar late: the newest messages that some robots lack for that reason; an older one only while it is sent to them
    :ivar dst_id: the robot for which its messages are, 255 for all
    :ivar kept: whether its newest messages are kept for robots that lack them; commands never are
    :ivar in_order: whether its messages are delivered in order, each after all earlier ones
    :ivar fresh: whether its old messages are of no use
    :ivar is_stream: whether its messages are useless when newer ones have come, should the computer be too slow for
        all. Whoever sets ``queue`` to fifo wants every message
    :ivar limit_s: s after which its messages are of no use, as far as this is known here; infinite for never
    """

    topic: Topic
    queue: TopicQueue[Message]
    qos: int
    weight: float
    latched: bool
    hidden: bool = False
    command: bool = False
    publishers: PublisherQos = UNKNOWN_QOS
    newest: float = -inf
    lifetimes: Lifetimes = field(default_factory=Lifetimes)
    coded: bool = False
    output: str = ""
    instances: InstanceKeys | None = None
    behind: dict[int, float] = field(default_factory=dict)
    late: list[Late] = field(default_factory=list)
    dst_id: int = field(init=False)
    kept: bool = field(init=False)
    in_order: bool = field(init=False)
    fresh: bool = field(init=False)
    is_stream: bool = field(init=False)
    limit_s: float = field(init=False)

    def __post_init__(self) -> None:
        self._check(self.topic.options)
        to = self.topic.options.to
        self.dst_id = BROADCAST if to == AUTO else to
        self._derive()

    def _derive(self) -> None:
        """Find what is asked for every message, after any change of what it follows from."""
        options = self.topic.options
        self.kept = not self.command and (self.latched or options.keep_s > 0)
        reliable = self.publishers.reliable if options.reliability == AUTO else options.reliability == "reliable"
        self.in_order = self.coded or (reliable and (self.queue.policy != "latest" or self.shared))
        self.fresh = self.queue.deadline_s > 0 or self.topic.type_name == CALLS_TYPE
        self.is_stream = self.topic.is_topic and not (self.kept or options.max_rate or options.queue == "fifo")
        self.limit_s = min(self.queue.deadline_s or inf, MAX_AGE_S if self.fresh else inf)

    @property
    def has_turns(self) -> bool:
        """Whether a turn comes to it however much others have to send."""
        return self.topic.type_name != BACKFILL_TYPE

    @property
    def kept_depth(self) -> int:
        """How many messages late robots and late subscribers get at most.

        One, unless the topic's options say otherwise: where the graph does not tell the depth of a map's publisher, an
        earlier map would come out after the newest one. Of several publishers or instances, the newest of each.
        """
        depth, publishers = self.topic.options.depth, self.publishers
        if depth != AUTO:
            return depth
        if self.instances is not None:
            return publishers.keeps
        return min(_STARTS * publishers.count, 255) if publishers.count > 1 else 1

    @property
    def shared(self) -> bool:
        """Whether its newest message says nothing of what others have said before."""
        by_publisher = self.kept and self.publishers.count > 1
        return by_publisher if self.instances is None else by_publisher or self.instances.separate

    def spoken_of(self, payload: bytes, publisher: Hashable) -> tuple[bytes, Keys]:
        """A new message, merged with those that wait and say more, and the instances that it speaks of.

        :param publisher: whose message it is
        """
        if self.instances is None:
            return payload, frozenset([publisher]) if self.kept and self.publishers.count > 1 else ALL
        if self.queue.policy != "latest" and not self.kept:
            return payload, ALL
        try:
            keys = frozenset(self.instances.keys(payload))
            if self.queue.policy == "latest":
                waiting = [old.plain for old in self.queue if not (old.started or old.repeat or old.keys <= keys)]
                if waiting:
                    payload = self.instances.merged(waiting, payload)
                    keys = frozenset(self.instances.keys(payload))
        except CodecError:
            return payload, ALL
        return payload, keys

    def follow(self, publishers: PublisherQos) -> None:
        """Adapt to the QoS of its publishers, where the configuration leaves it open."""
        topic, self.publishers = self.topic, publishers
        self.latched = topic.latched or (publishers.latched and topic.options.durability == AUTO)
        if self.coded:
            self.become_frames(self.output)
        else:
            self.queue.change(*queue_for(topic.options, publishers, command=self.command))
            self._derive()

    def tell_apart(self, instances: InstanceKeys | None) -> None:
        """Tell its instances apart from now on."""
        self.instances = instances
        self._derive()

    def change(self, options: SendOptions) -> None:
        """Use other options from now on, for the same robot."""
        self._check(options)
        self.topic = replace(self.topic, options=options)
        self.qos, self.weight = qos_class(options, command=self.command), options.weight
        self.queue.limit(options.max_rate)
        self.follow(self.publishers)

    def become_frames(self, output: str) -> None:
        """Its messages are frames from now on: all leave, in the lowest class unless it is configured, and the coder
        heeds ``max_rate``."""
        self.coded, self.output = True, output
        self.queue.change("fifo", 0.0)
        self.queue.limit(0.0)
        if self.topic.options.qos == AUTO:
            self.qos = QOS_BULK
        self._derive()

    def _check(self, options: SendOptions) -> None:
        if self.command and options.keep_s:
            raise ConfigError(
                f"topic {self.topic.name}: keep_s = {options.keep_s:g}, but commands come in time or not at all, and "
                "none is kept for robots that come later: leave keep_s out, or take the topic out of commands"
            )

    def announced(self, codec: str) -> AnnouncedTopic:
        """Its row in the table.

        :param codec: what the codec says of it
        """
        topic, options = self.topic, self.topic.options
        depth = self.publishers.depth if options.depth == AUTO else options.depth
        if self.coded:
            codec = f"{MARK} {self.output}".rstrip()
        return AnnouncedTopic(
            topic.topic_id,
            topic.name,
            topic.type_name,
            self.qos,
            self.in_order,
            self.kept,
            min(self.kept_depth if self.kept else depth, 255),
            codec,
            self.fresh,
            self.dst_id,
            age_code(self.queue.deadline_s) % NO_AGE,
        )


class SentTopics(dict[int, SentTopic]):
    """The topics of one robot by id, with the table of topics if there are any.

    :param codec: codes their messages
    :param commands: types and names of topics whose messages are commands
    :param instances: tells the instances of a topic
    :ivar deadlines: the queues whose messages may be too late
    """

    def __init__(
        self,
        codec: MessageCodec | None,
        commands: Sequence[str],
        instances: InstancesOf = no_instances,
    ) -> None:
        super().__init__()
        self._codec, self._commands, self._instances = codec, commands, instances
        self.deadlines: list[TopicQueue[Message]] = []

    def add(self, topics: Sequence[Topic]) -> None:
        """Send these topics too."""
        for topic in topics:
            options = topic.options
            command = is_command(topic.name, topic.type_name, self._commands)
            queue: TopicQueue[Message] = TopicQueue(*queue_for(options, command=command), options.max_rate)
            qos, hidden = qos_class(options, command=command), not topic.is_topic
            self[topic.topic_id] = made = SentTopic(
                topic, queue, qos, options.weight, topic.latched, hidden=hidden, command=command
            )
            made.tell_apart(self._instances(topic, None))
        if TABLE_TOPIC not in self:
            table = Topic(TABLE_TOPIC, "", "")
            queue, qos = TopicQueue[Message]("fifo"), qos_class(table.options)
            rows = PublisherQos(reliable=False)  # each is of use by itself
            self[TABLE_TOPIC] = SentTopic(table, queue, qos, 1.0, latched=False, publishers=rows)
        self.find_deadlines()

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """Tell apart the instances of topics whose type was not known before."""
        for topic in self.named():
            if topic.topic.type_name == type_name and topic.instances is None:
                topic.tell_apart(self._instances(topic.topic, definitions))

    def relay(self) -> None:
        """Send messages of other robots too, and carry some."""
        for topic_id in (*RELAYED, CARRIED_TOPIC, LONG_CARRIED):
            topic = Topic(topic_id, "", "")
            queue = TopicQueue[Message]("latest" if topic_id == RELAYED_TOPIC else "fifo")
            self[topic_id] = SentTopic(topic, queue, qos_class(topic.options), 1.0, latched=False)

    def find_deadlines(self) -> None:
        """Note which queues have a deadline."""
        self.deadlines = [topic.queue for topic in self.values() if topic.queue.deadline_s]

    def named(self) -> Iterator[SentTopic]:
        """All topics, without the table of topics and what is sent over others."""
        return (topic for topic_id, topic in self.items() if topic_id < TABLE_TOPIC)

    def table(self) -> list[AnnouncedTopic]:
        """The rows of the table of topics."""
        codec = self._codec
        return [
            topic.announced("" if codec is None else codec.announcement(topic.topic.topic_id))
            for topic in self.named()
            if not topic.hidden
        ]
