"""The structure of a type as a short text, from which another robot can decode messages of this type.

A sender that has learned the definition of a type announces its structure. Names are left out, and messages within the
message are written member by member, because coding depends on neither.

The text is a sequence of members without separators. ``d f q Q i I h H B`` is a number, as in Python's ``struct``;
``s`` a string; ``T`` a time or a duration; ``R`` a quaternion. A count before a member makes it repeated: ``36d`` is an
array of 36 doubles, ``*s`` a sequence of strings, ``*(Tsddd)`` a sequence of messages. nav_msgs/Odometry is
``TssdddR36ddddddd36d``.

Invariants: ``read_structure(write_structure(tree))`` codes every message as ``tree`` does; ``read_structure`` raises
nothing but a CodecError, whatever the text; the tree of a text of n characters has at most n nodes.
"""

from __future__ import annotations

import re

from gr_ros2.compression.schema import (
    QUATERNION_TYPE,
    SIZES,
    TIME_TYPES,
    Composite,
    Node,
    Repeat,
    Scalar,
    Text,
    is_open,
)
from gr_ros2.core.errors import CodecError

MAX_BYTES = 1 << 24
"""Largest array of numbers, in bytes; no message is larger."""
MAX_DEPTH = 32
"""Most parentheses within each other."""

_TOKEN = re.compile(r"(\*|[1-9][0-9]{0,7})?([BHhIiQqfdsTR(])|\)")
_NAMED = {
    "T": Composite(TIME_TYPES[0], (("sec", Scalar("i")), ("nanosec", Scalar("I"))), False),
    "R": Composite(QUATERNION_TYPE, tuple((axis, Scalar("d")) for axis in "xyzw"), False),
}


def write_structure(node: Node) -> str:
    """The text of a tree."""
    if isinstance(node, Scalar):
        return node.code
    if isinstance(node, Text):
        return "s"
    if isinstance(node, Repeat):
        several = isinstance(node.element, Composite) and node.element.type_name not in (*TIME_TYPES, QUATERNION_TYPE)
        element = write_structure(node.element)
        return f"{'*' if node.count is None else node.count}{f'({element})' if several else element}"
    if node.type_name in TIME_TYPES:
        return "T"
    if node.type_name == QUATERNION_TYPE:
        return "R"
    return "".join(write_structure(member) for _, member in node.members)


def read_structure(text: str) -> Composite:
    """The tree of a text.

    :raises CodecError: it is not the text of a structure
    """
    tokens = []
    at = 0
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise CodecError(f"no structure of a type: character {at} of {text!r}")
        tokens.append((match[1], match[2]))
        at = match.end()
    members, rest = _members(tokens, 0, 0)
    if rest != len(tokens):
        raise CodecError(f"no structure of a type: a parenthesis too many in {text!r}")
    return _composite(members)


def _members(tokens: list[tuple[str | None, str | None]], at: int, depth: int) -> tuple[list[Node], int]:
    """The members from a token on, and the token behind them: the end, or a closing parenthesis."""
    if depth > MAX_DEPTH:
        raise CodecError(f"no structure of a type: more than {MAX_DEPTH} parentheses within each other")
    members: list[Node] = []
    while at < len(tokens) and tokens[at][1] is not None:
        count, kind = tokens[at]
        assert kind is not None
        at += 1
        node: Node
        if kind == "(":
            inner, at = _members(tokens, at, depth + 1)
            if count is None or at == len(tokens):
                raise CodecError("no structure of a type: parentheses without a count, or not closed")
            node = _composite(inner)
            at += 1
        elif kind == "s":
            node = Text()
        else:
            node = _NAMED.get(kind) or Scalar(kind)
        members.append(node if count is None else _repeat(node, count))
    return members, at


def _repeat(element: Node, count: str) -> Repeat:
    if count == "*":
        return Repeat(element, None, True)
    if isinstance(element, Scalar) and int(count) * SIZES[element.code] > MAX_BYTES:
        raise CodecError(f"no structure of a type: an array of {count} numbers")
    return Repeat(element, int(count), is_open(element))


def _composite(members: list[Node]) -> Composite:
    if not members:
        raise CodecError("no structure of a type: no members")
    return Composite("", tuple(("", member) for member in members), any(map(is_open, members)))
