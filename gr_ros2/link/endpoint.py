"""One robot's end of a link: messages and packets in, packets and events out.

An end sends and receives, so that received packets can change what it sends. Invariants: as everywhere in ``link``,
time is an argument and never goes back; nothing happens outside a call; the sending half reports to its observer
immediately; the receiving half returns its events, so that the caller can act on them before any observer.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Protocol

from gr_ros2.config import SinkConfig, SourceConfig
from gr_ros2.errors import ConfigError
from gr_ros2.link.events import ReceiverEvent, SenderEvent
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.receiver import Receiver, ReceiverStats
from gr_ros2.link.sender import Sender, SenderStats
from gr_ros2.registry import Registry


class Endpoint(Protocol):
    """The interface of an end, the same for every version of the wire format."""

    @property
    def answers(self) -> bool:
        """Whether received packets can change what this end sends."""

    @property
    def sent(self) -> SenderStats:
        """What left and what did not."""

    @property
    def received(self) -> ReceiverStats:
        """What arrived and what did not."""

    @property
    def idle(self) -> bool:
        """Whether nothing waits to be sent."""

    def submit(self, topic_id: int, payload: bytes, now: float) -> None:
        """Take a serialized message.

        :raises ConfigError: for a topic that is not in the registry, or at an end that sends nothing
        """

    def use_credit(self) -> None:
        """From now on a packet leaves only for a credit."""

    def credit(self, packets: int = 1) -> None:
        """The PHY can take this many further packets."""

    def next_packet(self, now: float) -> bytes | None:
        """The next packet that may go at ``now``, or None."""

    def receive(self, data: bytes, now: float) -> list[ReceiverEvent]:
        """Take the bytes of one packet; the events it causes, in order."""

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """Do what is due by ``now``; the events it causes, in order. ``next_packet`` is a separate question."""

    def next_timeout(self) -> float | None:
        """Earliest time at which ``next_packet`` or ``handle_timeout`` may have something without a further call; None
        where only a call can change that."""


class EndpointV0:
    """An end of version 0. Its receiving half passes nothing on to its sending half.

    :param source: settings of its sending half; None: it sends nothing
    :param sink: settings of its receiving half; None: it receives nothing
    :param codecs: of messages sent and received, where the link compresses
    :param rng: see :class:`Sender`
    :param observer: called with every SenderEvent, in order
    """

    answers = False

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
        if self._sender is None:
            raise ConfigError("a message was submitted to an end that sends nothing; give it a source")
        self._sender.submit(topic_id, payload, now)

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

    def receive(self, data: bytes, now: float) -> list[ReceiverEvent]:
        """See :class:`Endpoint`."""
        return [] if self._receiver is None else self._receiver.receive(data, now)

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """See :class:`Endpoint`."""
        return [] if self._receiver is None else self._receiver.handle_timeout(now)

    def next_timeout(self) -> float | None:
        """See :class:`Endpoint`."""
        halves = (self._sender, self._receiver)
        times = [at for half in halves if half is not None and (at := half.next_timeout()) is not None]
        return min(times, default=None)
