"""Messages of every type, with anything in them, come back exactly but for zeros in alignment gaps."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.compression.schema import Types, shape_of
from gr_ros2_lab.sim.sensors import TYPES as SIMULATED
from tests.compression.support import STORE, Writer, codec_for, simulated

EVERY_TYPE = sorted(name for name in STORE.fielddefs if not any("wstring" in str(d) for d in STORE.fielddefs[name][1]))
COMMON = (
    "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/JointState",
    "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/NavSatFix", "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path",
    "sensor_msgs/msg/PointCloud2", "std_msgs/msg/String", "std_msgs/msg/Float64MultiArray",
    "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/Twist", "sensor_msgs/msg/BatteryState",
    "diagnostic_msgs/msg/DiagnosticArray", "visualization_msgs/msg/MarkerArray",
)  # fmt: skip


@pytest.mark.parametrize("type_name", EVERY_TYPE)
def test_every_type_comes_back(type_name: str) -> None:
    codec = codec_for(type_name)
    for seed in range(3):
        for order in "<>":
            tail = seed
            payload, clean = Writer(random.Random(seed), order).message(type_name, tail)
            coded = codec.encode(0, payload)
            assert len(coded) <= len(payload) + 1
            out = codec.decode(0, coded)
            assert out == (payload if coded[0] == 0 else clean)


@pytest.mark.parametrize("mode", ["fields", "zstd", "auto"])
@given(st.sampled_from(COMMON), st.integers(0, 1 << 32), st.sampled_from("<>"), st.integers(0, 3))
@settings(max_examples=60, deadline=None)
def test_any_message_comes_back(mode: str, type_name: str, seed: int, order: str, tail: int) -> None:
    payload, clean = Writer(random.Random(seed), order).message(type_name, tail)
    codec = codec_for(type_name, codec=mode)
    coded = codec.encode(0, payload)
    assert len(coded) <= len(payload) + 1
    assert codec.decode(0, coded) in ((payload, clean) if coded[0] == 0 else (clean,))
    assert codec_for(type_name).decode(0, coded) == codec.decode(0, coded)


@given(st.sampled_from(COMMON), st.integers(0, 1 << 32), st.integers(0, 400), st.binary(max_size=3), st.data())
@settings(max_examples=60, deadline=None)
def test_a_payload_that_is_no_such_message_comes_back_as_it_is(
    type_name: str, seed: int, cut: int, more: bytes, data: st.DataObject
) -> None:
    payload, _ = Writer(random.Random(seed), garbage=False).message(type_name)
    changed = bytearray(payload[:cut] + more if data.draw(st.booleans()) else payload + more)
    for _ in range(data.draw(st.integers(0, 3))):
        if changed:
            changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    codec = codec_for(type_name)
    out = codec.decode(0, codec.encode(0, bytes(changed)))
    shape = shape_of(bytes(changed), _tree(type_name))
    if shape is None:
        assert out == changed
    else:  # still a message, perhaps with a changed gap
        assert len(out) == len(changed)
        assert all(a in (b, 0) for a, b in zip(out, changed, strict=True))


@given(st.sampled_from(COMMON), st.binary(max_size=300))
@settings(deadline=None)
def test_any_bytes_come_back(type_name: str, payload: bytes) -> None:
    codec = codec_for(type_name)
    assert len(codec.decode(0, codec.encode(0, payload))) == len(payload)


@pytest.mark.parametrize("topic", sorted(SIMULATED))
def test_the_simulator_comes_back_smaller(topic: str) -> None:
    codec = codec_for(SIMULATED[topic])
    payloads = simulated(topic, 3.0, map_rate=1.0)
    assert payloads
    for payload in payloads:
        coded = codec.encode(0, payload)
        assert coded[0] != 0
        assert len(coded) < len(payload)
        assert codec.decode(0, coded) == payload


def test_messages_decode_alone_and_in_any_order() -> None:
    payloads = simulated("odom", 3.0)
    coded = [codec_for("nav_msgs/Odometry").encode(0, payload) for payload in payloads]
    order = list(range(len(payloads)))
    random.Random(1).shuffle(order)
    receiver = codec_for("nav_msgs/Odometry")
    assert all(receiver.decode(0, coded[n]) == payloads[n] for n in order)


def test_a_message_of_many_strings_changes_nothing_for_the_next() -> None:
    codec = codec_for("geometry_msgs/PoseStamped")
    for n in range(400):  # more than are remembered
        text = f"frame_{n}".encode() + b"\0"
        head = b"\0\1\0\0" + bytes(8) + len(text).to_bytes(4, "little") + text
        payload = head + bytes(-(len(head) - 4) % 8) + bytes(56)
        assert codec.decode(0, codec.encode(0, payload)) == payload


def _tree(type_name: str):  # type: ignore[no-untyped-def]
    tree = Types().tree(type_name)
    assert tree is not None
    return tree
