"""What a coded message may stand for grows with its bytes, and senders keep to it."""

from __future__ import annotations

import struct
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.compression import bounds
from gr_ros2.compression.ans import push_natural, to_bytes
from gr_ros2.compression.fields import _REMEMBERED
from gr_ros2.compression.link_codec import FIELDS, FIELDS_AND_MORE, ZSTD
from gr_ros2.compression.prepared import Prepared
from gr_ros2.compression.schema import Types
from gr_ros2.compression.zstd_frames import Zstd, read_varint
from gr_ros2.core.errors import DamagedError
from tests.compression.support import codec_for, learn

HEADER = b"\0\1\0\0"
LARGE = 1_000_000


JOINTS = "sensor_msgs/msg/JointState"


def joints(count: int) -> bytes:
    """A JointState of joints without names."""
    names = struct.pack("<I4x", 1) * count
    return HEADER + bytes(8) + struct.pack("<I4xI", 1, count) + names[: 8 * count - 3 * bool(count)] + bytes(15)


@given(st.integers(0, 1 << 21), st.integers(0, 4000))
def test_the_least_length_is_the_least(size: int, items: int) -> None:
    length = bounds.least(size, items)
    assert bounds.largest(length) >= size
    assert bounds.most_items(length) >= items
    if length:
        assert bounds.largest(length - 1) < size or bounds.most_items(length - 1) < items


@pytest.mark.parametrize("count", [1, 20, 100, 400])
def test_many_parts_need_many_bytes(count: int) -> None:
    payload = joints(count)
    mine = learn([(JOINTS, payload)] * 20, "mine", zstd_size=0)  # it has all names as one template
    codec = codec_for(JOINTS, mine)
    coded = codec.encode(0, payload)
    assert coded[0] & 15 == FIELDS
    assert codec.decode(0, coded) == payload
    assert len(coded) >= bounds.least(len(payload), 2 * count)
    if count >= 100:
        number = coded[1:].lstrip(b"\0")
        assert len(number) < 20
        for receiver in (codec, codec_for(JOINTS, mine)):  # whatever it remembers
            with pytest.raises(DamagedError, match="too many parts"):
                receiver.decode(0, coded[:1] + number)


@pytest.mark.parametrize("type_name", ["std_msgs/ByteMultiArray", "my_msgs/Thing"])
def test_a_large_message_needs_many_bytes(type_name: str) -> None:
    codec = codec_for(type_name)
    payload = HEADER + bytes(8) + struct.pack("<I", LARGE) + bytes(LARGE)
    coded = codec.encode(0, payload)
    assert coded[0] & 15 == (FIELDS_AND_MORE if type_name.startswith("std") else ZSTD)
    assert bounds.least(len(payload)) <= len(coded) < 300
    assert codec.decode(0, coded) == payload
    with pytest.raises(DamagedError, match="claims 1000016 bytes, at most"):
        codec.decode(0, b"\x01" + Zstd().compress(payload))


@pytest.mark.parametrize("size", [0, 100, 300_000])
@pytest.mark.parametrize("least", [0, 1, 10, 50, 999, 1000])
@pytest.mark.parametrize("sized", [True, False])
def test_empty_blocks_are_nothing(size: int, least: int, sized: bool) -> None:
    data = bytes(range(256)) * (size // 256) + bytes(size % 256)
    coded = Zstd().compress(data, sized, least)
    assert least <= len(coded) <= max(least + 5, len(Zstd().compress(data, sized)) + 3)
    assert Zstd().decompress(coded, size, None if sized else size) == data
    assert (read_varint(coded)[0] & 1 == 0) or len(coded) == len(Zstd().compress(data, sized))


@pytest.mark.parametrize("type_name", ["geometry_msgs/PoseArray", JOINTS, "tf2_msgs/TFMessage"])
def test_nothing_is_prepared_that_few_bytes_may_not_stand_for(type_name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but the length of a sequence, in a few bytes: all that follows pops off zero for free."""
    prepared: list[int] = []
    init = Prepared.__init__

    def counted(self: Prepared, *arguments: object) -> None:
        init(self, *arguments)  # type: ignore[arg-type]
        prepared.append(len(self.plan.items))

    codec = codec_for(type_name)
    monkeypatch.setattr(Prepared, "__init__", counted)
    for count in (1, 2, 5, 30, 100, 300, 1000, 30_000, 1 << 40):
        number = to_bytes(push_natural(0, count) << 12)  # the likeliest head is 0
        with suppress(DamagedError):
            codec.decode(0, b"\x12" + number)
    assert prepared
    assert max(prepared) <= 20 + bounds.most_items(10)


def test_the_oldest_is_forgotten_and_not_all() -> None:
    codec = codec_for("std_msgs/String")
    fields = codec._topics[0]._choices[0].fields
    assert fields is not None
    for number in range(3 * _REMEMBERED):
        text = b"word_%d\0" % number
        message = HEADER + struct.pack("<I", len(text)) + text
        assert codec.decode(0, codec.encode(0, message)) == message
        assert len(fields._values) == min(_REMEMBERED, number + 1)


def test_an_array_of_no_elements_is_not_taken_apart() -> None:
    """Else any number of them would fit into no bytes."""
    types = Types({"a/msg/None": "int32[0] none", "a/msg/Many": "None[] many", "a/msg/Some": "int32[1] some"})
    assert types.tree("a/msg/None") is None
    assert types.tree("a/msg/Many") is None
    assert types.tree("a/msg/Some") is not None
