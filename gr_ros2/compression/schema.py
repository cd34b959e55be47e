"""Message types as trees, and the shape of one serialized message: the lengths that its type does not fix.

Invariants: XCDR1 as ROS 2 writes it (alignment counts from after the 4-byte encapsulation header; an empty sequence has
no padding before its elements); a payload that is not exactly such a message (plus up to 3 bytes) has no shape, which
is not an error; every length is checked against the available bytes before it is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from struct import Struct
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

HEADER = 4
"""Bytes of the encapsulation header."""
LITTLE, BIG = "<", ">"
MAX_PARTS = 4096
"""Most strings and sequences in one message; a message with more has no shape, which bounds the time of a walk."""

_CODES = {
    "bool": "B", "byte": "B", "char": "B", "uint8": "B", "int8": "B",
    "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q",
    "float32": "f", "float64": "d",
}  # fmt: skip
"""struct codes; bool and int8 are plain bytes, since any byte value may occur and has to be preserved."""
SIZES = {code: Struct("<" + code).size for code in "BHhIiQqfd"}
TIME_TYPES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
QUATERNION_TYPE = "geometry_msgs/msg/Quaternion"


@dataclass(frozen=True, slots=True)
class Scalar:
    """One number; ``code`` is its struct code."""

    code: str


@dataclass(frozen=True, slots=True)
class Text:
    """A string."""


@dataclass(frozen=True, slots=True)
class Composite:
    """Members in order; ``type_name`` lets times and quaternions be recognised, ``open`` = a sequence is within."""

    type_name: str
    members: tuple[tuple[str, Node], ...]
    open: bool


@dataclass(frozen=True, slots=True)
class Repeat:
    """``count`` elements; None = a sequence, whose length is in the message."""

    element: Node
    count: int | None
    open: bool


Node = Scalar | Text | Composite | Repeat


def is_open(node: Node) -> bool:
    """Whether the type contains a sequence, whose length is in the message."""
    return isinstance(node, Composite | Repeat) and node.open


class Types:
    """Message definitions: those given, and those of ROS 2 Humble for all other types.

    :param definitions: ``.msg`` texts by ``package/msg/Type``; one that cannot be read is left out
    """

    def __init__(self, definitions: Mapping[str, str] | None = None) -> None:
        self._given = definitions or {}
        self._trees: dict[str, Composite | None] = {}

    @cached_property
    def _own(self) -> dict[str, Typesdict]:
        """What the definitions given say, those that say something else than Humble's."""
        humble = _humble_types().fielddefs
        own: dict[str, Typesdict] = {}
        for name, text in self._given.items():
            try:
                found = _parsed(text, name)
            except TypesysError:
                continue
            if any(kind not in humble or humble[kind][1] != members for kind, (_, members) in found.items()):
                own[name] = found
        return own

    @property
    def definitions(self) -> dict[str, str]:
        """Those given that say something else than Humble's."""
        return {name: self._given[name] for name in self._own}

    def _types(self, type_name: str) -> Mapping[str, Any]:
        """The types by which one is read. Definitions given are parsed, which takes milliseconds each, only where its
        name appears in them."""
        humble = _humble_types().fielddefs
        short = type_name.rpartition("/")[2]
        if type_name not in self._given and (
            type_name in humble or not any(short in text for text in self._given.values())
        ):
            return humble
        shared = {kind: fields for found in self._own.values() for kind, fields in found.items()} | humble
        # What a text brings along counts for its own type only.
        return shared | self._own.get(type_name, {})

    def tree(self, type_name: str) -> Composite | None:
        """The tree of a type; None where it is unknown, or has a wstring or an array of no elements."""
        if type_name not in self._trees:
            try:
                self._trees[type_name] = _composite(self._types(type_name), type_name, ())
            except KeyError:
                self._trees[type_name] = None
        return self._trees[type_name]


def tree_of(types: Mapping[str, Any], type_name: str) -> Composite | None:
    """The tree of a type by these definitions alone; None where :meth:`Types.tree` gives none, or where they define a
    time or a quaternion in another way than ROS does."""
    humble = _humble_types().fielddefs
    if any(name in types and types[name][1] != humble[name][1] for name in (*TIME_TYPES, QUATERNION_TYPE)):
        return None
    try:
        return _composite(types, type_name, ())
    except KeyError:
        return None


