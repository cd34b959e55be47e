"""One robot's end of a link that speaks version 0."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.endpoint import HeardRobot, Questions, check_live
from gr_ros2.link.events import AirPacket, Delivered, Lost, ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.pace import Pace
from gr_ros2.link.rate import Mcs
from gr_ros2.link.stats import ReceiverStats, SenderStats
from gr_ros2.link.v0.receiver import Receiver
from gr_ros2.link.v0.sender import Sender
from gr_ros2.settings.config import SinkConfig, SourceConfig
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry
from gr_ros2.wire import AnnouncedTopic


class EndpointV0:
    """An end of version 0. Its receiving half passes nothing on to its sending half.

    :param source: settings of its sending half; None if it sends nothing
    :param sink: settings of its receiving half; None if it receives nothing
    :param codecs: codecs of messages sent and received, if the link compresses
    :param rng: see :class:`Sender`
    :param observer: called with every SenderEvent, in order
    """

    answers = urged = False
    boot = 0
    frames = None
    mcs_table: Sequence[Mcs] = ()
    live_settings = ("packet_rate", "dst_id", "repeat_s", "queue_depth")
    live_options = ()

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
        self.pace = Pace(AUTO) if self._sender is None else self._sender.pace

    @property
    def messages(self) -> Sender:
        """Its sending half.

        :raises ConfigError: there is no such half
        """
        if self._sender is None:
            raise ConfigError("an end that sends nothing was asked to; give it a source")
        return self._sender

    @property
    def idle(self) -> bool:
        """Whether nothing waits to be sent."""
        return self._sender is None or self._sender.idle

    @property
    def held_bytes(self) -> int:
        return 0 if self._receiver is None else self._receiver.held_bytes

    def reconfigure(self, **changes: float) -> None:
        check_live(changes, self.live_settings)
        self.messages.reconfigure(**changes)

    def next_packet(self, now: float) -> SentPacket | None:
        return None if self._sender is None else self._sender.next_packet(now)

    def next_departure(self, *, credited: bool = False) -> float | None:  # noqa: ARG002 - nothing is due by itself
        return None if self._sender is None else self._sender.next_timeout()

    def receive(self, arrival: AirPacket, now: float) -> list[ReceiverEvent]:
        return [] if self._receiver is None else self._receiver.receive(arrival, now)

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        return [] if self._receiver is None else self._receiver.handle_timeout(now)

    def next_timeout(self) -> float | None:
        return None if self._receiver is None else self._receiver.next_timeout()

    def unpublished(self, event: Delivered) -> Lost:
        assert self._receiver is not None
        return self._receiver.unpublished(event)

    @property
    def questions(self) -> Questions:
        raise ConfigError("version = 0: a robot can be asked with version 1 only; set version to 1 at every end")

    def peers(self, now: float) -> list[HeardRobot]:  # noqa: ARG002 - senders are not followed
        return []

    def knows(self, src_id: int) -> bool:
        return self._receiver is not None and self._receiver.knows(src_id)

    def topics_of(self, src_id: int) -> Mapping[int, AnnouncedTopic]:  # noqa: ARG002 - nobody announces any
        return {}
