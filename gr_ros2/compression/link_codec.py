"""The message codec of a link: for each topic, the codec that its registry row and options select.

First byte of a coded message: high nibble, the dictionaries used (0 none, 1..14 a shipped set, 15 a user's own, whose
two-byte id follows); low nibble, the codec (0 stored, 1 zstd, 2 fields, 3 fields with a second part). 0x00 is stored
as it is.

Invariants: a coded message is at most one byte longer than the message; the decoded message equals the original, except
for alignment gaps (zero) and quantised fields (within their bound); decoding arbitrary bytes raises only CodecError,
never makes more than ``max_size`` bytes, and takes time proportional to the bytes decoded (``bounds``); a missing or
different dictionary is an UnknownDictionaryError.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from pathlib import Path

from gr_ros2.compression import bounds
from gr_ros2.compression.dictionary import GENERAL, OWN, SHIPPED, Dictionary, load, shipped
from gr_ros2.compression.fields import FieldsCodec
from gr_ros2.compression.quantize import Quantizer, parse_steps
from gr_ros2.compression.schema import Types
from gr_ros2.compression.zstd_frames import Zstd
from gr_ros2.errors import CodecError, ConfigError, DamagedError, UnknownDictionaryError
from gr_ros2.registry import Topic
from gr_ros2.wire import FORMATS

CODECS = ("auto", "none", "fields", "zstd")
"""Values of a topic's option ``codec``; auto uses fields where the type is known, and zstd where it is not or where
zstd is shorter."""
MAX_MESSAGE = max(version.largest_message(version.max_packet_len) for version in FORMATS.values())
"""Bytes; what a link can carry uncompressed."""

STORED, ZSTD, FIELDS, FIELDS_AND_MORE = range(4)


class LinkCodec:
    """Implements :class:`gr_ros2.link.message_codec.MessageCodec` for some topics.

    Both ends need the same topics and dictionaries; ``codec`` and ``quantize`` of a topic matter to the sender only.

    :param dictionaries: a user's own dictionaries, or their files; the first one with a topic's type is used, otherwise
        the shipped one
    :param max_size: bytes; larger messages are stored, and nothing larger is decoded
    :raises ConfigError: a file that is not a dictionary, two that share an id, a wrong ``codec`` or ``quantize``
    """

    def __init__(
        self,
        topics: Iterable[Topic],
        dictionaries: Sequence[Dictionary | str | Path] = (),
        *,
        max_size: int = MAX_MESSAGE,
    ) -> None:
        own = [item if isinstance(item, Dictionary) else load(item) for item in dictionaries]
        by_id: dict[bytes, Dictionary] = {}
        for item in own:
            other = by_id.setdefault(item.prefix, item)
            if other is not item and other.digest != item.digest:
                raise ConfigError(f"dictionaries {other.name!r} and {item.name!r} share the id {item.prefix.hex()}")
        self._sets = [*by_id.values(), *(shipped(number) for number in reversed(SHIPPED))]
        self._max_size = max_size
        self._made: dict[tuple[str, str, str], TopicCodec] = {}
        """Codecs by type, ``codec`` and ``quantize``: topics that have these in common share one."""
        self._topics: dict[int, TopicCodec] = {}
        for topic in topics:
            self.add(topic)

    def add(self, topic: Topic) -> None:
        """See MessageCodec."""
        key = (topic.type_name, topic.options.codec, topic.options.quantize)
        if key not in self._made:
            self._made[key] = TopicCodec(topic, self._sets, self._max_size)
        self._topics[topic.topic_id] = self._made[key]

    def of(self, topics: Iterable[Topic]) -> LinkCodec:
        """A codec of other topics, which shares dictionaries and everything made so far with this one."""
        made = copy(self)
        made._topics = {}
        for topic in topics:
            made.add(topic)
        return made

    def canonical(self, topic_id: int, payload: bytes) -> bytes:
        """The message that the other end gets: alignment gaps are zero, quantised fields are rounded, the rest is
        unchanged.

        It is computed from the type alone, independently of the coded bytes, so that comparing with it detects errors
        of the codec.

        :raises KeyError: a topic id that it was not made for
        """
        return self._topics[topic_id].canonical(payload)

    def encode(self, topic_id: int, payload: bytes) -> bytes:
        """The coded message, at most one byte longer than the payload; never fails.

        :raises KeyError: a topic id that it was not made for
        """
        return self._topics[topic_id].encode(payload)

    def decode(self, topic_id: int, coded: bytes) -> bytes:
        """The message.

        :raises CodecError: ``row`` is unknown_dictionary, damaged or unsupported (a codec we do not know)
        :raises KeyError: a topic id that it was not made for
        """
        return self._topics[topic_id].decode(coded)


class TopicCodec:
    """Codes the messages of one topic.

    :param sets: dictionaries, the preferred ones first
    """

    def __init__(self, topic: Topic, sets: Sequence[Dictionary], max_size: int) -> None:
        self._mode: str = topic.options.codec
        if self._mode not in CODECS:
            raise ConfigError(f"codec = {self._mode!r}: topic {topic.name!r} takes one of {', '.join(CODECS)}")
        self._held = {item.number.to_bytes(1, "big") + item.prefix: _Coders(topic, item) for item in sets}
        self._choices: list[_Coders] = []
        """Coders for sending, the preferred one first: one for each definition of the type."""
        for item, coders in zip(sets, self._held.values(), strict=True):
            if topic.type_name in item.types and all(coders.tree != other.tree for other in self._choices):
                self._choices.append(coders)
        if not self._choices:
            self._choices = [self._held[GENERAL.to_bytes(1, "big")]]
        self._plain = Zstd()
        self._max_size = max_size
        if steps := parse_steps(topic.options.quantize):
            self._quantize(steps, topic)

    def encode(self, payload: bytes) -> bytes:
        """See LinkCodec."""
        payload = self.canonical(payload)
        if self._mode == "none" or len(payload) > self._max_size:
            return b"\0" + payload
        coders = self._fitting(payload)
        coded = None
        if self._mode != "zstd" and coders.fields is not None:
            found = coders.fields.encode(payload)
            if found is not None:
                coded = coders.heads[FIELDS_AND_MORE if found[1] else FIELDS] + found[0]
                if self._mode == "auto" and found[1]:
                    other = self._zstd(coders, payload)
                    coded = other if len(other) < len(coded) else coded
        if coded is None:
            coded = self._zstd(coders, payload)
        return coded if len(coded) <= len(payload) else b"\0" + payload

    def decode(self, coded: bytes) -> bytes:
        """See LinkCodec."""
        if not coded:
            raise DamagedError("damaged message: it is empty")
        number, codec = coded[0] >> 4, coded[0] & 15
        max_size = min(self._max_size, bounds.largest(len(coded)))
        if coded[0] == STORED:
            if len(coded) - 1 > self._max_size:
                raise DamagedError(f"damaged message: larger than {self._max_size} bytes")
            return coded[1:]
        if codec not in (ZSTD, FIELDS, FIELDS_AND_MORE) or (number == 0 and codec != ZSTD):
            raise CodecError(f"unknown codec {codec} with dictionaries {number}")
        if number == 0:
            return self._plain.decompress(coded[1:], max_size)
        start = 3 if number == OWN else 1
        coders = self._held.get(bytes([number]) + coded[1:start])
        if coders is None:
            which = f"own dictionary {coded[1:start].hex()}" if number == OWN else f"shipped dictionaries {number}"
            raise UnknownDictionaryError(f"message coded with {which}, which are not held here")
        body = coded[start:]
        if codec == ZSTD:
            if coders.zstd is None:
                raise UnknownDictionaryError(f"dictionaries {number} have none for {coders.type_name}")
            return coders.zstd.decompress(body, max_size)
        if coders.fields is None:
            raise UnknownDictionaryError(f"the definition of {coders.type_name} is not known here")
        return coders.fields.decode(body, codec == FIELDS_AND_MORE, max_size)

    def canonical(self, payload: bytes) -> bytes:
        """See LinkCodec. A message that the configuration stores uncoded keeps its gaps."""
        if len(payload) > self._max_size:
            return payload
        coders = self._fitting(payload)
        if coders.fields is None or (self._mode == "none" and coders.quantizer is None):
            return payload
        found = coders.fields.layout(payload)
        if found is None:
            return payload
        return found[0].pack(*found[1]) if coders.quantizer is None else coders.quantizer(*found)

    def _fitting(self, payload: bytes) -> _Coders:
        """The coders of the first definition that fits the message; those of the first definition if none fits."""
        if len(self._choices) > 1:
            for coders in self._choices:
                if coders.fields is not None and coders.fields.layout(payload) is not None:
                    return coders
        return self._choices[0]

    def _quantize(self, steps: Mapping[str, int], topic: Topic) -> None:
        """Quantise messages in every definition that has these fields; at least one definition must have them."""
        errors: list[ConfigError] = []
        for coders in self._choices:
            try:
                if coders.tree is not None:
                    coders.quantizer = Quantizer(coders.tree, steps)
            except ConfigError as error:
                errors.append(error)
        if all(coders.tree is None for coders in self._choices):
            raise ConfigError(f"quantize: the type {topic.type_name} of topic {topic.name!r} is not known")
        if all(coders.quantizer is None for coders in self._choices):
            raise errors[0]

    def _zstd(self, coders: _Coders, payload: bytes) -> bytes:
        least = bounds.least(len(payload))
        if coders.zstd is None:
            return b"\x01" + self._plain.compress(payload, least=least)
        return coders.heads[ZSTD] + coders.zstd.compress(payload, least=least)


class _Coders:
    """The coders of one set of dictionaries for one topic.

    All of them are made in advance, so that a received message never causes this work.

    :ivar tree: the type, None if it is unknown
    :ivar fields: None if the type is unknown
    :ivar zstd: None if the set has no dictionary for the type
    :ivar quantizer: None if nothing is quantised
    """

    def __init__(self, topic: Topic, dictionary: Dictionary) -> None:
        self.type_name = topic.type_name
        self.heads = [bytes([dictionary.number << 4 | codec]) + dictionary.prefix for codec in range(4)]
        own = {name: entry.definition for name, entry in dictionary.types.items() if entry.definition}
        self.tree = Types(own).tree(topic.type_name)
        self.fields: FieldsCodec | None = None
        self.quantizer: Quantizer | None = None
        if self.tree is not None:
            self.fields = FieldsCodec(self.tree, dictionary.model(self.type_name), Zstd())
        entry = dictionary.types.get(topic.type_name)
        self.zstd = Zstd(entry.zstd) if entry is not None and entry.zstd else None
