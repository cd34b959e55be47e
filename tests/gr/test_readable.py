"""Debug lines say what is in a packet, and that something is none."""

from __future__ import annotations

import io
import logging
import sys

import pytest

from gr_ros2.core.errors import LengthError
from gr_ros2.gr.readable import debug_logger, describe
from gr_ros2.link import PacketId, Received, Rejected, SentPacket
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v0 import EntryV0, PacketV0

IDENTITY = PacketId(1, 0, 7, 0)
REGISTRY = Registry.from_rows({"odom": "nav_msgs/Odometry"})


def test_header_and_entries() -> None:
    packet = PacketV0(1, 255, 7, 1, (EntryV0(0, 9, 2, 5, b"abc"), EntryV0(3, 1, 0, 1, b"x")), qos=1)
    line = describe(Received(b"", packet, *IDENTITY), REGISTRY)
    assert line == describe(SentPacket(b"", packet, *IDENTITY, (), 0.0), REGISTRY)
    assert line == "v0 qos=latency flags=- src=1 dst=255 seq=7 hop=1 entries=2: 0:odom#9[2/5]=3B 3:?#1[0/1]=1B"


def test_what_is_no_packet() -> None:
    assert describe(Rejected(b"", LengthError("10 bytes")), REGISTRY) == "refused (length): 10 bytes"


def test_lines_appear_on_standard_output_where_nothing_else_takes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(logging.root, "handlers", [])
    name = "gr_ros2_test.debug"
    debug_logger(name, False).debug("hidden")
    for _ in range(2):
        debug_logger(name, True).debug("shown")
    assert out.getvalue().count("shown") == 2
    assert "hidden" not in out.getvalue()
