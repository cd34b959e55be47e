"""One robot's end of a link: messages and packets in, packets and events out.

An end sends and receives, so that received packets can change what it sends. Invariants: as everywhere in ``link``,
time is an argument and never goes back; nothing happens outside a call; the sending half reports to its observer
immediately; the receiving half returns its events, so that the caller can act on them before any observer.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import Delivered, Lost, ReceiverEvent, SenderEvent
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.rate import Rung
from gr_ros2.link.receiver import Receiver
from gr_ros2.link.sender import Sender
from gr_ros2.link.stats import ReceiverStats, SenderStats
from gr_ros2.settings.config import QueuePolicy, SinkConfig, SourceConfig
from gr_ros2.settings.registry import NewRow, Registry

LIVE_SETTINGS = ("packet_rate", "dst_id", "repeat_s", "queue_depth")
"""Settings of a sending half that may change at run time, the same in every version."""


def check_live(changes: Mapping[str, Any]) -> None:
    """Refuse to change other settings than ``LIVE_SETTINGS``.

    :raises ConfigError: naming the setting and those that can change
    """
    for name in changes:
        if name not in LIVE_SETTINGS:
            raise ConfigError(f"{name} cannot change while running; these can: {', '.join(LIVE_SETTINGS)}")


class Endpoint(Protocol):
    """The interface of an end, the same for every version of the wire format."""

    @property
    def answers(self) -> bool:
        """Whether received packets can change what this end sends."""

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
    def interval(self) -> float:
        """s from one packet to the next while busy: as configured, or as measured from the credits; 0 if unknown."""

    @property
    def out_of_credit(self) -> bool:
        """Whether nothing leaves before the next credit, whatever is submitted."""

    @property
    def held_bytes(self) -> int:
        """Memory in use for incomplete messages."""

    def submit(self, topic_id: int, payload: bytes, now: float) -> None:
        """Take a serialized message.

        It may be refused, and it may cause waiting messages of its topic to be dropped; all are counted and observed.

        :raises ConfigError: for a topic that is not in the registry, or at an end that sends nothing
        """

    def missed(self, topic_id: int, total: int) -> None:
        """Record how many messages of a topic the ROS graph has lost so far, before they could be submitted.

        :param total: since the start; the increase is reported to the observer
        """

    def add(self, rows: Sequence[NewRow]) -> Registry:
        """Send further topics from now on, all or none. Services among them are announced when they are offered.

        A name may come again with another type: both rows stay, and the messages of each keep their type.

        :return: everything that is sent; the new topics are the last ones
        :raises ConfigError: too many topics, a wrong option, or a version in which both ends need the same registry
        """

    def forget_kept(self, topic_id: int) -> None:
        """Send no message of a topic so far to robots that join late, because its publisher has changed its type."""

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """Code messages of a type by its definition, which was not known before, or another one.

        :param definitions: of the type and of those that it is made of, as the codec takes them
        """

    def follow(
        self,
        topic_id: int,
        *,
        reliable: bool = True,
        latched: bool = False,
        depth: int = 0,
        lifespan_s: float = 0.0,
        period_s: float = 0.0,
    ) -> bool:
        """Adapt a topic to the QoS of its publishers, where the configuration leaves it open.

        :param reliable: whether all publishers are reliable
        :param latched: whether all publishers keep messages for late joiners (transient-local)
        :param depth: depth of their history, 0 for unbounded or unknown
        :param lifespan_s: s after which a message is useless, 0 without limit
        :param period_s: s within which they promise a message, 0 for no promise
        :return: whether that changed its queue; ``queue`` returns the new values
        """

    def queue(self, topic_id: int) -> tuple[QueuePolicy, float]:
        """Policy and deadline (s, 0 for none) of a topic's queue."""

    def depth(self, topic_id: int) -> int:
        """Number of messages of a topic that may wait, 0 for unbounded."""

    def room(self, topic_id: int) -> bool:
        """Whether a message of that topic could be submitted without dropping another one."""

    def queued(self) -> dict[int, int]:
        """Messages that wait or are partly sent, per topic id."""

    def reconfigure(self, **changes: Any) -> None:
        """Change settings of the sending half at run time, some of ``LIVE_SETTINGS``.

        :raises ConfigError: for a value out of range or a setting that cannot change
        """

    def unpublished(self, event: Delivered) -> Lost:
        """Count a message that was delivered but not published on the ROS graph. A repeat of it is delivered again."""

    def knows(self, src_id: int) -> bool:
        """Whether the state of a sender is held at present."""

    def use_credit(self) -> None:
        """From now on, a packet leaves only when there is a credit."""

    def credit(self, packets: int = 1) -> None:
        """The PHY can take this many further packets."""

    def next_packet(self, now: float) -> bytes | None:
        """The next packet that may go at ``now``, or None."""

    @property
    def ladder(self) -> Sequence[Rung]:
        """The rungs of an adaptive rate, the most robust one first; () for a fixed rate."""

    @property
    def rung(self) -> int:
        """With an adaptive rate, the rung of the last packet from ``next_packet`` (:mod:`gr_ros2.link.rate`);
        otherwise 0."""

    def receive(self, data: bytes, now: float, snr_db: float | None = None) -> list[ReceiverEvent]:
        """Take the bytes of one packet; the events it causes, in order.

        :param snr_db: SNR of this packet, dB; None where it is not measured
        """

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """Do what is due by ``now``; return the events it causes, in order. It does not include ``next_packet``."""

    @property
    def urged(self) -> bool:
        """Whether a received packet may let one leave at once, before ``next_departure``."""

    def next_departure(self, *, credited: bool = False) -> float | None:
        """Earliest time at which ``next_packet`` may have something without a further call; None if only a call can
        change that.

        :param credited: if there were a credit
        """

    def next_timeout(self) -> float | None:
        """The same for ``handle_timeout``."""


