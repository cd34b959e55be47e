"""Bags as other programs write them, made by hand: rosbag2's sqlite3 schemas, MCAP records, metadata.yaml."""

from __future__ import annotations

import shutil
import sqlite3
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import yaml
from rosbags.rosbag2.storage_mcap import zstd  # type: ignore[attr-defined]

STEP_NS = 20_000_000
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Foreign:
    """One topic of a bag: ``count`` String messages that tell topic and number, and ``random`` bytes in hex."""

    name: str
    type_name: str = "std_msgs/msg/String"
    count: int = 10
    qos: str = ""
    text: str = ""
    encoding: str = "ros2msg"
    serialization: str = "cdr"
    digest: str = ""
    start: int = 0
    random: int = 0

    @property
    def payloads(self) -> list[bytes]:
        return [
            string(f"{self.name} {self.type_name} {number}{Random(number).randbytes(self.random).hex()}")
            for number in range(self.start, self.start + self.count)
        ]


def string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


def profile(history: int = 1, depth: int = 10, reliability: int = 1, durability: int = 2) -> dict[str, Any]:
    """A QoS profile as rosbag2 writes it up to Iron; 3 is "unknown"."""
    never = {"sec": 9223372036, "nsec": 854775807}
    return {
        "history": history,
        "depth": depth,
        "reliability": reliability,
        "durability": durability,
        "deadline": never,
        "lifespan": never,
        "liveliness": 1,
        "liveliness_lease_duration": never,
        "avoid_ros_namespace_conventions": False,
    }


def qos(*profiles: dict[str, Any]) -> str:
    return yaml.safe_dump(list(profiles))


def in_order(topics: Sequence[Foreign]) -> list[tuple[int, int, bytes]]:
    """Place of the topic from 1, time and payload of every message, in the order of time."""
    rows = [
        (place, START_NS + (topic.start + number) * STEP_NS + place, payload)
        for place, topic in enumerate(topics, 1)
        for number, payload in enumerate(topic.payloads)
    ]
    return sorted(rows, key=lambda row: row[1])


def make_sqlite(path: Path, topics: Sequence[Foreign], version: int = 2) -> Path:
    """A file of schema ``version``: 1 without QoS, 2 as up to Humble, 4 with definitions and hashes since Iron."""
    database = sqlite3.connect(path)
    columns = ["name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash"]
    columns = columns[: {1: 3, 2: 4, 4: 5}[version]]
    database.execute(f"CREATE TABLE topics(id INTEGER PRIMARY KEY, {', '.join(f'{name} TEXT' for name in columns)})")
    database.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB NOT NULL)"
    )
    if version == 4:
        database.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
        database.execute("INSERT INTO schema VALUES(4, 'iron')")
        database.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT, "
            "encoded_message_definition TEXT, type_description_hash TEXT)"
        )
    for place, topic in enumerate(topics, 1):
        values = [topic.name, topic.type_name, topic.serialization, topic.qos, topic.digest][: len(columns)]
        marks = ", ".join("?" for _ in values)
        database.execute(f"INSERT INTO topics VALUES({place}, {marks})", values)
        if version == 4 and topic.text:
            definition = (topic.type_name, topic.encoding, topic.text, topic.digest)
            database.execute("INSERT INTO message_definitions VALUES(NULL, ?, ?, ?, ?)", definition)
    add_rows(database, in_order(topics))
    database.close()
    return path


def add_rows(database: sqlite3.Connection, rows: Iterable[tuple[int, int, bytes]]) -> None:
    database.executemany("INSERT INTO messages VALUES(NULL, ?, ?, ?)", rows)
    database.commit()


