"""Positions out of CDR."""

from __future__ import annotations

import struct
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype

from gr_ros2.observe.positions import _POSITION_AT, FARTHEST_M, humble_types, position_reader


def _make(type_name: str, point: Any) -> Any:
    """A message of a type with every field zero and each point or translation in it the given one."""
    store = humble_types()
    values: dict[str, Any] = {}
    for name, node in store.fielddefs[type_name][1]:
        kind, detail = cast("tuple[Nodetype, Any]", node)
        if kind == Nodetype.NAME:
            values[name] = point if name in ("position", "point") else _make(detail, point)
        elif kind == Nodetype.BASE:
            values[name] = "" if detail[0] == "string" else 0
        else:
            values[name] = np.zeros(detail[1])
    if type_name in ("geometry_msgs/msg/Point", "geometry_msgs/msg/Vector3"):
        values |= {"x": 1.5, "y": -2.5, "z": 9.0}
    return store.types[type_name](**values)


@pytest.mark.parametrize("type_name", sorted(_POSITION_AT))
def test_every_type_gives_its_position(type_name: str) -> None:
    store = humble_types()
    point = store.types["geometry_msgs/msg/Point"](1.5, -2.5, 9.0)
    read = position_reader(type_name)
    assert read is not None
    payload = bytes(store.serialize_cdr(_make(type_name, point), type_name))
    assert read(payload) == (1.5, -2.5)
    assert read(payload + b"\0\0\0") == (1.5, -2.5)  # DDS pads


def test_types_without_a_position() -> None:
    assert position_reader("sensor_msgs/msg/Imu") is None
    assert position_reader("my_msgs/msg/Thing") is None


@given(st.binary(max_size=800), st.booleans())
def test_foreign_bytes_have_no_position(payload: bytes, framed: bool) -> None:
    read = position_reader("nav_msgs/msg/Odometry")
    assert read is not None
    found = read(b"\0\1\0\0" + payload if framed else payload)
    assert found is None or len(found) == 2


@given(st.binary(min_size=1, max_size=8))
def test_a_frame_id_of_foreign_bytes(frame_id: bytes) -> None:
    read = position_reader("nav_msgs/msg/Odometry")
    assert read is not None
    text = frame_id + b"\0"
    payload = b"\0\1\0\0" + bytes(8) + len(text).to_bytes(4, "little") + text + bytes(4) + b"\1\0\0\0\0" + bytes(720)
    found = read(payload)
    assert found is None or len(found) == 2


@pytest.mark.parametrize("odd", [float("nan"), float("inf"), -float("inf"), 1e200, -1.1 * FARTHEST_M])
def test_what_is_no_place_for_a_robot_is_no_position(odd: float) -> None:
    read = position_reader("geometry_msgs/msg/Point")
    assert read is not None
    for x, y in ((odd, 0.0), (0.0, odd), (odd, odd)):
        assert read(b"\0\1\0\0" + struct.pack("<3d", x, y, 0.0)) is None
    assert read(b"\0\1\0\0" + struct.pack("<3d", FARTHEST_M, -FARTHEST_M, odd)) == (FARTHEST_M, -FARTHEST_M)