class EndpointV0:
    """An end of version 0. Its receiving half passes nothing on to its sending half.

    :param source: settings of its sending half; None if it sends nothing
    :param sink: settings of its receiving half; None if it receives nothing
    :param codecs: codecs of messages sent and received, if the link compresses
    :param rng: see :class:`Sender`
    :param observer: called with every SenderEvent, in order
    """

    answers = urged = False
    ladder: Sequence[Rung] = ()

    def __init__(
        self,
        registry: Registry,
        source: SourceConfig | None,
        sink: SinkConfig | None,
        *,
        codecs: tuple[MessageCodec | None, MessageCodec | None] = (None, None),
        rng: random.Random | None = None,
        observer: Callable[[SenderEvent], None] | None = None,
    ) -> None:
        to_air, from_air = codecs
        self._sender = None if source is None else Sender(registry, source, codec=to_air, rng=rng, observer=observer)
        self._receiver = None if sink is None else Receiver(registry, sink, codec=from_air)
        self.sent = SenderStats() if self._sender is None else self._sender.stats
        self.received = ReceiverStats() if self._receiver is None else self._receiver.stats

    @property
    def idle(self) -> bool:
        """Whether nothing waits to be sent."""
        return self._sender is None or self._sender.idle

    def submit(self, topic_id: int, payload: bytes, now: float) -> None:
        """See :class:`Endpoint`."""
        self._half().submit(topic_id, payload, now)

    @property
    def interval(self) -> float:
        """See :class:`Endpoint`."""
        return 0.0 if self._sender is None else self._sender.interval

    @property
    def out_of_credit(self) -> bool:
        """See :class:`Endpoint`."""
        return self._sender is not None and self._sender.out_of_credit

    @property
    def held_bytes(self) -> int:
        """See :class:`Endpoint`."""
        return 0 if self._receiver is None else self._receiver.held_bytes

    def missed(self, topic_id: int, total: int) -> None:
        """See :class:`Endpoint`."""
        self._half().missed(topic_id, total)

    def add(self, rows: Sequence[NewRow]) -> Registry:
        """See :class:`Endpoint`."""
        raise ConfigError(f"version 0 cannot announce {rows[0][0]!r}: give both ends the same registry")

    def forget_kept(self, topic_id: int) -> None:
        """Do nothing: the types of version 0 never change."""

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """Do nothing: both ends of version 0 code by the same dictionaries."""

    def follow(self, topic_id: int, **qos: Any) -> bool:  # noqa: ARG002
        """Do nothing: version 0 delivers as it comes, and the registry says the rest at both ends."""
        return False

    def queue(self, topic_id: int) -> tuple[QueuePolicy, float]:  # noqa: ARG002 - all topics have the same
        """See :class:`Endpoint`."""
        return "fifo", 0.0

    def depth(self, topic_id: int) -> int:
        """See :class:`Endpoint`."""
        return self._half().depth(topic_id)

    def room(self, topic_id: int) -> bool:
        """See :class:`Endpoint`."""
        return self._half().room(topic_id)

    def queued(self) -> dict[int, int]:
        """See :class:`Endpoint`."""
        return {} if self._sender is None else self._sender.queued()

    def reconfigure(self, **changes: Any) -> None:
        """See :class:`Endpoint`."""
        check_live(changes)
        self._half().reconfigure(**changes)

    def unpublished(self, event: Delivered) -> Lost:
        """See :class:`Endpoint`."""
        assert self._receiver is not None
        return self._receiver.unpublished(event)

    def knows(self, src_id: int) -> bool:
        """See :class:`Endpoint`."""
        return self._receiver is not None and self._receiver.knows(src_id)

    def _half(self) -> Sender:
        """The half that sends.

        :raises ConfigError: there is no such half
        """
        if self._sender is None:
            raise ConfigError("an end that sends nothing was asked to; give it a source")
        return self._sender

    def use_credit(self) -> None:
        """See :class:`Endpoint`."""
        if self._sender is not None:
            self._sender.use_credit()

    def credit(self, packets: int = 1) -> None:
        """See :class:`Endpoint`."""
        if self._sender is not None:
            self._sender.credit(packets)

    def next_packet(self, now: float) -> bytes | None:
        """See :class:`Endpoint`."""
        return None if self._sender is None else self._sender.next_packet(now)

    @property
    def rung(self) -> int:
        """See :class:`Endpoint`."""
        return 0

    def receive(self, data: bytes, now: float, snr_db: float | None = None) -> list[ReceiverEvent]:  # noqa: ARG002
        """See :class:`Endpoint`."""
        return [] if self._receiver is None else self._receiver.receive(data, now)

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """See :class:`Endpoint`."""
        return [] if self._receiver is None else self._receiver.handle_timeout(now)

    def next_departure(self, *, credited: bool = False) -> float | None:  # noqa: ARG002 - nothing is due by itself
        """See :class:`Endpoint`."""
        return None if self._sender is None else self._sender.next_timeout()

    def next_timeout(self) -> float | None:
        """See :class:`Endpoint`."""
        return None if self._receiver is None else self._receiver.next_timeout()
