"""The sqlite3 files of ROS 2 bags, read in all versions of their schema, and also after a crash.

Invariants: reading changes nothing, neither the file nor its folder; the files that SQLite keeps next to the database
(the write-ahead log of a writer that never closed) belong to it, and a database is refused where they cannot be used.
Sources: https://www.sqlite.org/wal.html, sections 5 and 8 (read-only databases, heap memory instead of a -shm file);
https://www.sqlite.org/lockingv3.html, section 4.2 (hot journals).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import quote

import apsw
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2.metadata import parse_qos
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader, Sqlite3Writer

from gr_ros2.core.errors import BagError

_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
"""By rosbag2's name; other names, such as its ``unknown``, mean that there is no definition."""


class CommittedSqlite(Sqlite3Writer):
    """rosbags' sqlite3 file, of which what has come so far can be kept."""

    def flush(self) -> None:
        """Write what has come so far into the file; rosbags does so at its end alone."""
        self.conn.commit()


class SqliteStorage(Sqlite3Reader):
    """rosbags' reader of messages, on a database opened together with its write-ahead log."""

    broken = ""
    """What is missing at the end; SQLite leaves out what was not written completely."""

    def open(self) -> None:
        """Open and read which topics there are.

        :raises BagError: for an incomplete write, or a file that is not a bag
        """
        path = Path(str(self.path))
        self.dbconn = _connect(path)
        try:
            self._describe(self.dbconn)
        except BaseException as error:
            self.close()
            if isinstance(error, apsw.ReadOnlyError):
                raise BagError(
                    f"bag {path}: a write was broken off, and {path.name}-journal is needed to undo it, which changes "
                    "the file; open a copy of both once with sqlite3"
                ) from error
            raise

    def _describe(self, database: apsw.Connection) -> None:
        tables = {name for (name,) in _rows(database, "SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"messages", "topics"} <= tables:
            raise BagError(f"bag {self.path}: is no ROS 2 bag: it has no tables messages and topics")
        columns = {row[1] for row in _rows(database, "PRAGMA table_info(topics)")}
        names = ("name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash")
        texts_of = ", ".join(f"CAST({name} AS BLOB)" if name in columns else "x''" for name in names)
        texts = (
            "SELECT topic_type, encoding, encoded_message_definition, type_description_hash FROM message_definitions"
        )
        definitions = _rows(database, texts) if "message_definitions" in tables else []
        counts = dict(_rows(database, "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        self.connections = [
            Connection(
                number,
                name,
                type_name,
                _definition(definitions, type_name, type_hash),
                type_hash,
                counts.get(number, 0),
                ConnectionExtRosbag2(serialization, parse_qos(profiles)),
                self,
            )
            for number, *said in _rows(database, f"SELECT id, {texts_of} FROM topics ORDER BY id")
            for name, type_name, serialization, profiles, type_hash in [map(_text, said)]
        ]
        self.metadata = self.metadata._replace(message_count=sum(counts.values()))


def _text(data: bytes | None) -> str:
    """A text of a topic, as far as it is one, so that another one's decides nothing; '' where there is none."""
    return (data or b"").decode(errors="replace")


def _definition(rows: list[tuple[Any, ...]], type_name: str, type_hash: str) -> MessageDefinition:
    """The text of a type; where the file has several (merged bags), the one with the right hash."""
    for name, encoding, text, digest in rows:
        if name == type_name and encoding in _FORMATS and (digest == type_hash or not (digest and type_hash)):
            return MessageDefinition(_FORMATS[encoding], text)
    return MessageDefinition(MessageDefinitionFormat.NONE, "")


def _rows(database: apsw.Connection, query: str) -> list[tuple[Any, ...]]:
    return database.execute(query).fetchall()


def _connect(path: Path) -> apsw.Connection:
    flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    place = f"file:{quote(str(path))}"
    # For an empty database SQLite would remove the files next to it.
    if not (path.stat().st_size and any(_has_bytes(path, suffix) for suffix in ("-wal", "-journal"))):
        return apsw.Connection(f"{place}?immutable=1", flags=flags)
    # Without locks, and with the index of the log in memory, SQLite makes no further file.
    database = apsw.Connection(f"{place}?mode=ro&vfs=unix-none", flags=flags)
    database.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
    database.execute("PRAGMA locking_mode = EXCLUSIVE")
    return database


def _has_bytes(path: Path, suffix: str) -> bool:
    beside = path.with_name(path.name + suffix)
    return beside.exists() and beside.stat().st_size > 0
