"""The message codec of a link: for each topic, the codec that its registry row and options select.

First byte of a coded message: high nibble, the dictionaries used (0 none, 1..13 a shipped set; 14 the structure of the
type, as the sender has announced it); low nibble, the codec (0 stored, 1 zstd, 2 fields, 3 fields with a second part,
4 a frame of a codec for this type alone, such as that of clouds, 5 a frame of a coded topic, which the receiver's chain
of frames decodes). 0x00 is stored as it is.
After 0x06 a byte follows that has no meaning, and then a coded message: so a message that says the same as an earlier
one is not taken for its repeat.

A sender announces in its table of topics how a topic is coded: the option ``codec`` and, where it has learned the
definition of the type, a blank and the structure (``compression.structure``).

Invariants: a coded message is at most one byte longer than the message; the decoded message equals the original, except
for alignment gaps (zero) and quantised fields (within their bound); decoding arbitrary bytes raises only CodecError,
never makes more than ``max_size`` bytes, and takes time proportional to the bytes decoded (``bounds``); a missing or
different dictionary is an UnknownDictionaryError.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from threading import Lock
from typing import Any, Protocol

from gr_ros2.compression import bounds
from gr_ros2.compression.dictionary import GENERAL, SHIPPED, Dictionary, shipped
from gr_ros2.compression.fields import FieldsCodec
from gr_ros2.compression.quantize import Quantizer, parse_steps
from gr_ros2.compression.schema import Composite, Types, tree_of
from gr_ros2.compression.structure import read_structure, write_structure
from gr_ros2.compression.zstd_frames import Zstd
from gr_ros2.core.errors import CodecError, ConfigError, DamagedError, UnknownDictionaryError
from gr_ros2.link.frames import MARK
from gr_ros2.link.message_codec import FRAME
from gr_ros2.settings.registry import Topic
from gr_ros2.wire import FORMATS

CODECS = ("auto", "none", "fields", "zstd")
"""Values of a topic's option ``codec``; auto uses fields where the type is known, and zstd where it is not or where
zstd is shorter."""
MAX_MESSAGE = max(version.largest_message(version.max_packet_len) for version in FORMATS.values())
"""Bytes; what a link can carry uncompressed."""

STORED, ZSTD, FIELDS, FIELDS_AND_MORE, WHOLE = range(5)
NUMBERED = 6
ANNOUNCED = 14
"""Number in the first byte for the structure that the sender has announced; two bytes of its CRC follow."""
MAX_ANNOUNCEMENT = 255
"""Bytes of what a table says about the coding of a topic. A type whose structure is longer is not announced."""
MAX_SHARED = 2 * max(version.max_topics for version in FORMATS.values())
"""Codecs that topics share at most."""
MAX_LEARNED = 8
"""Definitions of one type that are learned at most, as publishers of different age come and go."""


class Whole(Protocol):
    """The codec of one topic for messages of its type alone."""

    def encode(self, payload: bytes, max_size: int) -> tuple[bytes, bytes] | None:
        """The frame and the message that ``decode`` makes of it; None for a message that it does not take."""

    def decode(self, coded: bytes, max_size: int) -> bytes:
        """The message.

        :raises CodecError: as :meth:`LinkCodec.decode`
        """


class LinkCodec:
    """Implements :class:`gr_ros2.link.message_codec.MessageCodec` for some topics.

    Both ends need the same topics; ``codec`` and ``quantize`` of a topic matter to the sender only.

    :param max_size: bytes; larger messages are stored, and nothing larger is decoded
    :param whole: makes the codec that a topic's type has for itself; None from it: the type has none
    :raises ConfigError: a wrong ``codec`` or ``quantize``
    """

    def __init__(
        self,
        topics: Iterable[Topic],
        *,
        max_size: int = MAX_MESSAGE,
        whole: Callable[[Topic], Whole | None] = lambda _: None,
    ) -> None:
        self._whole = whole
        self._sets = [shipped(number) for number in reversed(SHIPPED)]
        self._max_size = max_size
        self._made: dict[tuple[Any, ...], TopicCodec] = {}
        """Codecs by type, ``codec``, ``quantize`` and ``cloud``: topics that have these in common share one. Others
        name types as they like, so there are at most ``MAX_SHARED``; the oldest is not shared any more."""
        self._topics: dict[int, TopicCodec] = {}
        for topic in topics:
            self.add(topic)

    def add(self, topic: Topic) -> None:
        key = (topic.type_name, topic.options.codec, topic.options.quantize, topic.options.cloud)
        if key not in self._made:
            if len(self._made) == MAX_SHARED:
                del self._made[next(iter(self._made))]
            self._made[key] = TopicCodec(topic, self._sets, self._max_size, self._whole(topic))
        self._topics[topic.topic_id] = self._made[key]

    def of(self, topics: Iterable[Topic], announcements: Mapping[int, str] | None = None) -> LinkCodec:
        """A codec of other topics, which shares everything made so far with this one.

        :param announcements: what their sender says about the coding of some of them, by topic id
        """
        made = copy(self)
        made._topics = {}
        for topic in topics:
            made.add(topic)
        for topic_id, text in (announcements or {}).items():
            made._topics[topic_id] = made._topics[topic_id].told(text)
        return made

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """Use a type's definition from now on. A type that cannot be split is coded as before."""
        tree = tree_of(definitions, type_name)
        if tree is None:
            return
        for key, codec in self._made.items():
            if key[0] == type_name:
                with codec.lock:
                    codec.learn(tree)

    def announcement(self, topic_id: int) -> str:
        return self._topics[topic_id].announcement

    def lacks(self, topic_id: int, coded: bytes) -> bool:
        return self._topics[topic_id].lacks(_inner(coded))

    def canonical(self, topic_id: int, payload: bytes) -> bytes:
        """The message that the other end gets: alignment gaps are zero, quantised fields are rounded, the rest is
        unchanged.

        It is computed from the type alone, independently of the coded bytes, so that comparing with it detects errors
        of the codec.

        :raises KeyError: a topic id that it was not made for
        """
        codec = self._topics[topic_id]
        with codec.lock:
            return codec.canonical(payload)

    def encode(self, topic_id: int, payload: bytes) -> bytes:
        """The coded message, at most one byte longer than the payload; never fails.

        :raises KeyError: a topic id that it was not made for
        """
        codec = self._topics[topic_id]
        with codec.lock:
            return codec.encode(payload)

    def numbered(self, coded: bytes, number: int) -> bytes:
        return bytes([NUMBERED, number & 0xFF]) + coded

    def decode(self, topic_id: int, coded: bytes) -> bytes:
        """The message.

        :raises CodecError: ``fate`` is unknown_dictionary, damaged or unsupported (a codec we do not know)
        :raises KeyError: a topic id that it was not made for
        """
        codec = self._topics[topic_id]
        with codec.lock:
            return codec.decode(_inner(coded))


