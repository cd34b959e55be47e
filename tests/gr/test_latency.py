"""LatencySummary from stamps: both byte orders, types without one, a bounded window."""

from __future__ import annotations

import struct

import pytest

from gr_ros2.gr.latency import WINDOW, LatencyWindow, has_header, leading_time


@pytest.mark.parametrize(("order", "mark"), [("<", 1), (">", 0)])
def test_a_stamp_in_either_byte_order(order: str, mark: int) -> None:
    payload = bytes([0, mark, 0, 0]) + struct.pack(f"{order}iI", 1_700_000_000, 250_000_000) + bytes(20)
    assert leading_time(payload) == 1_700_000_000.25


@pytest.mark.parametrize("payload", [b"", bytes(11), b"\0\1\0\0" + bytes(8), b"\1\1\0\0" + b"\1" * 8])
def test_no_stamp_no_time(payload: bytes) -> None:
    assert leading_time(payload) is None


@pytest.mark.parametrize(
    ("type_name", "has"),
    [
        ("nav_msgs/msg/Odometry", True),
        ("sensor_msgs/msg/LaserScan", True),
        ("geometry_msgs/msg/Twist", False),
        ("rosgraph_msgs/msg/Clock", False),
        ("std_msgs/msg/Empty", False),
        ("tf2_msgs/msg/TFMessage", False),
        ("my_msgs/msg/Custom", False),
    ],
)
def test_which_types_have_a_stamp(type_name: str, has: bool) -> None:
    assert has_header(type_name) is has


def test_percentiles_and_negative_values() -> None:
    window = LatencyWindow()
    assert window.summary().p50 is None
    for value in range(1, 101):
        window.add(value)
    window.add(-1.0)
    summary = window.summary()
    assert (summary.p50, summary.p99, summary.max) == (50, 99, 100)
    assert (summary.measured, summary.negative) == (101, 1)


def test_a_copy_stays_as_it_was() -> None:
    window = LatencyWindow()
    window.add(-2.0)
    copied = window.copy()
    window.add(3.0)
    assert copied.summary() == (-2.0, -2.0, -2.0, -2.0, 1, 1)
    assert window.summary().measured == 2


def test_the_window_is_bounded_and_the_count_is_not() -> None:
    window = LatencyWindow()
    for value in range(WINDOW + 10):
        window.add(value)
    assert window.summary().measured == WINDOW + 10
    assert window.summary().p50 == pytest.approx(WINDOW / 2 + 10, abs=1)
