"""One robot's end of a link: messages and packets in, packets and events out.

It has two sides. The *message side* (``messages``) is what a robot's ROS graph works with: it takes messages, keeps
their queues, and announces their topics. The *packet side* is what a PHY works with: it gives and takes packets. An end
sends and receives, so that received packets can change what it sends.

Invariants: as everywhere in ``link``, time is an argument and never goes back; nothing happens outside a call; the
sending half reports to its observer immediately; the receiving half returns its events, so that the caller can act on
them before any observer.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.events import AirPacket, Delivered, Lost, ReceiverEvent, SentPacket
from gr_ros2.link.frames import FrameSide
from gr_ros2.link.ledger import SenderLedger
from gr_ros2.link.pace import Pace
from gr_ros2.link.queues import PublisherQos
from gr_ros2.link.rate import Mcs
from gr_ros2.link.stats import ReceiverStats, SenderStats
from gr_ros2.settings.config import QueuePolicy, SendOptions
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import NewTopic, Registry, Topic
from gr_ros2.wire import AnnouncedTopic

if TYPE_CHECKING:
    from gr_ros2.link.v1.pings import Pings
    from gr_ros2.link.v1.receipts import Receipts
    from gr_ros2.link.v1.used_air import UsedAir


def check_live(changes: Mapping[str, Any], live: Sequence[str]) -> None:
    """Refuse to change other settings than those that may change at run time.

    :raises ConfigError: naming the setting and those that can change
    """
    for name in changes:
        if name not in live:
            raise ConfigError(f"{name} cannot change while running; these can: {', '.join(live)}")


LIVE_OPTIONS = (
    *("to", "qos", "queue", "queue_depth", "deadline_s", "weight", "max_rate", "keep_s"),
    *("camera", "depth_image", "cloud"),
)
"""Options of a topic that may change at run time in a version that allows it. The others are those of its subscription
and of its codec, or of a sink."""


def check_live_options(topic: str, before: SendOptions, after: SendOptions) -> None:
    """Refuse to change other options of a topic than ``LIVE_OPTIONS``.

    :raises ConfigError: naming topic and option, and those that can change
    """
    for option in fields(SendOptions):
        if option.name not in LIVE_OPTIONS and getattr(before, option.name) != getattr(after, option.name):
            raise ConfigError(
                f"topic {topic}: {option.name} cannot change while running; these can: {', '.join(LIVE_OPTIONS)}"
            )


class CodedMessage(NamedTuple):
    """A message that was coded before it is submitted.

    :param coded: what leaves
    :param expected: what comes out at the other end; None where nobody asks
    """

    topic_id: int
    payload: bytes
    coded: bytes
    expected: bytes | None


class MessageSide(Protocol):
    """The messages that an end sends.

    :ivar ledger: what becomes of them
    """

    ledger: SenderLedger

    def prepare(self, topic_id: int, payload: bytes) -> CodedMessage | None:
        """Code a message for ``submit`` if that takes long; otherwise None. The only method that needs no lock."""

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
        """Take a serialized message.

        It may be refused, and it may cause waiting messages of its topic to be dropped; all are counted and observed.

        :param lifespan_s: s after which this message is useless, on a topic whose queue has a deadline (version 1)
        :param dst_id: the robot for which it is, auto as its topic says: others carry it there (version 1)
        :param waited_s: s for which it has waited on this computer, and newer ones of its topic have come (version 1)
        :param publisher: whose message it is: of a latched topic, the newest of each is kept (version 1); None = not
            known
        :param prepared: what ``prepare`` made of the same bytes
        :raises ConfigError: for a topic that is not sent
        """

    def follow(self, topic_id: int, publishers: PublisherQos) -> bool:
        """Adapt a topic to the QoS of its publishers, where the configuration leaves it open.

        :return: whether that changed its queue; ``queue`` returns the new values
        """

    def queue(self, topic_id: int) -> tuple[QueuePolicy, float]:
        """Policy and deadline (s, 0 for none) of a topic's queue."""

    def depth(self, topic_id: int) -> int:
        """Number of messages of a topic that may wait, 0 for unbounded."""

    def has_space(self, topic_id: int) -> bool:
        """Whether a message of that topic could be submitted without dropping another one."""

    def queued(self) -> dict[int, int]:
        """Messages that wait or are partly sent, per topic id."""


class OpenMessages(MessageSide, Protocol):
    """The messages of an end that announces its topics, so that these may change while it runs."""

    def overtakes(self, topic_id: int) -> bool:
        """Whether messages of a topic overtake earlier ones, which may be repaired then and do not come out."""

    def add(self, topics: Sequence[NewTopic]) -> Registry:
        """Send further topics from now on, all or none. Services among them are announced when they are offered.

        A name may come again with another type: both stay, and the messages of each keep their type.

        :return: everything that is sent; the new topics are the last ones
        :raises ConfigError: too many topics, or a wrong option
        """

    def change(self, topic_id: int, options: SendOptions) -> tuple[Registry, Topic]:
        """Give a topic other options from now on, in ``LIVE_OPTIONS``.

        With another robot in ``to``, its messages leave under another topic id, which is the same again for the same
        robot. What was submitted before stays with the robot for which it was, and is sent on and repaired. Pictures
        leave under another topic id, too, where they are not video any more, or are from now on; then what waits or is
        partly sent is not sent on.

        :return: everything that is sent, and the topic as which its messages are to be submitted from now on
        :raises ConfigError: too many topics, or another option
        """

    def offer(self, topic_id: int, *, offered: bool) -> None:
        """Start or stop announcing a service to the other robots. At the start, services are not announced."""

    def forget_kept(self, topic_id: int) -> None:
        """Send no message of a topic so far to robots that join late, because its publisher has changed its type."""

    def stop(self, topic_id: int) -> None:
        """Send nothing of a topic that waits, as nobody wants it any more. A message that has left in part leaves
        whole."""

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """Code messages of a type by its definition, which was not known before, or another one.

        :param definitions: of the type and of those that it is made of, as the codec takes them
        """