class TopicCodec:
    """Codes the messages of one topic.

    :param sets: dictionaries, the preferred ones first
    :param whole: the codec that its type has for itself, which a sender with ``codec`` auto prefers
    :ivar lock: held while it codes: coders have buffers of their own, and large messages are coded in other threads
    """

    def __init__(self, topic: Topic, sets: Sequence[Dictionary], max_size: int, whole: Whole | None = None) -> None:
        self._whole = whole
        self.lock = Lock()
        self._frames = False
        """Whether its sender has announced frames of a chain."""
        self._foreseen: tuple[bytes, tuple[bytes, bytes]] | None = None
        """What ``canonical`` made of a message, for ``encode``, which follows it."""
        self._mode: str = topic.options.codec
        if self._mode not in CODECS:
            raise ConfigError(f"codec = {self._mode!r}: topic {topic.name!r} takes one of {', '.join(CODECS)}")
        self._held = {item.number.to_bytes(1, "big"): _Coders.of(topic, item) for item in sets}
        self._choices: list[_Coders] = []
        """Coders for sending, the preferred one first: one for each definition of the type."""
        for item, coders in zip(sets, self._held.values(), strict=True):
            if topic.type_name in item.types and all(coders.tree != other.tree for other in self._choices):
                self._choices.append(coders)
        if not self._choices:
            self._choices = [self._held[GENERAL.to_bytes(1, "big")]]
        self._plain = Zstd()
        self._max_size = max_size
        self._learned = 0
        self.announcement = self._mode
        """What the table says about the coding of this topic."""
        self._steps = parse_steps(topic.options.quantize)
        if self._steps:
            self._quantize(self._steps, topic)

    def learn(self, tree: Composite) -> None:
        text = write_structure(tree)
        known = [coders for coders in self._choices if coders.tree is not None and write_structure(coders.tree) == text]
        if known:
            self._choices = known + [coders for coders in self._choices if coders not in known]
            return
        announcement = f"{self._mode} {text}"
        if self._mode in ("none", "zstd") or len(announcement) > MAX_ANNOUNCEMENT or self._learned == MAX_LEARNED:
            return
        self._learned += 1
        coders = _Coders.announced(tree, text)
        if self._steps:
            with suppress(ConfigError):  # a field that other definitions of the type have
                coders.quantizer = Quantizer(tree, self._steps)
        self._choices = [coders, *(other for other in self._choices if other.tree is not None and not other.learned)]
        self._held = {**self._held, bytes([ANNOUNCED]) + _mark(text): coders}
        self.announcement = announcement

    def told(self, announcement: str) -> TopicCodec:
        """The same, for messages of a sender that has announced this."""
        mode, _, text = announcement.partition(" ")
        if mode == MARK:
            made = copy(self)
            made._frames = True
            return made
        if not text:
            return self
        try:
            coders = _Coders.announced(read_structure(text), text)
        except CodecError:  # of a later version; its messages are refused by name
            return self
        made = copy(self)
        made._held = {**self._held, bytes([ANNOUNCED]) + _mark(text): coders}
        return made

    def lacks(self, coded: bytes) -> bool:
        return bool(coded) and coded[0] >> 4 == ANNOUNCED and bytes([ANNOUNCED]) + coded[1:3] not in self._held

    def encode(self, payload: bytes) -> bytes:
        own = self._own(payload)
        if own is not None:
            return bytes([WHOLE]) + own[0]
        payload = self._spoken(payload)
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
        if not coded:
            raise DamagedError("damaged message: it is empty")
        number, codec = coded[0] >> 4, coded[0] & 15
        if coded[0] == STORED or (self._frames and coded[:1] == FRAME):
            if len(coded) - 1 > self._max_size:
                raise DamagedError(f"damaged message: larger than {self._max_size} bytes")
            return coded[1:]
        if coded[0] == WHOLE and self._whole is not None:
            return self._whole.decode(coded[1:], min(self._max_size, bounds.largest(len(coded) - 1)))
        if codec not in (ZSTD, FIELDS, FIELDS_AND_MORE) or (number == 0 and codec != ZSTD):
            raise CodecError(f"unknown codec {codec} with dictionaries {number}")
        start = 3 if number == ANNOUNCED else 1
        body = coded[start:]
        max_size = min(self._max_size, bounds.largest(len(body)))
        if number == 0:
            return self._plain.decompress(body, max_size)
        coders = self._held.get(bytes([number]) + coded[1:start])
        if coders is None:
            which = f"structure {coded[1:start].hex()}" if number == ANNOUNCED else f"shipped dictionaries {number}"
            raise UnknownDictionaryError(f"message coded with {which}, not held here")
        if codec == ZSTD:
            if coders.zstd is None:
                raise UnknownDictionaryError(f"dictionaries {number} have none for {coders.type_name}")
            return coders.zstd.decompress(body, max_size)
        if coders.fields is None:
            raise UnknownDictionaryError(f"the definition of {coders.type_name} is not known here")
        return coders.fields.decode(body, codec == FIELDS_AND_MORE, max_size)

    def canonical(self, payload: bytes) -> bytes:
        """The message that comes out at the other end. One that the configuration stores uncoded keeps its gaps."""
        own = self._own(payload)
        if own is None:
            return self._spoken(payload)
        self._foreseen = payload, own
        return own[1]

    def _own(self, payload: bytes) -> tuple[bytes, bytes] | None:
        """Frame and message of the codec that the type has for itself, where it is used."""
        if self._whole is None or self._mode != "auto" or len(payload) > self._max_size:
            return None
        foreseen, self._foreseen = self._foreseen, None
        if foreseen is not None and foreseen[0] is payload:
            return foreseen[1]
        own = self._whole.encode(payload, self._max_size)
        fits = own is not None and len(own[0]) < len(payload) and len(own[1]) <= bounds.largest(len(own[0]))
        return own if fits else None

    def _spoken(self, payload: bytes) -> bytes:
        """What comes out where the type has no codec for itself."""
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
    """The coders of one set of dictionaries, or of one announced structure, for one type.

    All of them are made in advance, so that a received message never causes this work.

    :param head: what names them at the beginning of a message: their number, and bytes that follow it
    :param dictionary: whose words and numbers are used
    :ivar tree: the type, None if it is unknown
    :ivar fields: None if the type is unknown
    :ivar zstd: None if the set has no dictionary for the type
    :ivar quantizer: None if nothing is quantised
    """

    def __init__(self, type_name: str, head: bytes, dictionary: Dictionary, tree: Composite | None) -> None:
        self.type_name = type_name
        self.heads = [bytes([head[0] << 4 | codec]) + head[1:] for codec in range(4)]
        self.tree = tree
        self.learned = head[0] == ANNOUNCED
        self.fields: FieldsCodec | None = None
        self.quantizer: Quantizer | None = None
        self.zstd: Zstd | None = None
        if tree is not None:
            self.fields = FieldsCodec(tree, dictionary.model(type_name), Zstd())

    @classmethod
    def of(cls, topic: Topic, dictionary: Dictionary) -> _Coders:
        """The coders of one set of dictionaries."""
        own = {name: entry.definition for name, entry in dictionary.types.items() if entry.definition}
        head = dictionary.number.to_bytes(1, "big")
        made = cls(topic.type_name, head, dictionary, Types(own).tree(topic.type_name))
        entry = dictionary.types.get(topic.type_name)
        made.zstd = Zstd(entry.zstd) if entry is not None and entry.zstd else None
        return made

    @classmethod
    def announced(cls, tree: Composite, text: str) -> _Coders:
        """The coders of a structure. Types have no names there, so nothing is known about this one in particular."""
        return cls("", bytes([ANNOUNCED]) + _mark(text), shipped(GENERAL), tree)


def _inner(coded: bytes) -> bytes:
    return coded[2:] if coded[:1] == bytes([NUMBERED]) else coded


def _mark(text: str) -> bytes:
    return crc_hqx(text.encode(), 0).to_bytes(2, "big")
