"""The codecs of topics whose frames stand alone, as a part of a link's message codec: point clouds.

Invariant: a message that the codec does not take is left to the other codecs of the link.
"""

from __future__ import annotations

from typing import Any

from gr_ros2.codecs.base import MAX_SIZE
from gr_ros2.codecs.messages import CLOUD
from gr_ros2.codecs.topic import CodedTopic
from gr_ros2.core.errors import CodecError, DamagedError
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Topic

_CLOUD = 3
"""Number of the codec of clouds in a frame."""


class WholeCodec:
    """Implements :class:`gr_ros2.compression.link_codec.Whole` for one topic.

    :param topic: with its option ``cloud``
    """

    def __init__(self, topic: Topic) -> None:
        chosen = topic.options.cloud
        options: dict[str, Any] = {"voxel": chosen.voxel, "keep": chosen.keep}
        if chosen.range != AUTO:
            options["range"] = chosen.range
        self._lossless = not chosen.voxel
        self._topic = CodedTopic(topic.type_name, {"cloud": options})
        self._encoder = self._topic.encoder()

    def encode(self, payload: bytes) -> tuple[bytes, bytes] | None:
        try:
            coded = self._encoder.encode(payload).data
        except DamagedError:  # it contradicts itself, and passes as it is
            return None
        if coded[0] != _CLOUD:
            return None
        return coded, payload if self._lossless else self.decode(coded, MAX_SIZE)

    def decode(self, coded: bytes, max_size: int) -> bytes:
        if coded[:1] != bytes([_CLOUD]):
            raise CodecError(f"unknown codec of a topic: {coded[:1].hex() or 'none'}")
        return self._topic.decoder(max_size).decode(coded)


def whole_of(topic: Topic) -> WholeCodec | None:
    """The codec for a topic; None if its type has none."""
    return WholeCodec(topic) if topic.type_name == CLOUD else None
