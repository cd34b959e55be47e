"""MCAP files of ROS 2 bags: written with both times of a message and the hash of its type, and read without an index.

Invariants: what rosbag2 calls the receive and the send timestamp are MCAP's ``log_time`` and ``publish_time``; rosbags
alone writes the first one into both. A message that is missing in the index is read too, and so are all complete
records of a file that was never closed, those at the beginning of a chunk that is cut off included. A schema in a
language that ROS does not use is ignored, whatever its bytes, and so is the profile.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Generator
from contextlib import suppress
from io import SEEK_CUR, SEEK_SET, BufferedReader, BytesIO, RawIOBase
from pathlib import Path
from typing import Any, BinaryIO

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.interfaces import Connection
from rosbags.rosbag2 import storage_mcap
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import (
    ChunkInfo,
    McapReader,
    McapWriter,
    Schema,
    read_bytes,
    write_channel,
    write_string,
)

_LANGUAGES = frozenset({"ros2msg", "ros2idl", "omgidl"})
_MAGIC = b"\x89MCAP0\r\n"
_FOOTER = b"\x02" + (20).to_bytes(8, "little")
_END_LEN = len(_FOOTER) + 20 + len(_MAGIC)
_RECORD_LEN = 1 + 8
"""Bytes of a record before its content: opcode, length."""
_MESSAGE, _CHUNK = 0x05, 0x06
_PIECE, _SECTOR = 4096, 512
"""Bytes of a damaged chunk that are decompressed at a time, and that a disk stores together."""
_STAMPS = 1 << 64
"""Number of stamps."""
_DIGEST = "topic_type_hash"
"""Name of the RIHS01 hash of a topic's type, as rosbag2 writes it since Iron."""
_PUBLISH_TIME_AT = 1 + 8 + 2 + 4 + 8
"""Bytes of a message record before its publish_time: opcode, length, channel, sequence, log_time."""


def read_string(bio: BinaryIO) -> str:
    """A text. What is not of UTF-8 in it is replaced: the schemas of other topics, as of protobuf, may be binary."""
    return read_bytes(bio).decode(errors="replace")


storage_mcap.read_string = read_string


class _Schemas(dict[int, Schema]):
    """Schemas by id; rosbags raises an error for an unknown language (rosbag2 writes ``unknown``)."""

    def __setitem__(self, number: int, schema: Schema) -> None:
        super().__setitem__(number, schema if schema.encoding in _LANGUAGES else schema._replace(encoding="", data=""))


