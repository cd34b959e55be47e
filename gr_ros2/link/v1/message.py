"""A message that version 1 sends."""

from __future__ import annotations

from dataclasses import dataclass, field

from gr_ros2.link.queues import Outgoing
from gr_ros2.link.v1.key import Key
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.wire.v1 import BROADCAST


@dataclass(slots=True, eq=False)
class Message(Outgoing):
    """A message to be sent. ``begin``: packet in which it began; ``place``: its place among the entries there.

    :param dst_id: the robot for which it is, 255 for all
    :param carried: its topic and key at the robot that made it, while it is carried over others
    """

    lifetime: Lifetime = field(default_factory=Lifetime)
    begin: int = 0
    place: int = 0
    coded: bool = False
    dst_id: int = BROADCAST
    carried: tuple[int, Key] | None = None
