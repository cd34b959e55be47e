"""MCAP files of ROS 2 bags: written with both times of a message, and read even if the index is incomplete.

Invariants: what rosbag2 calls the receive and the send timestamp are MCAP's ``log_time`` and ``publish_time``; rosbags
alone writes the first one into both. A message that is missing in the index is read too; a schema in a language that
ROS does not use is ignored.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapReader, McapWriter, Schema

_LANGUAGES = frozenset({"ros2msg", "ros2idl", "omgidl"})
_PUBLISH_TIME_AT = 1 + 8 + 2 + 4 + 8
"""Bytes of a message record before its publish_time: opcode, length, channel, sequence, log_time."""


class _Schemas(dict[int, Schema]):
    """Schemas by id; rosbags raises an error for an unknown language (rosbag2 writes ``unknown``)."""

    def __setitem__(self, number: int, schema: Schema) -> None:
        super().__setitem__(number, schema if schema.encoding in _LANGUAGES else schema._replace(encoding="", data=""))


class McapStorage(McapReader):
    """rosbags' reader, extended to files whose chunks have no message index, which rosbags would skip."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.schemas = _Schemas()

    def open(self) -> None:
        """Open and read the index."""
        super().open()
        if any(not chunk.message_index_offsets for chunk in self.chunks):
            self.chunks.clear()  # without a list of chunks rosbags reads the whole file


class TwoTimes(McapWriter):
    """rosbags' MCAP file, with a publish_time of its own for every message."""

    def __init__(self, path: Path, compression: Any) -> None:
        super().__init__(path, compression)
        self.sent_ns: int | None = None
        """When the next message was sent, ns since 1970; None = when it was received."""
        self._sent: list[tuple[int, int]] = []

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        sent_ns = timestamp if self.sent_ns is None else self.sent_ns
        self._sent.append((self.chunk.bio.tell() + _PUBLISH_TIME_AT, sent_ns))
        super().write(connection, timestamp, data)

    def close_chunk(self) -> None:
        for place, sent_ns in self._sent:
            self.chunk.bio.seek(place)
            self.chunk.bio.write(sent_ns.to_bytes(8, "little"))
        self._sent.clear()
        self.chunk.bio.seek(0, os.SEEK_END)
        super().close_chunk()


class BagWriter(Writer):
    """rosbags' writer, with :class:`TwoTimes` for MCAP."""

    STORAGE_PLUGINS = {**Writer.STORAGE_PLUGINS, StoragePlugin.MCAP: TwoTimes}  # noqa: RUF012