def crashed(path: Path, topics: Sequence[Foreign], checkpointed: Sequence[Foreign]) -> Path:
    """A file whose writer never closed it: ``checkpointed`` stand in it, ``topics`` only in the log beside it."""
    alive = make_sqlite(path.with_name(f"alive_{path.name}"), checkpointed)
    writer = sqlite3.connect(alive)
    writer.execute("PRAGMA journal_mode = WAL")
    writer.execute("PRAGMA wal_autocheckpoint = 0")
    add_rows(writer, in_order(topics))
    for suffix in ("", "-wal"):
        shutil.copy(f"{alive}{suffix}", f"{path}{suffix}")
    writer.close()
    alive.unlink()
    return path


def broken_off(path: Path, topics: Sequence[Foreign]) -> Path:
    """A file whose writer died while it changed pages in place, with the journal that would undo that."""
    alive = make_sqlite(path.with_name(f"alive_{path.name}"), topics)
    writer = sqlite3.connect(alive, isolation_level=None)
    writer.execute("PRAGMA cache_size = 5")
    writer.execute("BEGIN")
    writer.execute("UPDATE messages SET data = zeroblob(3000)")
    for suffix in ("", "-journal"):
        shutil.copy(f"{alive}{suffix}", f"{path}{suffix}")
    writer.close()
    alive.unlink()
    return path


def make_mcap(
    path: Path, topics: Sequence[Foreign], *, message_index: bool = True, miscounted: int = 0, schemaless: bool = False
) -> Path:
    """A file of one chunk.

    :param message_index: False = the chunk has none, which the format allows
    :param miscounted: messages that the statistics count too many, of the first topic
    """
    definitions = b"" if schemaless else b"".join(_schema(place, topic) for place, topic in enumerate(topics, 1))
    definitions += b"".join(_channel(place, topic, schemaless) for place, topic in enumerate(topics, 1))
    chunk = bytearray(definitions)
    rows = in_order(topics)
    places: dict[int, list[tuple[int, int]]] = {}
    for place, stamp, payload in rows:
        places.setdefault(place, []).append((stamp, len(chunk)))
        chunk += _record(0x05, struct.pack("<HIQQ", place, 0, stamp, stamp) + payload)
    first, last = rows[0][1], rows[-1][1]
    file = bytearray(b"\x89MCAP0\r\n") + _record(0x01, _text("ros2") + _text("by hand"))
    chunk_start = len(file)
    sizes = struct.pack("<Q", len(chunk))
    times = struct.pack("<QQ", first, last)
    file += _record(0x06, times + sizes + bytes(4) + _text("") + sizes + chunk)
    chunk_length = len(file) - chunk_start
    offsets = b""
    if message_index:
        for place, entries in places.items():
            offsets += struct.pack("<HQ", place, len(file))
            file += _record(0x07, struct.pack("<H", place) + _sized(b"".join(struct.pack("<QQ", *e) for e in entries)))
    index_length = len(file) - chunk_start - chunk_length
    file += _record(0x0F, bytes(4))
    summary = len(file)
    file += definitions
    file += _record(
        0x08,
        times
        + struct.pack("<QQ", chunk_start, chunk_length)
        + _sized(offsets)
        + struct.pack("<Q", index_length)
        + _text("")
        + sizes * 2,
    )
    counts = {place: topic.count + (miscounted if place == 1 else 0) for place, topic in enumerate(topics, 1)}
    file += _record(
        0x0B,
        struct.pack("<QHIIIIQQ", sum(counts.values()), len(topics), len(topics), 0, 0, 1, first, last)
        + _sized(b"".join(struct.pack("<HQ", *item) for item in counts.items())),
    )
    file += _record(0x02, struct.pack("<QQI", summary, 0, 0)) + b"\x89MCAP0\r\n"
    path.write_bytes(file)
    return path


