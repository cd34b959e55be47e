"""What nodes say about types: hashes as ROS has them, and nothing that a reply could do to whoever reads it."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from gr_ros2.core.errors import DescriptionError
from gr_ros2.middleware.type_definitions import ships, type_hash
from gr_ros2.middleware.type_descriptions import MAX_REPLY, hash_of, read_reply, request
from tests.middleware.describing import (
    CUSTOM,
    CUSTOM_TEXT,
    OTHER_TEXT,
    description,
    hash_of_text,
    message,
    needed,
    reply,
    types_of,
)

JAZZY = get_typestore(Stores.ROS2_JAZZY)


def has_char_or_wide(type_name: str) -> bool:
    """A ``char`` of a text is hashed as another type; wide strings are not read."""
    found = needed(JAZZY.fielddefs, type_name)
    kinds = [kind for _, members in found.values() for _, kind in members]
    return any(word in str(kind) for word in ("char", "wstring") for kind in kinds)


@pytest.mark.parametrize("type_name", sorted(name for name in JAZZY.fielddefs if not has_char_or_wide(name)))
def test_every_type_of_ros_is_read_from_its_description(type_name: str) -> None:
    types = needed(JAZZY.fielddefs, type_name)
    digest = JAZZY.hash_rihs01(type_name)
    assert hash_of(description(types, type_name)) == digest
    described = read_reply(reply(types, type_name), type_name, digest)
    for name, (_, members) in types.items():
        assert described.types[name][1] == (members or described.types[name][1])


def test_a_custom_type_is_read_and_reads_its_messages() -> None:
    digest = hash_of_text(CUSTOM_TEXT)
    described = read_reply(reply(types_of(CUSTOM_TEXT), CUSTOM), CUSTOM, digest)
    decoded: Any = described.store().deserialize_cdr(message(7), CUSTOM)
    assert (decoded.mode, decoded.names, decoded.header.frame_id) == (7, ["left", "right"], "base")
    assert not ships(CUSTOM, digest)
    assert ships("nav_msgs/msg/Odometry", type_hash("nav_msgs/msg/Odometry"))


def test_only_the_type_that_was_asked_for_is_believed() -> None:
    digest = hash_of_text(CUSTOM_TEXT)
    whole = reply(types_of(CUSTOM_TEXT), CUSTOM)
    for payload, name, asked, said in (
        (reply(types_of(OTHER_TEXT), CUSTOM), CUSTOM, digest, "of hash"),
        (whole, "robot_msgs/msg/Other", digest, "describes robot_msgs/msg/WheelState"),
        (whole, CUSTOM, hash_of_text(OTHER_TEXT), "of hash"),
        (reply(types_of(CUSTOM_TEXT), CUSTOM, failure="not here"), CUSTOM, digest, "not here"),
        (whole + bytes(MAX_REPLY), CUSTOM, digest, "at most"),
        (whole[:50], CUSTOM, digest, "cannot be read"),
        (b"", CUSTOM, digest, "cannot be read"),
    ):
        with pytest.raises(DescriptionError, match=said):
            read_reply(payload, name, asked)


def _text(size: int) -> Any:
    return (Nodetype.BASE, ("string", size))


@pytest.mark.parametrize(
    ("types", "said"),
    [
        ({CUSTOM: ([], [("x", (Nodetype.NAME, CUSTOM))])}, "deep"),
        ({CUSTOM: ([], [("x y", _text(0))])}, "name"),
        ({CUSTOM: ([], [("x", _text(0)), ("x", _text(0))])}, "two of one name"),
        ({CUSTOM: ([], [("w", (Nodetype.BASE, ("wstring", 0)))])}, "not read here"),
    ],
)
def test_types_that_are_not_used_are_named(types: Any, said: str) -> None:
    digest = hash_of(description(types, CUSTOM))
    with pytest.raises(DescriptionError, match=said):
        read_reply(reply(types, CUSTOM), CUSTOM, digest)


def test_types_that_grow_without_bound_are_refused() -> None:
    """Ten members of ten members … are many values in a short description."""
    names = [f"a_msgs/msg/T{level}" for level in range(9)]
    types: Any = {names[-1]: ([], [("x", _text(0))])}
    for level in range(8):
        types[names[level]] = ([], [(f"m{n}", (Nodetype.NAME, names[level + 1])) for n in range(10)])
    with pytest.raises(DescriptionError, match="values"):
        read_reply(reply(types, names[0]), names[0], hash_of(description(types, names[0])))


def test_a_member_named_like_a_word_of_python_can_be_coded_but_not_decoded() -> None:
    types: Any = {CUSTOM: ([], [("from", _text(0))])}
    described = read_reply(reply(types, CUSTOM), CUSTOM, hash_of(description(types, CUSTOM)))
    with pytest.raises(DescriptionError, match="Python"):
        described.store()


@given(st.integers(0, 1 << 32), st.data())
def test_whatever_a_node_replies_only_a_description_error_is_raised(seed: int, data: st.DataObject) -> None:
    payload = bytearray(reply(types_of(CUSTOM_TEXT), CUSTOM))
    rng = random.Random(seed)
    for _ in range(data.draw(st.integers(1, 4))):
        payload[rng.randrange(len(payload))] = rng.randrange(256)
    try:
        described = read_reply(bytes(payload), CUSTOM, hash_of_text(CUSTOM_TEXT))
    except DescriptionError:
        return
    assert described.types == read_reply(reply(types_of(CUSTOM_TEXT), CUSTOM), CUSTOM, described.digest).types


@given(st.binary(max_size=300))
def test_arbitrary_bytes_only_raise_a_description_error(payload: bytes) -> None:
    with pytest.raises(DescriptionError):
        read_reply(payload, CUSTOM, hash_of_text(CUSTOM_TEXT))


def test_a_request_names_type_and_hash_and_wants_no_sources() -> None:
    digest = "RIHS01_" + "0" * 64
    texts = [text.encode() + b"\0" for text in (CUSTOM, digest)]
    first = len(texts[0]).to_bytes(4, "little") + texts[0]
    body = first + bytes(-len(first) % 4) + len(texts[1]).to_bytes(4, "little") + texts[1]
    assert request(CUSTOM, digest).rstrip(b"\0") == (b"\0\1\0\0" + body).rstrip(b"\0")
    assert len(request(CUSTOM, digest)) > 4 + len(body)
