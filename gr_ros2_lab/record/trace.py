"""The trace of a run, message by message and packet by packet: three tables beside `result.json`.

    messages.csv, messages.parquet   one line per message submitted, in the order of submission
    packets.parquet                  one line per entry of every packet sent, in the order of sending
    paths.parquet                    one line per position sent or received, where a topic has positions

Invariants: times are s since submission began, on the run's clock; the time of an event that did not happen is null (a
message that was not delivered has no t_delivered); a file appears whole or not at all; reading refuses any other file
with one line that names it. During a run a message takes about 33 bytes and an entry 16 bytes, in arrays.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pa_parquet

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import write_whole
from gr_ros2.link.events import SentPacket
from gr_ros2_lab.record.ledger import TopicLedger

Ints = npt.NDArray[np.int64]
Texts = npt.NDArray[Any]

MESSAGES, PACKETS, PATHS = "messages", "packets", "paths"

_T_END = b"gr_ros2.t_end"
_TEXT = pa.dictionary(pa.int32(), pa.string())
SCHEMAS = {
    MESSAGES: pa.schema(
        {
            "topic": _TEXT,  # absolute name at the source
            "src_id": pa.uint8(),
            "serial": pa.int64(),  # the sender's number of the message, from 0
            "t_sent": pa.float64(),  # null: refused before it was queued
            "t_delivered": pa.float64(),
            "hops": pa.int8(),  # robots that sent it on; null: it was not delivered
            "size": pa.int64(),  # serialized bytes
            "fate": _TEXT,  # of the loss ledger
        }
    ),
    PACKETS: pa.schema(
        {
            "packet": pa.int64(),  # from 0 per source
            "src_id": pa.uint8(),
            "seq": pa.uint16(),  # on the wire
            "t_sent": pa.float64(),
            "t_received": pa.float64(),  # null: it did not reach the sink intact
            "topic": _TEXT,
            "serial": pa.int64(),  # of the message; -1: a repeat of a latched one
            "entry_id": pa.int32(),
            "index": pa.int32(),
            "total": pa.int32(),
        }
    ),
    PATHS: pa.schema(
        {
            "topic": _TEXT,  # absolute name at the source
            "published_as": _TEXT,  # at the sink
            "end": _TEXT,  # sent or received
            "t": pa.float64(),
            "x": pa.float64(),  # m
            "y": pa.float64(),
        }
    ),
}
_MAY_LACK = {MESSAGES: {"t_sent", "t_delivered", "hops"}, PACKETS: {"t_received"}, PATHS: {"x", "y"}}
"""The columns in which a row may have no value."""


@dataclass(slots=True)
class Track:
    """A path: times, s on the run's clock, and positions, m; ``left_out`` counts messages without a position."""

    t: array[float] = field(default_factory=lambda: array("d"))
    x: array[float] = field(default_factory=lambda: array("d"))
    y: array[float] = field(default_factory=lambda: array("d"))
    left_out: int = 0

    def add(self, t: float, x: float, y: float) -> None:
        """Add a position. ``y`` is appended last, and its length counts: :meth:`points` may be called at any time, from
        another thread."""
        self.t.append(t)
        self.x.append(x)
        self.y.append(y)

    def points(self) -> tuple[Floats, Floats]:
        """Times, shape (n,), and positions, shape (n, 2), of all points that are complete now."""
        count = len(self.y)
        return _copied(self.t, count), np.column_stack([_copied(self.x, count), _copied(self.y, count)])


