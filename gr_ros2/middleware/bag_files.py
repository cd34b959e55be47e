"""The content of a ROS 2 bag, MCAP or sqlite3: a folder with metadata.yaml, or a bare storage file.

Invariants: reading changes nothing, and every fault of a file is one line that names the file. The content of a bag is
taken from its files; metadata.yaml says which files there are, and what was expected in them. Neither metadata.yaml,
nor a file, nor a topic that cannot be read hinders the rest: what is missing is a remark. A BagError says that nothing
can be read. A topic is given completely, under its absolute name and with one type and definition, or it is left out
with the reason; messages are counted, and fewer messages than in the file's own index are an error.
"""

from __future__ import annotations

import logging
import re
import shutil
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeVar

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    QosDurability,
    QosHistory,
    QosReliability,
    QosTime,
)
from rosbags.interfaces import Qos as Profile
from rosbags.rosbag2 import metadata
from rosbags.rosbag2.reader import zstd  # type: ignore[attr-defined]
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from gr_ros2.core.errors import BagError, ConfigError, MiddlewareError, reason
from gr_ros2.core.guard import one_line
from gr_ros2.core.names import first
from gr_ros2.middleware.bag_mcap import McapStorage
from gr_ros2.middleware.bag_sqlite import SqliteStorage
from gr_ros2.middleware.base import Qos, TopicInfo, finite
from gr_ros2.middleware.ros_graph import check_topic
from gr_ros2.middleware.type_definitions import same_type
from gr_ros2.settings.registry import normalize_type

_T = TypeVar("_T")
_CDR = "cdr"
_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")
_METADATA = "metadata.yaml"
_STORAGES: Mapping[bytes, type[McapStorage | SqliteStorage]] = {b"\x89MCAP0": McapStorage, b"SQLite": SqliteStorage}
"""By how a file begins."""
_ZSTD = b"\x28\xb5\x2f\xfd"
_NO_TIME = {"sec": 0, "nsec": 0}
_PROFILE = {
    **dict.fromkeys(("history", "reliability", "durability", "liveliness"), "system_default"),
    **dict.fromkeys(("deadline", "lifespan", "liveliness_lease_duration"), _NO_TIME),
    "depth": 0,
    "avoid_ros_namespace_conventions": False,
}
"""What a QoS profile says where it says nothing."""
_UNREADABLE = -1
"""Depth that stands for a text that is no profile."""
_DEEPEST = 2**31 - 1
"""Greatest depth of a topic."""
_MESSAGE_TYPE = re.compile(r"\w+/msg/\w+")

_log = logging.getLogger(__name__)


class BagMessage(NamedTuple):
    """One recorded message; ``stamp_ns`` is when it was recorded, ns since 1970."""

    topic: str
    type_name: str
    stamp_ns: int
    payload: bytes


@dataclass(frozen=True)
class RecordedTopic:
    """One topic of a bag, with everything that a copy has to preserve.

    :param info: absolute name, type as ``package/msg/Type``, and what its publishers offered (reliable, volatile, 10
        where that is not recorded)
    :param recorded_as: the name in the bag, which may be relative
    :param definition: definition of the type in the bag
    :param digest: RIHS01 hash of the type, '' = not recorded
    :param profiles: of all publishers, () = not recorded
    """

    info: TopicInfo
    recorded_as: str
    definition: MessageDefinition
    digest: str
    profiles: tuple[Profile, ...]


