"""A message that version 1 sends."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from gr_ros2.link.key import Key
from gr_ros2.link.queues import Outgoing
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.wire.v1 import BROADCAST, MAX_BACK


@dataclass(slots=True, eq=False)
class Message(Outgoing):
    """A message to be sent. ``begin``: packet in which it began, or began when it was first sent in fragments;
    ``place``: its place among the entries there, -1 for one that is sent again.

    :param dst_id: the robot for which it is, 255 for all
    :param numbers: the packets that carry a frame of a coded topic, as far as somebody lacks them
    :param left_at: when its last fragment left, s
    :param published: when it was submitted, s, where it is sent again for robots that join late
    :param robots: those for which its packets are sent fast enough; None for all
    :param key: it needs no earlier message of its topic, and these are of no more use when it has left
    :param begins: it is only the beginning of a message, for who has heard the rest
    :param plain: the message before it was coded, where later ones may be merged with it
    :param carried: its topic and key at the robot that made it, while it is carried over others
    """

    lifetime: Lifetime = field(default_factory=Lifetime)
    begin: int = 0
    place: int = 0
    coded: bool = False
    dst_id: int = BROADCAST
    plain: bytes = b""
    carried: tuple[int, Key] | None = None
    numbers: list[int] = field(default_factory=list)
    robots: frozenset[int] | None = None
    left_at: float = inf
    published: float = inf
    key: bool = False
    begins: bool = False

    @property
    def made(self) -> float:
        """When it was made, s."""
        return min(self.submitted, self.published)

    def back(self, number: int) -> int:
        """How many packets before this one it began; 0 if it begins there."""
        back = number - self.begin
        return back if self.begin and (self.index or back <= MAX_BACK // 2) else 0