class PacketSide(Protocol):
    """The packets that an end sends and receives."""

    @property
    def answers(self) -> bool:
        """Whether received packets can change what this end sends."""

    @property
    def pace(self) -> Pace:
        """When packets may leave: the credits of the PHY, and the configured rate."""

    @property
    def mcs_table(self) -> Sequence[Mcs]:
        """The rates of an adaptive rate, the most robust one first; () for a fixed rate."""

    @property
    def urgent(self) -> bool:
        """Whether a received packet may let one leave at once, before ``next_departure``."""

    def next_packet(self, now: float) -> SentPacket | None:
        """The next packet that may go at ``now``, or None."""

    def next_departure(self, *, credited: bool = False) -> float | None:
        """Earliest time at which ``next_packet`` may have something without a further call; None if only a call can
        change that.

        :param credited: if there were a credit
        """

    def receive(self, arrival: AirPacket, now: float) -> list[ReceiverEvent]:
        """Take one packet; the events it causes, in order."""

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """Do what is due by ``now``; return the events it causes, in order. It does not include ``next_packet``."""

    def next_timeout(self) -> float | None:
        """The same as ``next_departure`` for ``handle_timeout``."""


@dataclass(frozen=True)
class HeardRobot:
    """A robot that was heard.

    :param heard_s: s since the newest packet
    :param silent: it has been silent for long
    :param start: its boot number
    :param sealed: its packets are sealed
    :param snr_db: SNR of its newest packets, dB; None if it is not measured packet by packet
    :param loss: share of its packets that were lost lately, 0..1
    :param lost: packets of it that were lost since it was first heard, repaired or not
    :param topics: number of topics that it has announced, without its services
    :param hops: robots that have sent its newest message on; 0 where it is heard itself
    :param over: where it is not heard: the neighbour over which it is reached, None if no way is known
    :param doubled: two robots send under its number, or a recording of an earlier start is on the air
    :param no_table: it has topics, and it is not known which: nothing of its table has come for long
    """

    robot: int
    heard_s: float
    silent: bool
    start: int
    sealed: bool
    snr_db: float | None
    loss: float
    lost: int
    topics: int
    hops: int = 0
    over: int | None = None
    doubled: bool = False
    no_table: bool = False


def without_table(robots: Iterable[int]) -> list[str]:
    """One line for each robot of which no table of topics came, and what to do."""
    return [
        f"no table of topics of robot {robot} arrived, so nothing of it comes out: too many packets are lost, or the "
        "channel has no room for it; send less (max_rate, topics), set repair: auto, or let a receiver report"
        for robot in robots
    ]


class Endpoint(PacketSide, Protocol):
    """An end, the same for every version of the wire format."""

    @property
    def live_settings(self) -> Sequence[str]:
        """Settings of its sending half that may change at run time."""

    @property
    def messages(self) -> MessageSide:
        """Its message side."""

    @property
    def frames(self) -> FrameSide | None:
        """Its coded topics; None in a version without them."""

    @property
    def sent(self) -> SenderStats:
        """Counters of the sending half."""

    @property
    def received(self) -> ReceiverStats:
        """Counters of the receiving half."""

    @property
    def idle(self) -> bool:
        """Whether no message waits, and no packet that has left is worth repairing."""

    @property
    def held_bytes(self) -> int:
        """Memory in use for incomplete messages."""

    def reconfigure(self, **changes: Any) -> None:
        """Change settings of the sending half at run time, some of ``live_settings``.

        :raises ConfigError: for a value out of range or a setting that cannot change
        """

    def unpublished(self, event: Delivered) -> Lost:
        """Count a message that was delivered but not published on the ROS graph. A repeat of it is delivered again."""

    def knows(self, src_id: int) -> bool:
        """Whether the state of a sender is held at present."""

    def clock_of(self, src_id: int, now: float) -> ClockOffset | None:
        """What is known of another robot's clock, if the version asks for it."""

    def peers(self, now: float) -> list[HeardRobot]:
        """The robots that are known, if the version tells."""


class OpenEndpoint(Endpoint, Protocol):
    """An end that announces its topics, asks other robots and may carry services."""

    @property
    def live_options(self) -> Sequence[str]:
        """Options of a topic that may change at run time."""

    @property
    def messages(self) -> OpenMessages:
        """Its message side."""

    @property
    def boot(self) -> int:
        """Number of this start of the robot."""

    def topics_of(self, src_id: int) -> Mapping[int, AnnouncedTopic]:
        """The topics of a robot by topic id, as far as it has announced them."""

    @property
    def used_air(self) -> UsedAir:
        """How much of the air it uses."""

    def receipts_of(self, robots: Collection[int]) -> Receipts:
        """Which of its packets one of some robots has, or any robot where none is named, as they report from now on."""

    @property
    def pings(self) -> Pings:
        """Its questions to other robots, and its answers."""
