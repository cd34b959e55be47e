"""One robot's end of a link that speaks version 0."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any

from gr_ros2.link.endpoint import HeardRobot, check_live
from gr_ros2.link.events import AirPacket, Delivered, Lost, ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.pace import Pace
from gr_ros2.link.rate import Mcs
from gr_ros2.link.stats import ReceiverStats, SenderStats
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import PaperConfig
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig


class EndpointV0:
    """An end of version 0. What it receives changes nothing of what it sends.

    :param robot: what it sends (``sends``) and receives (``receives``)
    :param codec: codes messages sent, if the link compresses, and decodes those received
    :param own: see :class:`Receiver`
    :param rng: see :class:`Sender`
    :param observer: called with every SenderEvent, in order
    """

    answers = urged = False
    frames = None
    mcs_table: Sequence[Mcs] = ()
    live_settings = ("packet_rate", "dst_id", "repeat_s", "queue_depth")

    def __init__(
        self,
        registry: Registry,
        robot: RobotConfig,
        paper: PaperConfig,
        *,
        codec: MessageCodec | None,
        own: int | None = None,
        rng: random.Random | None = None,
        observer: Callable[[SenderEvent], None] | None = None,
    ) -> None:
        to_air = codec if paper.compression else None
        sends, receives = robot.sends, robot.receives
        self._sender = Sender(registry, robot, paper, codec=to_air, rng=rng, observer=observer) if sends else None
        self._receiver = Receiver(registry, robot, paper, codec=codec, own=own) if receives else None
        self.sent = SenderStats() if self._sender is None else self._sender.stats
        self.received = ReceiverStats() if self._receiver is None else self._receiver.stats
        self.pace = Pace(AUTO) if self._sender is None else self._sender.pace

    @property
    def messages(self) -> Sender:
        """Its message side; only an end that sends is asked for it."""
        assert self._sender is not None
        return self._sender

    @property
    def idle(self) -> bool:
        """Whether nothing waits to be sent."""
        return self._sender is None or self._sender.idle

    @property
    def held_bytes(self) -> int:
        return 0 if self._receiver is None else self._receiver.held_bytes

    def reconfigure(self, **changes: Any) -> None:
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

    def peers(self, now: float) -> list[HeardRobot]:  # noqa: ARG002 - senders are not followed
        return []

    def knows(self, src_id: int) -> bool:
        return self._receiver is not None and self._receiver.knows(src_id)
