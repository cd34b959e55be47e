"""Quantised fields stay within their bound; all else stays as it is."""

from __future__ import annotations

import math
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.compression.quantize import LARGEST, parse_steps
from gr_ros2.core.errors import ConfigError
from tests.compression.support import STORE, Writer, codec_for, simulated

POSE = "geometry_msgs/msg/Pose"
BOUND = 0.5 + 2.0**-20


def poses(values: list[float], order: str) -> bytes:
    return (b"\0\1\0\0" if order == "<" else bytes(4)) + struct.pack(f"{order}7d", *values)


@given(st.lists(st.floats(), min_size=7, max_size=7), st.integers(0, 6), st.sampled_from("<>"))
@settings(max_examples=100, deadline=None)
def test_doubles_stay_within_half_a_step(values: list[float], decimals: int, order: str) -> None:
    step = 10.0**-decimals
    codec = codec_for(POSE, quantize=f"position={step:f} orientation.z={step:f}")
    out = codec.decode(0, codec.encode(0, poses(values, order)))
    back = struct.unpack(f"{order}7d", out[4:])
    for place, (before, after) in enumerate(zip(values, back, strict=True)):
        if place in (0, 1, 2, 5) and abs(before) < LARGEST * step * 0.999:
            assert abs(after - before) <= step * BOUND
        else:
            assert struct.pack("d", before) == struct.pack("d", after) or abs(after - before) <= step * BOUND
        if place in (3, 4, 6):
            assert struct.pack("d", before) == struct.pack("d", after)


@given(st.lists(st.floats(width=32), min_size=1, max_size=60), st.integers(0, 4), st.sampled_from("<>"))
@settings(max_examples=80, deadline=None)
def test_ranges_stay_within_half_a_step(values: list[float], decimals: int, order: str) -> None:
    step = 10.0**-decimals
    codec = codec_for("sensor_msgs/LaserScan", quantize=f"ranges={step:f}")
    head = b"\0\1\0\0" if order == "<" else bytes(4)
    count = struct.pack(order + "I", len(values))
    payload = head + bytes(8) + struct.pack(order + "I", 1) + bytes(4) + bytes(28) + count
    payload += struct.pack(f"{order}{len(values)}f", *values) + bytes(4)
    out = codec.decode(0, codec.encode(0, payload))
    assert len(out) == len(payload)
    back = struct.unpack_from(f"{order}{len(values)}f", out, 52)
    for before, after in zip(values, back, strict=True):
        if math.isfinite(before) and abs(before) < LARGEST * step * 0.999:
            assert abs(after - before) <= step * BOUND + math.ulp(abs(after)) * 2.0**28
        else:
            assert struct.pack("f", before) == struct.pack("f", after) or abs(after - before) <= step


def test_everything_not_named_stays() -> None:
    steps = "position=0.001"
    for seed in range(50):
        payload, clean = Writer(random.Random(seed)).message(POSE)
        out = codec_for(POSE, quantize=steps).decode(0, codec_for(POSE, quantize=steps).encode(0, payload))
        assert out[:4] + out[28:] == clean[:4] + clean[28:]
    odometry = simulated("odom", 1.0)
    assert odometry
    for payload in odometry:
        codec = codec_for("nav_msgs/Odometry", quantize="pose.pose.position=0.001")
        before, after = (
            STORE.deserialize_cdr(p, "nav_msgs/msg/Odometry")
            for p in (payload, codec.decode(0, codec.encode(0, payload)))
        )
        before.pose.pose.position = after.pose.pose.position = None  # type: ignore[attr-defined]
        assert str(before) == str(after)


def test_it_pays() -> None:
    odometry = simulated("odom", 2.0)
    steps = "pose.pose.position=0.001 pose.pose.orientation=0.0001 twist.twist=0.001"
    codec = codec_for("nav_msgs/Odometry", quantize=steps)
    assert max(len(codec.encode(0, payload)) for payload in odometry) <= 32
    scan = codec_for("sensor_msgs/LaserScan", quantize="ranges=0.01")
    assert max(len(scan.encode(0, payload)) for payload in simulated("scan", 2.0)) <= 420


def test_steps_are_read() -> None:
    assert parse_steps("a.b=0.001, c=1 d[].e=1e-6;f=0.1") == {"a.b": 3, "c": 0, "d[].e": 6, "f": 1}
    assert parse_steps("") == {}


@pytest.mark.parametrize("text", ["a", "a=", "a=0.005", "a=2", "=0.1", "a=x", "a=1e-7"])
def test_a_wrong_step_is_named(text: str) -> None:
    with pytest.raises(ConfigError, match=r"quantize = .*path=step"):
        parse_steps(text)


def test_a_field_that_is_not_there_is_named() -> None:
    with pytest.raises(ConfigError, match=r"quantize = 'pose.position'.*nav_msgs/msg/Odometry.*pose.pose.position.x"):
        codec_for("nav_msgs/Odometry", quantize="pose.position=0.001")
    with pytest.raises(ConfigError, match="my_msgs/msg/Thing"):
        codec_for("my_msgs/Thing", quantize="pose.position=0.001")
