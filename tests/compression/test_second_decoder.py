"""Coded messages, read by our codec and by the second decoder, which was made from the page alone."""

from __future__ import annotations

import json
import random
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuzz.compression import TYPES
from gr_ros2.compression import LinkCodec
from gr_ros2.compression.ans import _LENGTHS
from gr_ros2.compression.floats import class_table
from gr_ros2.compression.schema import tree_of
from gr_ros2.core.errors import CodecError
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.settings.registry import Registry, Topic
from tests.compression import second_decoder as second
from tests.compression.support import STORE, Writer
from tests.recordings import HUSKY, SIMULATED, Drive

VECTORS: dict[str, Any] = json.loads((Path(__file__).parents[1] / "vectors" / "coding.json").read_text())
MAX_SIZE = 1 << 20
STRUCTURED = [name for name in sorted(STORE.fielddefs) if tree_of(STORE.fielddefs, name) is not None]


@cache
def codec(type_name: str, announced: str = "") -> LinkCodec:
    topic = Topic(0, "topic", type_name)
    made = LinkCodec(Registry([topic]), max_size=MAX_SIZE)
    return made.of([topic], {0: announced}) if announced else made


def ours(coded: bytes, type_name: str, announced: str = "") -> bytes | str:
    """The message, or why there is none."""
    try:
        return codec(type_name, announced).decode(0, coded)
    except CodecError as error:
        return error.fate


def theirs(coded: bytes, type_name: str, announced: str = "") -> bytes | str:
    try:
        return second.decode(coded, type_name, announced, MAX_SIZE)
    except second.Refused as error:
        return str(error)


def named(kind: str) -> Any:
    return pytest.mark.parametrize("case", VECTORS[kind], ids=lambda case: case["name"])


def test_models() -> None:
    assert VECTORS["models"] == second.SHARES
    for letter in second.CLASSES:
        assert [share for _, share in class_table(letter).codes] == VECTORS["models"][letter]
    assert [share for _, share in _LENGTHS.codes] == VECTORS["models"]["LENGTHS"]


@named("messages")
def test_messages(case: dict[str, str]) -> None:
    coded, told = bytes.fromhex(case["coded"]), (case["type"], case["announced"])
    assert ours(coded, *told) == theirs(coded, *told) == bytes.fromhex(case["decoded"])


@named("refused")
def test_codes_to_refuse(case: dict[str, str]) -> None:
    coded, told = bytes.fromhex(case["coded"]), (case["type"], case["announced"])
    assert ours(coded, *told) == theirs(coded, *told) == case["error"]


@pytest.mark.parametrize(
    "drive",
    [
        SIMULATED,
        pytest.param(HUSKY, marks=pytest.mark.skipif(not HUSKY.path.is_dir(), reason=f"{HUSKY.path} is not here")),
    ],
    ids=lambda drive: drive.path.name,
)
def test_recordings(drive: Drive) -> None:
    """By the shipped sets, and by the structure alone, as of a type that the receiver does not know."""
    for name, type_name in drive.topics.items():
        sender = LinkCodec([Topic(0, name, type_name)])
        learned = LinkCodec([Topic(0, name, "my_msgs/msg/Thing")])
        types = {**STORE.fielddefs, "my_msgs/msg/Thing": STORE.fielddefs[type_name]}
        learned.learn("my_msgs/msg/Thing", types)
        found = 0
        for message in read_bag(drive.path, [f"/robot_1/{name}"]):
            clean = sender.canonical(0, message.payload)
            assert second.decode(sender.encode(0, message.payload), type_name) == clean
            coded = learned.encode(0, message.payload)
            assert coded[0] >> 4 == 14
            assert second.decode(coded, "my_msgs/msg/Thing", learned.announcement(0)) == clean
            found += 1
        assert found > 100


@given(st.sampled_from(TYPES), st.sampled_from(VECTORS["messages"]), st.integers(0, 1 << 32), st.data())
@settings(max_examples=150, deadline=None)
def test_whatever_the_bytes_both_say_the_same(type_name: str, case: dict[str, str], seed: int, data: Any) -> None:
    rng = random.Random(seed)
    if rng.randrange(2) and type_name in STORE.fielddefs:
        payload, _ = Writer(rng, rng.choice("<>")).message(type_name, rng.randrange(4))
        coded, announced = bytearray(codec(type_name).encode(0, payload)), ""
    else:
        coded, type_name, announced = bytearray.fromhex(case["coded"]), case["type"], case["announced"]
    for _ in range(data.draw(st.integers(0, 4))):
        at = rng.randrange(len(coded) + 1)
        new = data.draw(st.binary(max_size=3))
        coded[at : at + rng.choice((0, len(new)))] = new
    assert ours(bytes(coded), type_name, announced) == theirs(bytes(coded), type_name, announced)


@given(st.sampled_from(STRUCTURED), st.integers(0, 1 << 32), st.text("dfqQiIhHBsTR()*0123456789", max_size=40))
@settings(max_examples=100, deadline=None)
def test_structures(type_name: str, seed: int, text: str) -> None:
    """Those of real types, and any text."""
    payload, clean = Writer(random.Random(seed)).message(type_name)
    learned = LinkCodec([Topic(0, "topic", "my_msgs/msg/Thing")], max_size=MAX_SIZE)
    learned.learn("my_msgs/msg/Thing", {**STORE.fielddefs, "my_msgs/msg/Thing": STORE.fielddefs[type_name]})
    coded = learned.encode(0, payload)
    if coded[0] >> 4 == 14:
        assert theirs(coded, "my_msgs/msg/Thing", learned.announcement(0)) == clean
    any_text = b"\xe2" + second.crc16(text.encode()).to_bytes(2, "big") + random.Random(seed).randbytes(30)
    told = ("my_msgs/msg/Thing", f"auto {text}")
    assert ours(any_text, *told) == theirs(any_text, *told)


def test_a_numbered_message_is_what_it_is_without_its_number() -> None:
    codec = LinkCodec([Topic(0, "mode", "std_msgs/msg/String")])
    message = bytes((0, 1, 0, 0, 5, 0, 0, 0)) + b"auto\0"
    coded = codec.encode(0, message)
    numbered = [codec.numbered(coded, number) for number in (0, 1, 255)]
    assert len(set(numbered)) == 3
    for one in numbered:
        assert codec.decode(0, one) == second.decode(one, "std_msgs/msg/String") == message
        with pytest.raises(CodecError, match="unknown codec 6"):
            codec.decode(0, codec.numbered(one, 0))