def _composite(types: Mapping[str, Any], type_name: str, above: tuple[str, ...]) -> Composite:
    if type_name in above:
        raise KeyError(type_name)  # a type that contains itself has no tree
    _, members = types[type_name]
    if not members:
        raise KeyError(type_name)
    above = (*above, type_name)
    nodes = tuple((name, _node(types, kind, above)) for name, kind in members)
    return Composite(type_name, nodes, any(is_open(node) for _, node in nodes))


def _node(types: Mapping[str, Any], kind: Any, above: tuple[str, ...]) -> Node:
    node_type, detail = kind
    if node_type is Nodetype.BASE:
        return Text() if detail[0] == "string" else Scalar(_CODES[detail[0]])
    if node_type is Nodetype.NAME:
        return _composite(types, detail, above)
    element, length = detail
    if node_type is Nodetype.ARRAY and not length:
        raise KeyError("an array of no elements")  # any number of them would take 0 bytes
    node, count = _node(types, element, above), length if node_type is Nodetype.ARRAY else None
    return Repeat(node, count, count is None or is_open(node))


@lru_cache(maxsize=1024)
def _parsed(text: str, name: str) -> Typesdict:
    """The types of a definition, which callers do not change. Parsing takes milliseconds, and each codec needs some."""
    return get_types_from_msg(text, name)


@cache
def _humble_types() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


@dataclass(frozen=True, slots=True)
class Shape:
    """The lengths that one message adds to its type.

    :param order: ``<`` or ``>``
    :param counts: lengths of its sequences, in order of appearance
    :param texts: stored lengths of its strings, terminator included
    :param tail: bytes after the message, 0..3
    """

    order: str
    counts: tuple[int, ...]
    texts: tuple[int, ...]
    tail: int


def shape_of(payload: bytes, tree: Composite) -> Shape | None:
    """The shape of a payload; None where it is not a message of that type."""
    if len(payload) < HEADER or payload[0] or payload[1] > 1:
        return None
    reader = _Reader(payload, LITTLE if payload[1] else BIG)
    if not reader.walk(tree):
        return None
    tail = len(payload) - HEADER - reader.at
    if not 0 <= tail <= 3 or any(payload[len(payload) - tail :]):
        return None
    return Shape(reader.order, tuple(reader.counts), tuple(reader.texts), tail)


class _Reader:
    """Walks through a message; ``at`` counts from after the encapsulation header."""

    def __init__(self, payload: bytes, order: str) -> None:
        self.order = order
        self.counts: list[int] = []
        self.texts: list[int] = []
        self.at = 0
        self._payload = payload
        self._end = len(payload) - HEADER
        self._length = Struct(order + "I")

    def walk(self, node: Node) -> bool:
        """Skip one value; returns whether the message is long enough for it."""
        if isinstance(node, Scalar):
            self._skip(SIZES[node.code], 1)
        elif isinstance(node, Text):
            length = self._read_length()
            self.texts.append(length)
            self.at += length
            return self.at <= self._end and len(self.texts) + len(self.counts) <= MAX_PARTS
        elif isinstance(node, Composite):
            return all(self.walk(member) for _, member in node.members)
        else:
            return self._walk_repeat(node)
        return self.at <= self._end

    def _walk_repeat(self, node: Repeat) -> bool:
        count = node.count
        if count is None:
            count = self._read_length()
            self.counts.append(count)
        if isinstance(node.element, Scalar):
            self._skip(SIZES[node.element.code], count)
            return self.at <= self._end
        # Every element takes at least a byte, so the walk ends with the payload, whatever the count is.
        return (
            self.at <= self._end
            and len(self.counts) <= MAX_PARTS
            and all(self.walk(node.element) for _ in range(count))
        )

    def _skip(self, size: int, count: int) -> None:
        if count:
            self.at += -self.at % size + size * count

    def _read_length(self) -> int:
        self.at += -self.at % 4
        start = HEADER + self.at
        self.at += 4
        if self.at > self._end:
            return 0
        length: int = self._length.unpack_from(self._payload, start)[0]
        return length
