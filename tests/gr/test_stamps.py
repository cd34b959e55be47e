"""Stamps of other robots' messages on this robot's clock."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.gr.members import decoded
from gr_ros2.gr.stamps import MovedStamps
from gr_ros2.observe.positions import humble_types

STORE = humble_types()
TYPE = STORE.types
POINT, TF, TEXT = "geometry_msgs/msg/PointStamped", "tf2_msgs/msg/TFMessage", "std_msgs/msg/String"


def header(sec: int, nanosec: int) -> Any:
    return TYPE["std_msgs/msg/Header"](
        stamp=TYPE["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec), frame_id="map"
    )


def point(sec: int, nanosec: int, *, little_endian: bool = True) -> bytes:
    place = TYPE["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0)
    message = TYPE[POINT](header=header(sec, nanosec), point=place)
    return bytes(STORE.serialize_cdr(message, POINT, little_endian=little_endian))


def transforms(*stamps: tuple[int, int]) -> bytes:
    zero = TYPE["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    turn = TYPE["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    made = [
        TYPE["geometry_msgs/msg/TransformStamped"](
            header=header(*stamp),
            child_frame_id="a",
            transform=TYPE["geometry_msgs/msg/Transform"](translation=zero, rotation=turn),
        )
        for stamp in stamps
    ]
    return bytes(STORE.serialize_cdr(TYPE[TF](transforms=made), TF))


@pytest.mark.parametrize("little_endian", [True, False])
def test_a_stamp_is_moved_and_nothing_else(little_endian: bool) -> None:
    moved = MovedStamps(Counter()).apply(POINT, point(100, 900_000_000, little_endian=little_endian), 0.25)
    assert moved == point(101, 150_000_000, little_endian=little_endian)
    assert MovedStamps(Counter()).apply(POINT, point(100, 100_000_000), -0.25) == point(99, 850_000_000)


def test_stamps_inside_of_sequences_are_moved_too() -> None:
    assert MovedStamps(Counter()).apply(TF, transforms((5, 0), (6, 1)), 2.0) == transforms((7, 0), (8, 1))


def test_unset_stamps_and_messages_without_any_pass_unchanged() -> None:
    counters: Counter[str] = Counter()
    moved = MovedStamps(counters)
    text = bytes(STORE.serialize_cdr(TYPE[TEXT](data="a"), TEXT))
    for type_name, payload in ((POINT, point(0, 0)), (TEXT, text), (POINT, b"\0\1\0\0junk"), ("a_msgs/msg/A", b"")):
        assert moved.apply(type_name, payload, 1.0) == payload
    assert counters == {"stamp_damaged": 1, "stamp_unknown_type": 1}
    assert decoded(STORE, POINT, b"\0\1\0\0junk") is None