class PacketLog:
    """The packets of one source. Its sender and the receiver report to it, each in its own thread."""

    def __init__(self) -> None:
        self._t_sent, self._t_received = array("d"), array("d")
        self._seq, self._entries = array("H"), array("B")
        self._serial = array("q")
        self._topic_id = array("B")
        self._name, self._index, self._total = array("L"), array("L"), array("L")

    def sent(self, event: SentPacket) -> None:
        """A packet left the sender."""
        for entry, written in zip(event.entries, event.packet.entries, strict=False):  # a repair packet has no entries
            self._serial.append(-1 if entry.repeat else entry.serial)
            self._topic_id.append(entry.topic_id)
            self._name.append(written.name)
            self._index.append(entry.index)
            self._total.append(entry.total)
        self._t_sent.append(event.now)
        self._t_received.append(nan)
        self._seq.append(event.packet.seq)
        self._entries.append(len(event.entries))

    def received(self, number: int, now: float) -> None:
        """The packet of this number, from 0, reached the sink."""
        self._t_received[number] = now

    def columns(self, src_id: int, name_of: Callable[[int], str], t0: float) -> dict[str, Any]:
        """The columns of table `packets`, with topic names.

        :param name_of: topic name at the source, by topic id
        """
        # A run that is stopped may still be sending. Only packets that are complete now are used.
        count = _copied(self._entries, len(self._entries)).astype(np.int64)
        packet = np.repeat(np.arange(len(count)), count)
        packets, entries = len(count), len(packet)
        topic_ids = _copied(self._topic_id, entries).astype(np.int64)
        names = {topic_id: name_of(topic_id) for topic_id in set(topic_ids.tolist())}
        return {
            "packet": packet,
            "src_id": np.full(len(packet), src_id),
            "seq": _copied(self._seq, packets).astype(np.int64)[packet],
            "t_sent": _copied(self._t_sent, packets)[packet] - t0,
            "t_received": _copied(self._t_received, packets)[packet] - t0,
            "topic": _named(topic_ids, names),
            "serial": _copied(self._serial, entries),
            "entry_id": _copied(self._name, entries).astype(np.int64),
            "index": _copied(self._index, entries).astype(np.int64),
            "total": _copied(self._total, entries).astype(np.int64),
        }


@dataclass(frozen=True)
class Messages:
    """The messages of one topic of one source as parallel arrays, in the order of submission; NaN where a time is
    null."""

    topic: str
    src_id: int
    serial: Ints
    t_sent: Floats
    t_delivered: Floats
    size: Ints
    fate: Texts

    @property
    def delivered(self) -> npt.NDArray[np.bool_]:
        """Which of them were delivered."""
        return ~np.isnan(self.t_delivered)


@dataclass(frozen=True)
class Packets:
    """One item per entry of every packet sent, as parallel arrays, in the order of time; NaN where a time is null.

    :param packet: number of the packet, from 0 over all sources
    """

    packet: Ints
    t_sent: Floats
    t_received: Floats
    topic: Texts
    src_id: Ints
    serial: Ints
    index: Ints
    total: Ints

    def times(self) -> tuple[Floats, Floats]:
        """When each packet was sent and received."""
        first = np.flatnonzero(np.diff(self.packet, prepend=-1))
        return self.t_sent[first], self.t_received[first]


@dataclass(frozen=True)
class Path2D:
    """A transmitted path and the path that was received, shape (n, 2), m, each in its own order of time."""

    topic: str
    published_as: str
    sent: Floats
    received: Floats


