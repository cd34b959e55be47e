"""One robot's end of a link that speaks version 0."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any

from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.endpoint import HeardRobot, check_live
from gr_ros2.link.events import AirPacket, Delivered, Lost, ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.rate import Mcs
from gr_ros2.link.stats import ReceiverStats
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import PaperConfig
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

    answers = urgent = False
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
        sent = registry if robot.sends else Registry.empty()
        self.messages = Sender(sent, robot, paper, codec=to_air, rng=rng, observer=observer)
        """Its message side."""
        self._receiver = Receiver(registry, robot, paper, codec=codec, own=own) if robot.receives else None
        self.sent, self.pace = self.messages.stats, self.messages.pace
        self.received = ReceiverStats() if self._receiver is None else self._receiver.stats

    @property
    def idle(self) -> bool:
        """Whether nothing waits to be sent."""
        return self.messages.idle

    @property
    def held_bytes(self) -> int:
        return 0 if self._receiver is None else self._receiver.held_bytes

    def reconfigure(self, **changes: Any) -> None:
        check_live(changes, self.live_settings)
        self.messages.reconfigure(**changes)

    def next_packet(self, now: float) -> SentPacket | None:
        return self.messages.next_packet(now)

    def next_departure(self, *, credited: bool = False) -> float | None:  # noqa: ARG002 - nothing is due by itself
        return self.messages.next_timeout()

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

    def clock_of(self, src_id: int, now: float) -> ClockOffset | None:  # noqa: ARG002 - version 0 asks nobody
        return None

    def knows(self, src_id: int) -> bool:
        return self._receiver is not None and self._receiver.knows(src_id)