def unclosed(
    path: Path, topics: Sequence[Foreign], *, chunked: bool = True, tail: bytes = b"", profile: str = "ros2"
) -> Path:
    """A file whose writer was killed: definitions and chunks of one message, the newest first, and no end.

    :param chunked: False = the messages stand in no chunk, as rosbag2's profile ``fastwrite`` writes them
    :param tail: what the writer had begun to write
    """
    file = bytearray(b"\x89MCAP0\r\n") + _record(0x01, _text(profile) + _text("by hand"))
    for place, topic in enumerate(topics, 1):
        file += _schema(place, topic) + _channel(place, topic, False)
    for place, stamp, payload in reversed(in_order(topics)):
        record = _record(0x05, struct.pack("<HIQQ", place, 0, stamp, stamp) + payload)
        size = struct.pack("<Q", len(record))
        chunk = struct.pack("<QQ", stamp, stamp) + size + bytes(4) + _text("") + size + record
        file += _record(0x06, chunk) if chunked else record
    path.write_bytes(file + tail)
    return path


def chunks_of(path: Path, topic: Foreign, compression: str, per_chunk: int) -> list[int]:
    """A file that was never closed, of chunks with so many messages each; where each chunk begins, and where the file
    ends."""
    pack = {"": bytes, "lz4": lz4.frame.compress, "zstd": zstd.compress}[compression]
    file = bytearray(b"\x89MCAP0\r\n") + _record(0x01, _text("ros2") + _text("by hand"))
    file += _schema(1, topic) + _channel(1, topic, False)
    begins, rows = [], in_order([topic])
    for n in range(0, len(rows), per_chunk):
        begins.append(len(file))
        part = rows[n : n + per_chunk]
        raw = b"".join(_record(0x05, struct.pack("<HIQQ", p, 0, at, at) + payload) for p, at, payload in part)
        packed = pack(raw)
        head = struct.pack("<QQQI", part[0][1], part[-1][1], len(raw), zlib.crc32(raw))
        file += _record(0x06, head + _text(compression) + struct.pack("<Q", len(packed)) + packed)
    path.write_bytes(file)
    return [*begins, len(file)]


def make_folder(
    path: Path,
    files: Sequence[Path],
    topics: Sequence[Foreign],
    *,
    message_count: int | None = None,
    version: int = 4,
    storage: str | None = None,
) -> Path:
    """A bag folder: the files moved into it beside a metadata.yaml that claims ``topics``."""
    path.mkdir()
    for file in files:
        for part in file.parent.glob(f"{file.name}*"):
            shutil.move(part, path / part.name)
    claimed = sum(topic.count for topic in topics) if message_count is None else message_count
    information = {
        "version": version,
        "storage_identifier": {".mcap": "mcap"}.get(files[0].suffix, "sqlite3") if storage is None else storage,
        "relative_file_paths": [file.name for file in files],
        "duration": {"nanoseconds": 10**9},
        "starting_time": {"nanoseconds_since_epoch": START_NS},
        "message_count": claimed,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type_name,
                    "serialization_format": topic.serialization,
                    "offered_qos_profiles": topic.qos,
                    "type_description_hash": topic.digest,
                },
                "message_count": topic.count,
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
    }
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    return path


def without_qos(topics: Sequence[Foreign]) -> list[Foreign]:
    return [replace(topic, qos="") for topic in topics]


def listing(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with what is in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _record(operation: int, content: bytes | bytearray) -> bytes:
    return bytes([operation]) + struct.pack("<Q", len(content)) + bytes(content)


def _sized(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _text(text: str) -> bytes:
    return _sized(text.encode(errors="surrogateescape"))


def _schema(place: int, topic: Foreign) -> bytes:
    content = struct.pack("<H", place) + _text(topic.type_name) + _text(topic.encoding) + _text(topic.text)
    return _record(0x03, content)


def _channel(place: int, topic: Foreign, schemaless: bool) -> bytes:
    settings = _text("offered_qos_profiles") + _text(topic.qos)
    content = struct.pack("<HH", place, 0 if schemaless else place) + _text(topic.name) + _text(topic.serialization)
    return _record(0x04, content + _sized(settings))
