"""The interface of a message codec: whole messages in, fewer bytes out, and back.

Invariant: every message is coded independently, so that a lost message damages no other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from gr_ros2.settings.registry import Topic

FRAME = b"\5"
"""What the message of a coded topic (:mod:`gr_ros2.link.frames`) begins with: the frame follows as it is."""


class MessageCodec(Protocol):
    """Codes the messages of one link; on such a link every packet carries C = 1 and every message begins with one
    byte that names codec and dictionary, 0 = stored as it is."""

    def add(self, topic: Topic) -> None:
        """Code the messages of one more topic, or of a topic id that now means another topic.

        :raises ConfigError: for a wrong option of the topic
        """

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """Prefer a definition of a type for sending.

        :param definitions: of the type and of those that it is made of, in the form of rosbags
        """

    def announcement(self, topic_id: int) -> str:
        """What the table of topics says about the coding of a topic, at most 255 bytes."""

    def lacks(self, topic_id: int, coded: bytes) -> bool:
        """Whether a message can be decoded only after its sender has announced more about its topic."""

    def canonical(self, topic_id: int, payload: bytes) -> bytes:
        """The result of ``decode`` for the coded message: the payload itself, except for bytes without information and
        for loss that was configured."""

    def encode(self, topic_id: int, payload: bytes) -> bytes:
        """The coded message, its naming byte first; at most one byte longer than the message."""

    def numbered(self, coded: bytes, number: int) -> bytes:
        """A coded message whose bytes differ from those of others with other numbers, modulo 256, though it says the
        same. Two bytes longer."""

    def decode(self, topic_id: int, coded: bytes) -> bytes:
        """The message.

        :raises CodecError: unknown codec, dictionary not held, or damaged; its ``fate`` is the ledger fate
        """
