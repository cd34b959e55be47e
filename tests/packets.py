"""Packets as bytes, for tests that carry them by hand."""

from __future__ import annotations

from gr_ros2.link import SentPacket


def data_of(sent: SentPacket | None) -> bytes | None:
    """The bytes of a packet, None for none."""
    return None if sent is None else sent.data