class McapStorage(McapReader):
    """rosbags' reader, extended to files without an index or without an end, and to stamps before 1970.

    :ivar broken: what is missing at the end of a file whose writer never closed it, '' where nothing is
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.schemas = _Schemas()
        self.broken = ""

    def _open(self) -> None:
        """Read the index, or the whole file where it has none that lists all messages."""
        assert self.bio is not None
        size = self.bio.seek(0, os.SEEK_END)
        self.bio.seek(max(size - _END_LEN, 0))
        end = self.bio.read()
        closed = end.startswith(_FOOTER) and end.endswith(_MAGIC)
        self.data_start, self.data_end = len(_MAGIC), size - _END_LEN if closed else self._stored(size)
        summary = int.from_bytes(end[len(_FOOTER) :][:8], "little") if closed else 0
        if summary:
            self.data_end = summary
            self.read_index()
        if not all(chunk.message_index_offsets for chunk in self.chunks) or not self.statistics:
            cut = self._find_chunks(closed=closed)
            if not closed:
                self.broken = "has no end, as after a crash: "
                self.broken += cut or f"{size - self.data_end} bytes of it cannot be read"
        if not self.statistics or not self.schemas:
            self.meta_scan()
        if self.broken and not self.connections:
            raise ReaderError(self.broken)
        assert self.statistics is not None
        counts = self.statistics.channel_message_counts
        self.connections = [
            c._replace(msgcount=counts.get(c.id, 0), digest=_digest(self.channels[c.id].metadata))
            for c in self.connections
        ]
        self.metadata = self.metadata._replace(message_count=self.statistics.message_count)
        # rosbags reads a chunk only if it counts a message of the topic in it.
        for chunk in self.chunks:
            if not chunk.message_index_offsets:
                chunk.channel_count.update(dict.fromkeys(self.channels, 1))

    def _stored(self, size: int) -> int:
        """Up to where a file without an end has been written: behind what a computer had stored when it went off, there
        may be zeros."""
        assert self.bio is not None
        end = size
        while end > 0:
            self.bio.seek(max(end - _PIECE, 0))
            piece = self.bio.read(min(end, _PIECE)).rstrip(b"\0")
            end = max(end - _PIECE, 0) + len(piece)
            if piece:
                break
        return min(-(-end // _SECTOR) * _SECTOR, size)

    def _find_chunks(self, *, closed: bool) -> str:
        """List the chunks, and find where the last complete record ends; returns what is said of a last chunk of which
        only a part is here."""
        assert self.bio is not None
        cut = -1
        self.chunks.clear()
        at = self.data_start
        while at + _RECORD_LEN <= self.data_end:
            self.bio.seek(at)
            kind, length = struct.unpack("<BQ", self.bio.read(_RECORD_LEN))
            if not kind or at + _RECORD_LEN + length > self.data_end:
                cut = at if kind == _CHUNK and not closed else cut
                break
            if kind == _CHUNK:
                first, last, size, _ = struct.unpack("<QQQI", self.bio.read(28))
                compression = read_string(self.bio)
                (packed,) = struct.unpack("<Q", self.bio.read(8))
                self.chunks.append(
                    ChunkInfo(first, last, at, _RECORD_LEN + length, {}, 0, compression, packed, size, {})
                )
            at += _RECORD_LEN + length
        end, self.data_end = self.data_end, at
        return "" if cut < 0 else self._mend(cut, end)

    def _mend(self, at: int, end: int) -> str:
        """Put a chunk of what can be read of a damaged one in its place; returns what is said of it, '' where nothing
        can be read.

        :param at: where it begins
        :param end: of the file
        """
        assert self.bio is not None
        self.bio.seek(at + _RECORD_LEN)
        content = BytesIO(self.bio.read(end - at - _RECORD_LEN))
        try:
            first, last, size, _ = struct.unpack("<QQQI", content.read(28))
            compression = read_string(content)
            (packed,) = struct.unpack("<Q", content.read(8))
        except (struct.error, ReaderError):
            return ""
        raw, messages = _complete(_decompressed(compression, content.read(min(packed, end))))
        if not messages:
            return ""
        head = struct.pack("<QQQI", first, last, len(raw), 0) + bytes(4) + struct.pack("<Q", len(raw))
        record = struct.pack("<BQ", _CHUNK, len(head) + len(raw)) + head + raw
        self.bio = BufferedReader(_Spliced(self.bio, at, record))
        self.chunks.append(ChunkInfo(first, last, at, len(record), {}, 0, "", len(raw), len(raw), {}))
        self.data_end = at + len(record)
        return f"{messages} messages of its last chunk are read ({len(raw)} of {size} bytes)"

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,  # noqa: ARG002 - a bag is read from its beginning to its end
        stop: int | None = None,  # noqa: ARG002
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """The messages in the order of their stamps; those of a file without chunks are sorted in memory if needed."""
        if self.chunks:
            found = super().messages(connections, 0, _STAMPS)
        else:
            found = self.messages_scan(connections, 0, _STAMPS)
            stamps = [stamp for _, stamp, _ in self.messages_scan(connections, 0, _STAMPS)]
            if stamps != sorted(stamps):
                found = (message for message in sorted(found, key=lambda message: message[1]))
        for connection, stamp, payload in found:
            # rosbag2 writes its signed stamps as unsigned numbers.
            yield connection, stamp - _STAMPS if stamp >= _STAMPS >> 1 else stamp, payload


class _Spliced(RawIOBase):
    """A file up to a place, and then other bytes."""

    def __init__(self, file: BinaryIO, end: int, then: bytes) -> None:
        self._file, self._end, self._then, self._at = file, end, then, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = SEEK_SET) -> int:
        base = {SEEK_SET: 0, SEEK_CUR: self._at}.get(whence, self._end + len(self._then))
        self._at = base + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at < self._end:
            self._file.seek(self._at)
            data = self._file.read(min(len(buffer), self._end - self._at))
        else:
            data = self._then[self._at - self._end :][: len(buffer)]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()


def _decompressed(compression: str, data: bytes) -> bytes:
    """What can be decompressed of data that end too early, or are damaged from some place on."""
    if not compression:
        return data
    kinds = {"lz4": LZ4FrameDecompressor, "zstd": storage_mcap.zstd.ZstdDecompressor}  # type: ignore[attr-defined]
    if compression not in kinds:
        return b""
    reader, raw = kinds[compression](), bytearray()
    with suppress(Exception):  # each library has errors of its own
        for at in range(0, len(data), _PIECE):
            raw += reader.decompress(data[at : at + _PIECE])
    return bytes(raw)


def _complete(raw: bytes) -> tuple[bytes, int]:
    """The complete records at the beginning of a chunk, and how many messages are among them."""
    at = messages = 0
    while at + _RECORD_LEN <= len(raw):
        kind, length = struct.unpack_from("<BQ", raw, at)
        if not kind or at + _RECORD_LEN + length > len(raw):
            break
        messages += kind == _MESSAGE
        at += _RECORD_LEN + length
    return raw[:at], messages


def _digest(settings: bytes) -> str:
    """The RIHS01 hash among the settings of a channel, '' where there is none."""
    stream = BytesIO(settings)
    while stream.tell() < len(settings):
        key, value = read_string(stream), read_string(stream)
        if key == _DIGEST:
            return value
    return ""


class TwoTimes(McapWriter):
    """rosbags' MCAP file, with a publish_time of its own for every message."""

    def __init__(self, path: Path, compression: Any) -> None:
        super().__init__(path, compression)
        self.sent_ns: int | None = None
        """When the next message was sent, ns since 1970; None = when it was received."""
        self._sent: list[tuple[int, int]] = []

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Add a connection as rosbags does, with the hash of its type as rosbag2 writes it."""
        at = self.chunk.bio.tell()
        super().add_connection(connection, offered_qos_profiles)
        settings = BytesIO(self.channels[-1].metadata)
        settings.seek(0, os.SEEK_END)
        write_string(settings, _DIGEST)
        write_string(settings, connection.digest)
        self.channels[-1] = self.channels[-1]._replace(metadata=settings.getvalue())
        self.chunk.bio.seek(at)
        write_channel(self.chunk.bio, self.channels[-1], self.schemas)

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

    def flush(self) -> None:
        """Write what has come so far into the file, as rosbags does after a megabyte."""
        if self.chunk.bio.tell():
            self.close_chunk()
        self.bio.flush()
