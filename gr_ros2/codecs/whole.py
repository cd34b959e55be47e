"""The codecs of topics whose frames stand alone, such as point clouds, as a part of a link's message codec.

Invariant: a message that the codec does not take is left to the other codecs of the link.
"""

from __future__ import annotations

import logging
from dataclasses import asdict

from gr_ros2.codecs.topic import CODECS, CodedTopic, rows_of
from gr_ros2.core.errors import CodecError
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Topic

_log = logging.getLogger(__name__)


class WholeCodec:
    """Implements :class:`gr_ros2.compression.link_codec.Whole` for one topic.

    :param name: of a codec in ``CODECS``; the topic's option of that name, where there is one, has the codec's options
    """

    def __init__(self, name: str, topic: Topic) -> None:
        chosen = getattr(topic.options, name, None)
        given = {} if chosen is None else asdict(chosen)
        options = {key: value for key, value in given.items() if value != AUTO and key != "fit"}
        self._wanted = chosen is not None and chosen != type(chosen)()
        self._name, self._topic_name, self._said = name, topic.name, False
        self._mark = bytes([CODECS[name].number])
        self._topic = CodedTopic(topic.type_name, {name: options})
        self._encoder = self._topic.encoder()

    def encode(self, payload: bytes, max_size: int) -> tuple[bytes, bytes] | None:
        try:
            coded = self._encoder.encode(payload)
            if coded.data[:1] == self._mark:
                return coded.data, self.decode(coded.data, max_size) if coded.said else payload
            why = coded.said
        except (CodecError, ValueError, OverflowError) as error:  # it contradicts itself, or has numbers beyond all
            why = str(error)
        if self._wanted and not self._said:
            self._said = True
            _log.warning("topic %s: passes exactly, not as `%s` says: %s", self._topic_name, self._name, why)
        return None

    def decode(self, coded: bytes, max_size: int) -> bytes:
        if coded[:1] != self._mark:
            raise CodecError(f"unknown codec of a topic: {coded[:1].hex() or 'none'}")
        return self._topic.decoder(max_size).decode(coded)


def whole_of(topic: Topic) -> WholeCodec | None:
    """The codec for a topic; None if its type has none."""
    for name, row in rows_of(topic.type_name):
        if row.alone:
            return WholeCodec(name, topic)
    return None