@dataclass(frozen=True, eq=False)
class Trace:
    """The tables of one run.

    :param t_end: s, when submission ended; ages are observed until then
    """

    tables: Mapping[str, Any]
    t_end: float

    def messages(self) -> Iterator[Messages]:
        """The messages, topic by topic, in the order in which the topics first sent."""
        table = self.tables[MESSAGES]
        columns = {name: _array(table, name) for name in table.column_names}
        keys = list(zip(columns["topic"].tolist(), columns["src_id"].tolist(), strict=True))
        codes = {key: code for code, key in enumerate(dict.fromkeys(keys))}
        code_of = np.array([codes[key] for key in keys], dtype=np.int64)
        for (topic, src_id), code in codes.items():
            mine = code_of == code
            yield Messages(
                topic,
                src_id,
                *(columns[name][mine] for name in ("serial", "t_sent", "t_delivered", "size", "fate")),
            )

    def packets(self) -> Packets:
        """All packets of all sources."""
        table = self.tables[PACKETS]
        number, src_id = _array(table, "packet"), _array(table, "src_id")
        new = (np.diff(number, prepend=-1) != 0) | (np.diff(src_id, prepend=-1) != 0)
        names = ("t_sent", "t_received", "topic", "src_id", "serial", "index", "total")
        return Packets(np.cumsum(new) - 1, *(_array(table, name) for name in names))

    def paths(self) -> Iterator[Path2D]:
        """The paths, topic by topic."""
        table = self.tables[PATHS]
        topics, others, ends = (_array(table, name) for name in ("topic", "published_as", "end"))
        xy = np.column_stack([_array(table, "x"), _array(table, "y")])
        for topic in dict.fromkeys(topics.tolist()):
            mine = topics == topic
            yield Path2D(topic, others[mine][0], xy[mine & (ends == "sent")], xy[mine & (ends == "received")])


def make_trace(
    books: Sequence[TopicLedger],
    *,
    logs: Mapping[int, PacketLog],
    tracks: Mapping[tuple[int, int], tuple[Track, Track]],
    name_of: Callable[[int, int], str],
    published_as: Mapping[str, str],
    t0: float,
    t_end: float,
) -> Trace:
    """The tables of a finished run.

    :param books: the closed ledger of every topic
    :param logs: packets by source id
    :param tracks: paths sent and received, by source and topic id
    :param name_of: topic name at the source, by source and topic id
    :param published_as: topic name at the sink by the name at the source; a missing topic has the same name at both
    :param t0: s on the run's clock, when submission began
    :param t_end: s on the run's clock, when it ended
    """
    messages = [_message_columns(book, name_of(book.src_id, book.topic_id), t0) for book in books]
    packets = [log.columns(src_id, lambda topic_id, s=src_id: name_of(s, topic_id), t0) for src_id, log in logs.items()]  # type: ignore[misc]
    paths = []
    for key, pair in tracks.items():
        topic = name_of(*key)
        for end, track in zip(("sent", "received"), pair, strict=True):
            t, xy = track.points()
            same = {"topic": topic, "published_as": published_as.get(topic, topic), "end": end}
            columns: dict[str, Any] = {name: np.full(len(t), value, dtype=object) for name, value in same.items()}
            paths.append({**columns, "t": t - t0, "x": xy[:, 0], "y": xy[:, 1]})
    tables = {
        MESSAGES: _table(MESSAGES, messages).sort_by([("src_id", "ascending"), ("serial", "ascending")]),
        # The sort is stable: the entries of a packet keep their order.
        PACKETS: _table(PACKETS, packets).sort_by([(name, "ascending") for name in ("t_sent", "src_id", "packet")]),
        PATHS: _table(PATHS, paths),
    }
    return Trace(tables, t_end - t0)


def write_trace(trace: Trace, directory: Path) -> list[Path]:
    """Write the files that are listed at the top of this module into a folder.

    :return: their paths
    :raises ConfigError: when they cannot be written
    """
    written, checked = [], partial(pa_parquet.write_table, write_page_checksum=True)
    for name, table in trace.tables.items():
        marked = table.replace_schema_metadata({_T_END: repr(trace.t_end)})
        written.append(write_whole(directory / f"{name}.parquet", marked, checked))
    written.append(write_whole(directory / f"{MESSAGES}.csv", trace.tables[MESSAGES], write_csv))
    return written


