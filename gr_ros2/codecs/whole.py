"""The codecs of topics whose frames stand alone, as a part of a link's message codec: point clouds.

Invariant: a message that the codec does not take is left to the other codecs of the link.
"""

from __future__ import annotations

import logging
from typing import Any

from gr_ros2.codecs.messages import CLOUD
from gr_ros2.codecs.topic import CODECS, CodedTopic
from gr_ros2.core.errors import CodecError
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Topic

_CLOUD = CODECS["cloud"].number
_log = logging.getLogger(__name__)


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
        self._name, self._said = topic.name, False
        self._topic = CodedTopic(topic.type_name, {"cloud": options})
        self._encoder = self._topic.encoder()

    def encode(self, payload: bytes, max_size: int) -> tuple[bytes, bytes] | None:
        try:
            coded = self._encoder.encode(payload)
            if coded.data[0] == _CLOUD:
                return coded.data, payload if self._lossless else self.decode(coded.data, max_size)
            why = coded.said
        except (CodecError, ValueError, OverflowError) as error:  # it contradicts itself, or has numbers beyond all
            why = str(error)
        if not self._lossless and not self._said:
            self._said = True
            _log.warning("topic %s: a cloud passes exactly, not as cells: %s", self._name, why)
        return None

    def decode(self, coded: bytes, max_size: int) -> bytes:
        if coded[:1] != bytes([_CLOUD]):
            raise CodecError(f"unknown codec of a topic: {coded[:1].hex() or 'none'}")
        return self._topic.decoder(max_size).decode(coded)


def whole_of(topic: Topic) -> WholeCodec | None:
    """The codec for a topic; None if its type has none."""
    return WholeCodec(topic) if topic.type_name == CLOUD else None