@dataclass(frozen=True)
class BagContents:
    """The topics of a bag that a link can carry.

    :param topics: by absolute name, in its order
    :param left_out: why a topic is left out, by absolute name
    :param differences: one line for each topic whose message counts in metadata.yaml and in the files differ, for each
        file that is missing or incomplete, and for each QoS that cannot be read
    """

    path: Path
    topics: Mapping[str, RecordedTopic]
    left_out: Mapping[str, str]
    differences: tuple[str, ...]

    @property
    def remarks(self) -> list[str]:
        """Warnings for the user of this bag, one line each; often none. Of many of a kind, there are the first."""
        left_out = first(f"{topic} is left out: {why}" for topic, why in self.left_out.items())
        return [*left_out, *first(self.differences)]

    @property
    def texts(self) -> dict[str, str]:
        """The definitions that are ``.msg`` texts, by type name."""
        found = {topic.info.type_name: topic.definition for topic in self.topics.values()}
        return {name: text.data for name, text in found.items() if text.format is MessageDefinitionFormat.MSG}

    def some(self) -> Mapping[str, RecordedTopic]:
        """The topics, of which there are some.

        :raises ConfigError: there is none
        """
        if not self.topics:
            raise ConfigError("; ".join([f"bag {self.path}: has no topics that a link can carry", *self.remarks]))
        return self.topics

    def check(self, topic: str, type_name: str) -> None:
        """Check that messages of a topic have that type; a topic that is not in the bag passes.

        :raises ConfigError: the topic is left out, or has another type
        """
        if topic in self.left_out:
            raise ConfigError(f"bag {self.path}: {topic} cannot be carried: {self.left_out[topic]}")
        found = self.topics.get(topic)
        if found is not None and found.info.type_name != type_name:
            raise ConfigError(f"bag {self.path}: {topic} is {found.info.type_name}, not {type_name}")


@contextmanager
def explained(path: Path, doing: str) -> Iterator[None]:
    """Turn every error inside the ``with`` statement into a BagError that names the file."""
    try:
        yield
    except (MiddlewareError, ConfigError):
        raise
    except Exception as error:
        raise BagError(f"bag {path}: cannot be {doing} ({reason(error)})") from error


class _QosTexts(YAML):
    """In place of ruamel's YAML where rosbags parses the QoS of a topic, twice per topic of a bag and in 5 ms each.

    The topics of a bag have few different texts, and each is parsed once.
    """

    def load(self, stream: Any) -> Any:
        """The profiles of a text; rosbags does not change them."""
        return _loaded(stream)


@lru_cache(maxsize=256)
def _loaded(text: str) -> list[dict[str, Any]]:
    try:
        profiles = YAML(typ="safe").load(text)
    except (YAMLError, RecursionError):  # the second for brackets within brackets
        profiles = None
    return [_profile(one) for one in (profiles if isinstance(profiles, list) else [profiles])]


def _profile(one: Any) -> dict[str, Any]:
    """A profile with all that rosbags requires; one with ``_UNREADABLE`` for what is no profile."""
    return _filled(one, _PROFILE) if isinstance(one, dict) else {**_PROFILE, "depth": _UNREADABLE}


def _filled(value: Any, default: dict[str, Any]) -> dict[str, Any]:
    """What a profile, or a time in it, says; the default for what is missing or of another kind."""
    filled = {}
    for key, plain in default.items():
        said = value.get(key) if isinstance(value, dict) else None
        fits = isinstance(said, type(plain)) or (isinstance(plain, str) and isinstance(said, int))
        filled[key] = _filled(said, plain) if isinstance(plain, dict) else said if fits else plain
    return filled


metadata.YAML = _QosTexts  # type: ignore[attr-defined]