def read_trace(directory: Path) -> Trace:
    """Read the Parquet files of a run.

    :raises ConfigError: when a file is missing, damaged, half-written or not a table of a run; names the file
    """
    tables, ends = {}, set()
    for name, schema in SCHEMAS.items():
        path = directory / f"{name}.parquet"
        table = _read(path)
        for column in schema:
            found = table.schema.field(column.name).type if column.name in table.column_names else None
            if found != column.type:
                raise ConfigError(
                    f"{path}: no table of a run (column {column.name!r} is {found or 'missing'}, not {column.type})"
                )
            if column.name not in _MAY_LACK[name] and table.column(column.name).null_count:
                raise ConfigError(f"{path}: no table of a run (column {column.name!r} has rows without a value)")
        try:
            ends.add(float((table.schema.metadata or {})[_T_END]))
        except (KeyError, ValueError) as error:
            raise ConfigError(f"{path}: no table of a run (it does not say when the run ended)") from error
        if len(ends) > 1:
            raise ConfigError(f"{path}: of another run than the tables beside it; run the experiment again")
        tables[name] = table
    return Trace(tables, ends.pop())


def write_csv(table: Any, path: Path) -> None:
    """One table as CSV with a header line; null is an empty field."""
    plain = pa.schema([(c.name, pa.string() if pa.types.is_dictionary(c.type) else c.type) for c in table.schema])
    pa_csv.write_csv(table.cast(plain), path, pa_csv.WriteOptions(quoting_style="needed"))


def _read(path: Path) -> Any:
    try:
        # Not read_table: it interprets folders called key=value as columns.
        with pa_parquet.ParquetFile(path, page_checksum_verification=True) as file:
            return file.read()
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        why = "no such file" if isinstance(error, FileNotFoundError) else error.strerror or error
        raise ConfigError(f"{path}: cannot be read ({why}); run the experiment again") from error
    except (pa.ArrowException, OSError) as error:
        why = str(error).splitlines()[0].split(": ")[-1].rstrip(".") if str(error) else type(error).__name__
        raise ConfigError(f"{path}: damaged or half-written, no Parquet ({why}); run the experiment again") from error


def _message_columns(book: TopicLedger, topic: str, t0: float) -> dict[str, Any]:
    return {
        "topic": np.full(len(book.serial), topic, dtype=object),
        "src_id": np.full(len(book.serial), book.src_id),
        "serial": np.array(book.serial, dtype=np.int64),
        "t_sent": np.array(book.t_sent) - t0,
        "t_delivered": np.array(book.t_delivered) - t0,
        "hops": np.where(np.array(book.hops) < 0, nan, book.hops),
        "size": np.array(book.size, dtype=np.int64),
        "fate": _named(np.array(book.fate, dtype=np.int64), {code: fate for fate, code in book.codes.items()}),
    }


def _copied(values: array[Any], count: int) -> npt.NDArray[Any]:
    """A copy of the first ``count`` values, safe while another thread appends.

    Slicing is one step of the interpreter. If numpy read the array itself, the array could not grow at the same time,
    and the thread that appends would fail.
    """
    return np.frombuffer(values[:count], dtype=values.typecode)


def _named(codes: Ints, names: Mapping[int, str]) -> Texts:
    texts = np.array([names.get(code, "") for code in range(max(names, default=-1) + 1)], dtype=object)
    return texts[codes] if len(codes) else np.empty(0, dtype=object)


def _table(name: str, parts: Sequence[Mapping[str, Any]]) -> Any:
    """One table of all parts; NaN becomes null."""
    columns = {}
    for column in SCHEMAS[name]:
        joined = np.concatenate([part[column.name] for part in parts]) if parts else np.empty(0)
        plain = pa.string() if column.type == _TEXT else column.type
        values = pa.array(joined, plain, from_pandas=True)
        columns[column.name] = values.dictionary_encode() if column.type == _TEXT else values
    return pa.table(columns, schema=SCHEMAS[name])


def _array(table: Any, name: str) -> Any:
    """A column as an array: null numbers as NaN, texts as objects."""
    values: npt.NDArray[Any] = table.column(name).to_numpy()
    return values.astype(np.int64) if values.dtype.kind in "iu" else values
