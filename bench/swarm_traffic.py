"""What the packets of a simulated swarm carry: each robot's own newest message, or what relaying chooses.

Invariant: a packet carries one message, which says when it was made.
"""

from __future__ import annotations

from struct import Struct
from typing import Protocol

from gr_ros2.relay.gain import Gains, Stream
from gr_ros2.relay.robots import OtherRobots
from gr_ros2.wire.control import Newest, read_control, write_control
from gr_ros2.wire.mac_block import NOBODY, Block
from gr_ros2.wire.relayed import RELAYED_LEN, Relayed, read_relayed, write_relayed

_stamp = Struct(">d")
_MESSAGE_LEN = RELAYED_LEN + _stamp.size


class SwarmTraffic(Protocol):
    """The messages of one robot. Times in s of its own clock; when a message was made, by the swarm's clock.

    :ivar relays: whether the newest packet carries a message of another robot
    """

    relays: bool

    @property
    def weight(self) -> int:
        """Packets to send while others send one."""

    def compose(self, number: int, made: float, now: float) -> bytes:
        """The content of the packet that leaves now.

        :param number: of the robot's own newest message
        :param made: when this message was made
        """

    def take(self, src_id: int, block: Block | None, content: bytes, now: float) -> tuple[int, float]:
        """What a packet carried: the robot that made the message, and when."""


class OwnOnly:
    """Each robot sends its own messages."""

    relays = False
    weight = 1

    def compose(self, number: int, made: float, now: float) -> bytes:  # noqa: ARG002
        return _stamp.pack(made)

    def take(self, src_id: int, block: Block | None, content: bytes, now: float) -> tuple[int, float]:  # noqa: ARG002
        return src_id, _stamp.unpack(content)[0]


class ByGain:
    """Each packet carries the message that is worth most to those who hear the robot."""

    def __init__(self, src_id: int) -> None:
        self.relays = False
        self._src_id = src_id
        self._gains = Gains(src_id, OtherRobots())
        self._newest: dict[int, Relayed] = {}

    @property
    def weight(self) -> int:
        return self._gains.weight

    def compose(self, number: int, made: float, now: float) -> bytes:
        own = Stream(self._src_id, 0, 0)
        self._gains.own(0, 0, number, now)
        stream, _ = self._gains.best(now)
        stream = stream or own
        self._gains.sent(stream, self._gains.has(stream), now)
        self.relays = stream != own
        if not self.relays:
            message = Relayed(self._src_id, 0, number, 0, 0, 0, _stamp.pack(made))
        else:
            message = self._newest[stream.origin]
            message = message._replace(hops=min(message.hops + 1, 63))
        return write_relayed(message) + b"".join(map(write_control, self._gains.tells()))

    def take(self, src_id: int, block: Block | None, content: bytes, now: float) -> tuple[int, float]:
        gains = self._gains
        if block is not None:
            gains.neighbour(src_id, now, [name for name in block.names if name != NOBODY], block.heard)
        message, at = read_relayed(content[:_MESSAGE_LEN]), _MESSAGE_LEN
        while at < len(content):
            at, newest = read_control(content, at, len(content))
            assert isinstance(newest, Newest)
            gains.told(src_id, newest)
        made: float = _stamp.unpack(message.payload)[0]
        if gains.message(src_id, Stream(message.origin, message.start, message.topic_id), message.number, now, made):
            self._newest[message.origin] = message
        return message.origin, made