class _Bag:
    """The opened files of a bag.

    :param path: folder or file
    :param stack: closes the files
    :ivar expected: the topics that metadata.yaml names, and how many messages it counts of each
    :ivar remarks: what cannot be read, one line each
    :raises BagError: there is nothing to read
    """

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self._stack = stack
        self.expected: list[Connection] = []
        self.message_count = 0
        self.remarks: list[str] = []
        self.files: list[McapStorage | SqliteStorage] = []
        for file in self._listed(path) if path.is_dir() else [path]:
            try:
                self.files.append(self._open(file))
            except Exception as error:
                if file == path:
                    raise
                self.remarks.append(f"{file.name} cannot be read ({one_line(error)})")
        if not self.files:
            raise BagError("; ".join([f"bag {path}: has no .mcap or .db3 file that can be read", *self.remarks]))
        self.remarks += [f"{Path(str(file.path)).name} {file.broken}" for file in self.files if file.broken]

    @property
    def connections(self) -> list[Connection]:
        """The topics of the files."""
        return [connection for file in self.files for connection in file.connections]

    def messages(self, connections: Sequence[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """The messages of topics, each with its stamp in ns."""
        for file in self.files:
            if chosen := [connection for connection in connections if connection.owner is file]:
                for connection, stamp_ns, payload in file.messages(chosen):
                    # The first byte of CDR is 0.
                    compressed = payload[: len(_ZSTD)] == _ZSTD
                    yield connection, stamp_ns, zstd.decompress(payload) if compressed else payload

    def _listed(self, path: Path) -> list[Path]:
        """The files of a folder: those of metadata.yaml, or all where it cannot be used."""
        names: list[str] = []
        try:
            names = self._described(
                YAML(typ="safe").load((path / _METADATA).read_text())["rosbag2_bagfile_information"]
            )
        except FileNotFoundError:
            self.remarks.append(f"there is no {_METADATA}, as after a crash: all files of the folder count")
        except Exception as error:  # noqa: BLE001 - it may contain anything
            self.remarks.append(f"{_METADATA} cannot be used ({one_line(error)}): all files of the folder count")
        missing = [name for name in names if not (path / name).exists()]
        self.remarks += [f"{name} is missing" for name in first(missing)]
        found = [path / name for name in names if name not in missing]
        return found or _files(path)

    def _described(self, information: Mapping[str, Any]) -> list[str]:
        """Take what metadata.yaml expects; returns the names of its files."""
        expected = [
            Connection(
                number,
                _said(topic, "name", str),
                _said(topic, "type", str),
                _NO_DEFINITION,
                _said({"type_description_hash": "", **topic}, "type_description_hash", str),
                _said(row, "message_count", int),
                ConnectionExtRosbag2(
                    _said(topic, "serialization_format", str), _profiles(topic.get("offered_qos_profiles"))
                ),
                self,
            )
            for number, row in enumerate(information["topics_with_message_count"])
            for topic in [row["topic_metadata"]]
        ]
        names = [PurePath(name).name for name in information["relative_file_paths"]]
        self.expected, self.message_count = expected, _said(information, "message_count", int)
        return names

    def _open(self, path: Path) -> McapStorage | SqliteStorage:
        with path.open("rb") as file:
            begins = file.read(16)
        if begins.startswith(_ZSTD):
            plain = Path(self._stack.enter_context(TemporaryDirectory(prefix="gr-ros2-"))) / path.stem
            with zstd.open(path, "rb") as packed, plain.open("wb") as unpacked:
                shutil.copyfileobj(packed, unpacked)
            return self._open(plain)
        if begins.startswith(b"#ROSBAG"):
            raise BagError(
                f"bag {path}: is of ROS 1; make one of ROS 2 of it: rosbags-convert --src {path} --dst {path.stem}"
            )
        for magic, storage in _STORAGES.items():
            if begins.startswith(magic):
                opened = storage(path)
                opened.open()
                self._stack.callback(opened.close)
                return opened
        raise BagError(f"bag {path}: is neither an MCAP nor a sqlite3 file, also not in zstd")


def _files(folder: Path) -> list[Path]:
    """The files of a folder that may be of a bag; the tenth comes after the second."""
    found = [file for file in folder.iterdir() if {".mcap", ".db3"} & {file.suffix, Path(file.stem).suffix}]
    found = [file for file in found if not file.name.endswith(("-wal", "-shm", "-journal"))]
    return sorted(found, key=lambda file: [int(p) if p.isdecimal() else p for p in re.split(r"(\d+)", file.name)])


def is_bag(path: Path) -> bool:
    """Whether this is by its name a recording: a bag folder, or a file of one."""
    if path.is_dir():
        return (path / _METADATA).is_file() or bool(_files(path))
    return path.suffix in (".mcap", ".db3", ".zstd", ".bag")


def _said(row: Mapping[str, Any], key: str, kind: type[_T]) -> _T:
    """What metadata.yaml says.

    :raises BagError: it is of another kind
    """
    value = row[key]
    if not isinstance(value, kind):
        raise BagError(f"{key} = {value!r}")
    return value


def _profiles(said: Any) -> list[Profile]:
    """The QoS in metadata.yaml: a text, or since version 9 a list."""
    return metadata.parse_qos([_profile(one) for one in said] if isinstance(said, list) else said)  # type: ignore[misc]


@contextmanager
def _opened(path: Path) -> Iterator[_Bag]:
    with explained(path, "read"):
        if not path.exists():
            raise BagError(f"bag {path}: there is no such file or folder")
        with ExitStack() as stack:
            yield _Bag(path, stack)


def read_bag(path: str | Path, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
    """The messages of a bag in recorded order, of the topics that :func:`bag_contents` has.

    :param path: bag folder, or a bare ``.mcap`` or ``.db3`` file
    :param topics: absolute names, None = all
    :raises BagError: missing, damaged, or no bag
    """
    path = Path(path)
    with _opened(path) as bag:
        found = _contents(path, bag).topics.values()
        chosen = {topic.recorded_as: topic.info for topic in found if topics is None or topic.info.topic in topics}
        connections = [connection for connection in bag.connections if connection.topic in chosen]
        if not connections:
            return
        counted = _counts(connections)
        read = Counter(dict.fromkeys(counted, 0))
        for connection, stamp_ns, payload in bag.messages(connections):
            read[connection.topic] += 1
            info = chosen[connection.topic]
            yield BagMessage(info.topic, info.type_name, stamp_ns, bytes(payload))
        for topic, count in read.items():
            differs = f"bag {path}: {count} messages of {topic} were read, and its index counts {counted[topic]}"
            if count < counted[topic]:
                raise BagError(f"{differs}: it is damaged; rebuild its index (ros2 bag reindex)")
            if count > counted[topic]:
                _log.warning(differs)


def bag_contents(path: str | Path) -> BagContents:
    """The topics of a bag.

    :raises BagError: missing, damaged, or no bag
    """
    path = Path(path)
    with _opened(path) as bag:
        return _contents(path, bag)


def bag_topics(path: str | Path) -> list[TopicInfo]:
    """The topics of a bag that a link can carry, by name, with the QoS their publishers offered.

    :raises BagError: missing, damaged, or no bag
    """
    return [topic.info for topic in bag_contents(path).topics.values()]


def bag_definitions(path: str | Path) -> dict[str, str]:
    """The ``.msg`` texts a bag carries, by type name; for ``BagMiddleware(definitions=…)``.

    :raises BagError: missing, damaged, or no bag
    """
    return bag_contents(path).texts


def _contents(path: Path, bag: _Bag) -> BagContents:
    named: dict[str, list[Connection]] = {}
    for connection in (*bag.connections, *bag.expected):
        name = connection.topic
        named.setdefault(name if name.startswith("/") else f"/{name}", []).append(connection)
    definitions: dict[str, tuple[str, MessageDefinition]] = {}
    for name in sorted(named):
        for connection in named[name]:
            if connection.msgdef.data:
                definitions.setdefault(_kind(connection), (name, connection.msgdef))
    unfit = {name: _unfit(name, named[name], definitions) for name in sorted(named)}
    topics = {name: _recorded(name, named[name], definitions, bag) for name, why in unfit.items() if not why}
    for name in topics:
        if any(profile.depth < 0 for c in named[name] for profile in _ext(c).offered_qos_profiles):
            bag.remarks.append(f"the QoS of {name} cannot be read: reliable, volatile and 10 are taken instead")
    left_out = {name: why for name, why in unfit.items() if why}
    return BagContents(path, topics, left_out, tuple(_differences(path, bag)))


def _kind(connection: Connection) -> str:
    """Type as ``package/msg/Type``; a type of another kind unchanged."""
    try:
        return normalize_type(connection.msgtype)
    except ConfigError:
        return connection.msgtype


def _unfit(
    name: str, connections: Sequence[Connection], definitions: Mapping[str, tuple[str, MessageDefinition]]
) -> str:
    """Why a link cannot carry a topic, '' where it can.

    :param definitions: by type, the definition that is used, and the first topic that has it
    """
    names = list(dict.fromkeys(c.topic for c in connections))
    kinds = list(dict.fromkeys(_kind(c) for c in connections))
    formats = list(dict.fromkeys(_ext(c).serialization_format for c in connections))
    try:
        check_topic(name)
    except ConfigError:
        return f"{names[0]!r} is no name of a ROS topic"
    if len(names) > 1:
        return f"it is recorded under the names {' and '.join(names)}"
    if len(kinds) > 1:
        return f"it is recorded with the types {' and '.join(kinds)}"
    if formats != [_CDR]:
        return f"it is serialized as {' and '.join(map(repr, formats))}, and a link carries {_CDR!r}"
    (kind,) = kinds
    if "/srv/" in kind or "/action/" in kind:
        return f"{kind} belongs to a service or an action, and a link carries only messages"
    if not _MESSAGE_TYPE.fullmatch(kind):
        return f"{kind!r} is no type of a ROS message"
    where, counts = definitions.get(kind, ("", _NO_DEFINITION))
    if not all(same_type(kind, c.msgdef.data, counts.data) for c in connections if c.msgdef.data):
        return f"the bag has several definitions of {kind}, and the one of {where} counts"
    return ""


def _recorded(
    name: str,
    connections: Sequence[Connection],
    definitions: Mapping[str, tuple[str, MessageDefinition]],
    bag: _Bag,
) -> RecordedTopic:
    one, kind = connections[0], _kind(connections[0])
    profiles = _united(
        [profile for c in file.connections if c.topic == one.topic for profile in _ext(c).offered_qos_profiles]
        for file in bag.files
    ) or [profile for c in connections for profile in _ext(c).offered_qos_profiles]
    profiles = [profile for profile in profiles if profile.depth >= 0]
    offers = tuple(_offered(profile) for profile in profiles) or (Qos("reliable", "volatile", 10),)
    return RecordedTopic(
        TopicInfo(name, kind, offers),
        one.topic,
        definitions.get(kind, ("", _NO_DEFINITION))[1],
        next((c.digest for c in connections if c.digest), ""),
        tuple(profiles),
    )


def _united(files: Iterable[Sequence[Profile]]) -> list[Profile]:
    """The profiles of the publishers of one topic: each file repeats the profiles that existed at its time."""
    united: list[Profile] = []
    for profiles in files:
        had = list(united)
        for profile in profiles:
            if profile in had:
                had.remove(profile)
            else:
                united.append(profile)
    return united


def _differences(path: Path, bag: _Bag) -> Iterator[str]:
    yield from (f"{path}: {remark}" for remark in bag.remarks)
    found, expected = _counts(bag.connections), _counts(bag.expected)
    if bag.expected:
        for topic in sorted({*found, *expected}):
            if found[topic] != expected[topic]:
                yield (
                    f"{path}: metadata.yaml counts {expected[topic]} messages of {topic}, the files have "
                    f"{found[topic]}; the files count"
                )
        if found == expected and found.total() != bag.message_count:
            yield f"{path}: metadata.yaml counts {bag.message_count} messages, the files have {found.total()}"
    for file in bag.files:
        of_topics, total = _counts(file.connections).total(), file.metadata.message_count
        if of_topics != total:
            yield f"{file.path}: of {total} messages {of_topics} are of a topic that it names"


def _counts(connections: Iterable[Connection]) -> Counter[str]:
    counts: Counter[str] = Counter()
    for connection in connections:
        counts[connection.topic] += connection.msgcount
    return counts


def _ext(connection: Connection) -> ConnectionExtRosbag2:
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    return connection.ext


def _offered(profile: Profile) -> Qos:
    """A recorded profile as ``Qos``; an unknown history has the default depth, as on a graph. A depth that no topic can
    be given (a recorder may write one of 64 bits) is the greatest one."""
    return Qos(
        "best_effort" if profile.reliability is QosReliability.BEST_EFFORT else "reliable",
        "transient_local" if profile.durability is QosDurability.TRANSIENT_LOCAL else "volatile",
        0 if profile.history is QosHistory.KEEP_ALL else min(profile.depth, _DEEPEST) or Qos().depth,
        _seconds(profile.lifespan),
        _seconds(profile.deadline),
    )


def _seconds(time: QosTime) -> float:
    return finite(time.sec + time.nsec * 1e-9)
