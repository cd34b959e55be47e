"""Structures: a text from which a receiver codes exactly as the sender does by the definition."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import get_types_from_msg

from gr_ros2.compression.dictionary import shipped
from gr_ros2.compression.fields import FieldsCodec
from gr_ros2.compression.schema import Composite, tree_of
from gr_ros2.compression.structure import MAX_BYTES, MAX_DEPTH, read_structure, write_structure
from gr_ros2.compression.zstd_frames import Zstd
from gr_ros2.core.errors import CodecError
from tests.compression.support import STORE, Writer


def tree(type_name: str) -> Composite | None:
    return tree_of(STORE.fielddefs, type_name)


TYPES = sorted(name for name in STORE.fielddefs if tree(name) is not None)


def fields(made: Composite) -> FieldsCodec:
    return FieldsCodec(made, shipped().model(""), Zstd())


def test_the_structure_of_a_known_type_is_short() -> None:
    odometry, markers = tree("nav_msgs/msg/Odometry"), tree("visualization_msgs/msg/MarkerArray")
    assert odometry is not None and markers is not None
    assert write_structure(odometry) == "TssdddR36ddddddd36d"
    assert write_structure(markers) == "*(TssiiidddRdddffffTB*(ddd)*(ffff)sTss*B*(ff)sss*BB)"


def test_a_sequence_of_messages_with_one_member_is_no_sequence_of_its_member() -> None:
    texts = {
        "a_msgs/msg/One": "float64 x\n",
        "a_msgs/msg/Two": "a_msgs/One[] many\na_msgs/One[3] few\nfloat64[] plain\n",
    }
    types = {name: members for kind, text in texts.items() for name, members in get_types_from_msg(text, kind).items()}
    made = tree_of(types, "a_msgs/msg/Two")
    assert made is not None and write_structure(made) == "*(d)3(d)*d"


@given(st.sampled_from(TYPES), st.integers(0, 1 << 32), st.sampled_from("<>"))
@settings(max_examples=150, deadline=None)
def test_both_ends_code_alike(type_name: str, seed: int, order: str) -> None:
    known = tree(type_name)
    assert known is not None
    announced = read_structure(write_structure(known))
    assert write_structure(announced) == write_structure(known)
    payload, clean = Writer(random.Random(seed), order).message(type_name)
    sender, receiver = fields(known), fields(announced)
    coded = sender.encode(payload)
    assert coded == receiver.encode(payload)
    if coded is not None:
        assert receiver.decode(*coded, 1 << 20) == clean


@pytest.mark.parametrize(
    "text",
    ["", "x", "3", "*", "()", "(d)", "3()", "*(d", "*(d))", ")", "d)", "03d", "0d", "*3d", "3*d", "é", "d d", "-1d",
     f"{MAX_BYTES}d", "*(" * (MAX_DEPTH + 1) + "d" + ")" * (MAX_DEPTH + 1)],
)  # fmt: skip
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(CodecError, match="structure"):
        read_structure(text)


@given(st.text("dfqQiIhHBsTR()*0123456789", max_size=255), st.binary(max_size=200), st.booleans())
@settings(max_examples=200, deadline=None)
def test_whatever_is_announced_ends_in_a_message_or_a_codec_error(text: str, coded: bytes, more: bool) -> None:
    try:
        made = read_structure(text)
        assert len(fields(made).decode(coded, more, 5000)) <= 5000
    except CodecError:
        return


def test_a_time_that_is_defined_in_another_way_is_not_used() -> None:
    types = {**STORE.fielddefs, **get_types_from_msg("float64 sec\n", "builtin_interfaces/msg/Time")}
    assert tree_of(types, "std_msgs/msg/Header") is None
    assert tree_of(types, "no_msgs/msg/Such") is None
