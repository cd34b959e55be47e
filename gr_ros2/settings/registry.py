"""The registry: which topics cross the link, and the number of each (the paper, section 4.3).

A row may also name a service, an action, or the parameters or the lifecycle of a node. Such a row stands for several
rows: an action is three services and two topics in ROS 2.

Invariant: row order is topic id order; both ends use the same file, and equal ``digest`` values confirm that.
"""

from __future__ import annotations

import csv
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TypeVar, overload

from gr_ros2.core.errors import ConfigError, RegistryError, reason
from gr_ros2.core.names import checked_topic_form, filled, topic_fault
from gr_ros2.settings.config import SendOptions, build
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.robot import PublishConfig, PublishOptions
from gr_ros2.settings.service_rows import OF_ACTION, STATUS, is_of_node, is_service, parts
from gr_ros2.settings.topic_choice import TopicChoice, is_wild
from gr_ros2.wire import FORMATS, AnnouncedTopic

MAX_TOPICS = max(version.max_topics for version in FORMATS.values())
DEFAULT_OPTIONS = SendOptions()
_O = TypeVar("_O")
_D = TypeVar("_D")

PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""Types whose messages may leave as video."""
CLOUD = "sensor_msgs/msg/PointCloud2"
CALLS_TYPE = "gr_ros2/calls/Frame"
"""Type of the row in which requests and replies are sent (see :mod:`gr_ros2.calls`); no topic has this type."""
FILLER_TYPE = "gr_ros2/throughput/Filler"
"""Type of the row that fills the air while the link is measured (:mod:`gr_ros2.gr.throughput`); no topic has it."""
BACKFILL_TYPE = "gr_ros2/backfill/Message"
"""Type of the row in which gaps are filled (:mod:`gr_ros2.gr.backfill`); no topic has it."""
INTERNAL_TYPES = (CALLS_TYPE, FILLER_TYPE, BACKFILL_TYPE)

_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/(?:msg/)?([A-Za-z][A-Za-z0-9_]*)")
_FEEDBACK = re.compile(r"[A-Za-z][A-Za-z0-9_]*/action/[A-Za-z][A-Za-z0-9]*_FeedbackMessage")
_LATCHED = frozenset({"tf_static", "map", "robot_description"})
"""Topics that ROS programs publish transient-local by convention."""
_TF_TYPE = "tf2_msgs/msg/TFMessage"
_LONGEST_ID = 255
_CALLS_LAST_S = 3600.0
"""s after which a request or a reply is not sent any more, whatever its own deadline."""
_CALLS_WAITING = 256
"""Requests and replies that may wait to be sent."""


def normalize_type(text: str) -> str:
    """``nav_msgs/Odometry`` or ``nav_msgs/msg/Odometry`` as ``nav_msgs/msg/Odometry``.

    The type of an action's feedback, ``nav2_msgs/action/NavigateToPose_FeedbackMessage``, is returned unchanged.

    :raises ConfigError: when it has none of these forms
    """
    if _FEEDBACK.fullmatch(text):
        return text
    match = _TYPE.fullmatch(text)
    if match is None:
        raise ConfigError(f"malformed type {text!r}; write package/Type or package/msg/Type")
    return f"{match[1]}/msg/{match[2]}"


@dataclass(frozen=True, slots=True)
class Topic:
    """One row.

    :param topic_id: its number on the wire
    :param name: as registered, relative to the robot's namespace or absolute with leading slash
    :param type_name: ``package/msg/Type``; ``package/srv/Type`` in the row of a service
    :param publish_as: its name where it comes out, ``{robot}`` allowed; auto takes that of the receiver
    """

    topic_id: int
    name: str
    type_name: str
    options: SendOptions = DEFAULT_OPTIONS
    publish_as: str = AUTO

    def on_graph(self, namespace: str) -> str:
        """Absolute topic name of this row at a source in a namespace."""
        if self.name.startswith("/"):
            return self.name
        namespace = namespace.strip("/")
        return f"/{namespace}/{self.name}" if namespace else f"/{self.name}"

    def republished(self, namespace_format: str, src_id: int) -> str:
        """Absolute topic name of this row at a sink, for one sender."""
        if self.publish_as != AUTO:
            name = filled(self.publish_as, src_id)
        else:
            name = f"{filled(namespace_format, src_id).rstrip('/')}/{self.name.lstrip('/')}"
        return name if name.startswith("/") else f"/{name}"

    @property
    def stream(self) -> tuple[str, str, int | Auto, bool]:
        """What has a topic id of its own: name, type, the robot that it is for, and whether it leaves as frames."""
        return self.name.lstrip("/"), self.type_name, self.options.to, self.as_frames

    @property
    def latched(self) -> bool:
        """Whether late joiners get the last message: because the registry says so, or by ROS convention."""
        if self.options.durability != AUTO:
            return self.options.durability == "transient_local"
        return self.name.rsplit("/", 1)[-1] in _LATCHED or self.name.endswith(f"/{STATUS}")

    @property
    def as_frames(self) -> bool:
        """Whether its messages leave as frames that fit the air (:mod:`gr_ros2.link.frames`), where the robot can code
        them. Those of latched maps do, too, which depends on their publishers."""
        options = self.options
        if self.latched or options.keep_s > 0 or options.codec != AUTO:
            return False
        return options.cloud.fit if self.type_name == CLOUD else self._is_video

    @property
    def _is_video(self) -> bool:
        return self.type_name in PICTURES and not self.options.passes_pictures

    @property
    def is_service(self) -> bool:
        """Whether this row names a service."""
        return is_service(self.type_name)

    @property
    def of_node(self) -> bool:
        """Whether this row names a service that ROS itself gives to nodes, below the name of its node."""
        return is_of_node(self.name, self.type_name)

    @property
    def action(self) -> str:
        """Name of the action that this row is a part of; '' if it is no part of one."""
        return self.name.rpartition(OF_ACTION)[0]

    @property
    def is_topic(self) -> bool:
        """Whether this row names a topic: neither a service, nor a row of this link's own."""
        return self.type_name not in INTERNAL_TYPES and not self.is_service


NewTopic = tuple[str, str, SendOptions]
"""Name, type and options of a row that has no number yet."""


class Registry(Sequence[Topic]):
    """At most ``MAX_TOPICS`` topics, indexed by topic id.

    :raises RegistryError: too many, none, or duplicate names
    """

    def __init__(self, topics: Sequence[Topic], path: str | Path | None = None) -> None:
        if not topics:
            raise RegistryError("no topics; add rows of the form name,type", path)
        if len(topics) > MAX_TOPICS:
            raise RegistryError(f"{len(topics)} topics; a link carries at most {MAX_TOPICS}", path)
        names: dict[str, Topic] = {}
        for topic in topics:
            same = names.setdefault(topic.name.lstrip("/"), topic)
            if same is not topic:
                raise RegistryError(f"duplicate topic {topic.name!r}", path)
        self._topics = tuple(topics)
        self._by_name = names

    @classmethod
    def empty(cls) -> Registry:
        """No topics: the registry of a robot that sends nothing and receives the topics that others announce."""
        made = cls.__new__(cls)
        made._topics, made._by_name = (), {}
        return made

    @classmethod
    def from_rows(cls, rows: Mapping[str, str] | Sequence[tuple[str, str]]) -> Registry:
        """A registry written in code: ``Registry.from_rows({"odom": "nav_msgs/Odometry"})``."""
        pairs = list(rows.items()) if isinstance(rows, Mapping) else list(rows)
        try:
            parts = [part for name, kind in pairs for part in _parts(name, kind, {})]
            return cls([_topic(number, *part) for number, part in enumerate(parts)])
        except RegistryError:
            raise
        except ConfigError as error:
            raise RegistryError(str(error)) from error

    @classmethod
    def from_csv(cls, path: str | Path) -> Registry:
        """Read the paper's form: rows ``name,type``.

        A header row ``topic,type`` (or ``name,type``), blank lines and ``#`` comments are allowed; with a header,
        further columns are options of that topic (see :class:`gr_ros2.settings.config.SendOptions`) and
        ``publish_as``, empty = default.

        :raises RegistryError: file, line, what is wrong
        """
        try:
            with open(path, newline="", encoding="utf-8-sig") as file:
                reader = csv.reader(file, skipinitialspace=True, strict=True)
                rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
        except (OSError, UnicodeDecodeError) as error:
            raise RegistryError(f"cannot be read ({reason(error)})", path) from error
        except csv.Error as error:
            raise RegistryError(f"no CSV ({error})", path, reader.line_num) from error
        return cls(list(_topics(rows, path)), path)

    def extended(self, topics: Sequence[NewTopic]) -> Registry:
        """These topics too, with the next numbers. A name may come again with another type, for another robot, or as
        frames.

        :raises RegistryError: too many, or a topic that is there already
        """
        added = [Topic(number, *topic) for number, topic in enumerate(topics, len(self))]
        if len(self) + len(added) > MAX_TOPICS:
            raise RegistryError(f"{len(self) + len(added)} topics; a link carries at most {MAX_TOPICS}")
        known = {topic.stream for topic in self}
        for topic in added:
            key = topic.stream
            if key in known:
                raise RegistryError(f"duplicate topic {topic.name!r}")
            known.add(key)
        together = Registry.empty()
        together._topics = (*self, *added)
        together._by_name = {**self._by_name, **{topic.name.lstrip("/"): topic for topic in added}}
        return together

    def __len__(self) -> int:
        return len(self._topics)

    @overload
    def __getitem__(self, index: int) -> Topic: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Topic]: ...
    def __getitem__(self, index: int | slice) -> Topic | Sequence[Topic]:
        return self._topics[index]

    def __iter__(self) -> Iterator[Topic]:
        return iter(self._topics)

    def named(self, name: str) -> Topic:
        """The row of that name, with or without leading slash.

        :raises ConfigError: when there is no such row
        """
        try:
            return self._by_name[name.lstrip("/")]
        except KeyError:
            raise ConfigError(
                f"topic {name!r} is not in the registry; it has {', '.join(topic.name for topic in self)}"
            ) from None

    def chosen(self, words: Sequence[str]) -> list[Topic]:
        """The rows that the setting ``topics`` chooses, with or without leading slash; all rows if there is no word.

        An action is chosen as a whole, by its name.

        :raises ConfigError: for a name that is not in the registry
        """
        if not words or tuple(words) == (AUTO,):
            return list(self)
        choice = TopicChoice([word.replace("/", "", word.startswith(("/", "-/"))) for word in words], "")
        actions = {topic.action.lstrip("/") for topic in self if topic.action}
        for name in choice.named.values():
            if name not in actions:
                self.named(name)
        taken = set(choice.of([*actions, *(topic.name.lstrip("/") for topic in self)]))

        def is_chosen(topic: Topic) -> bool:
            name, action = topic.name.lstrip("/"), topic.action.lstrip("/")
            return name in taken or (action in taken and not choice.leaves_out(f"/{name}"))

        return [topic for topic in self if is_chosen(topic)]

    def with_options(
        self, options: Mapping[str, SendOptions] | Mapping[str, PublishOptions], *, announced: bool = False
    ) -> Registry:
        """The same rows, with configured options instead of the registry's own. Only settings that differ from the
        default replace the registry's.

        :param announced: whether options may also be of topics that other robots announce; those change nothing here
        :raises ConfigError: for a topic that is not registered, unless the registry is empty
        """
        if not self or not options:
            return self
        for name in options:
            if not (announced or is_wild(name) or name == AUTO):
                self.named(name)
        given: Mapping[str, SendOptions | PublishOptions] = {**options}
        return Registry([_with(topic, options_of(topic.name, given, DEFAULT_OPTIONS)) for topic in self])

    def with_calls(self) -> Registry:
        """The same rows, and one more in which requests and replies are sent.

        :raises RegistryError: when there is no room for one more
        """
        options = SendOptions(queue="deadline", deadline_s=_CALLS_LAST_S, queue_depth=_CALLS_WAITING)
        return Registry([*self._topics, Topic(len(self), "_calls", CALLS_TYPE, options)])

    @property
    def services(self) -> tuple[Topic, ...]:
        """The rows that name services."""
        return tuple(topic for topic in self if topic.is_service)

    @property
    def digest(self) -> str:
        """16 hex digits over what both ends must agree on: ids, names and types."""
        text = "\n".join(f"{topic.topic_id},{topic.name.lstrip('/')},{topic.type_name}" for topic in self)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def announced(told: AnnouncedTopic, options: Mapping[str, PublishOptions]) -> Topic:
    """A topic as its sender has announced it.

    :param options: configured options by topic name, which replace the announced ones
    :raises ConfigError: for a name or a type that ROS does not allow
    """
    if fault := topic_fault(told.name if told.name.startswith("/") else f"/{told.name}"):
        raise ConfigError(f"malformed topic name {told.name!r}: {fault}")
    special = told.type_name in INTERNAL_TYPES or is_service(told.type_name)
    offered = build(
        SendOptions, {"durability": "transient_local" if told.latched else "volatile", "depth": told.depth or AUTO}
    )
    topic = Topic(told.topic_id, told.name, told.type_name if special else normalize_type(told.type_name), offered)
    return _with(topic, options_of(told.name, options, PublishOptions()))


def _with(topic: Topic, configured: SendOptions | PublishOptions) -> Topic:
    default = type(configured)()
    changed = {f.name: getattr(configured, f.name) for f in fields(configured)}
    changed = {name: value for name, value in changed.items() if value != getattr(default, name)}
    publish_as = changed.pop("as_", topic.publish_as)
    options = topic.options
    if changed:
        options = build(SendOptions, {**asdict(options), **changed}, f"topic {topic.name}")
    return Topic(topic.topic_id, topic.name, topic.type_name, options, publish_as)


def options_of(name: str, options: Mapping[str, _O], default: _D) -> _O | _D:
    """The configured options of a topic, with or without leading slash: its own, or else those of the first word that
    stands for it too."""
    plain = {other.lstrip("/"): value for other, value in options.items()}
    name = name.lstrip("/")
    words = (word for word in plain if fnmatchcase(name, "*" if word == AUTO else word))
    return plain[name] if name in plain else plain.get(next(words, ""), default)


def check_outputs(registry: Registry, publish: PublishConfig, *, announced: bool = True) -> None:
    """Refuse settings with which a robot could not publish what it receives.

    :param announced: see :meth:`Registry.with_options`
    :raises ConfigError: if a topic would be published under a name that ROS does not allow, or two topics of different
        types under one name
    """
    types = dict.fromkeys(publish.merged_topics, _TF_TYPE)
    for topic in registry.with_options(publish.topics, announced=announced):
        name = topic.republished(publish.as_, _LONGEST_ID)
        remedy = "change its publish_as, or publish.as"
        if fault := topic_fault(name):
            raise ConfigError(f"topic {topic.name!r} would come out as {name!r}: {fault}; {remedy}")
        if types.setdefault(name, topic.type_name) != topic.type_name:
            raise ConfigError(
                f"topic {topic.name!r} would come out as {name!r} of type {topic.type_name}, where {types[name]} comes "
                f"out already; {remedy}"
            )


def _topics(rows: Sequence[tuple[int, list[str]]], path: str | Path) -> Iterator[Topic]:
    columns = ["name", "type"]
    first = True
    topic_id = 0
    seen: dict[str, int] = {}
    for line, row in rows:
        if not any(row) or row[0].startswith("#"):
            continue
        if first and [cell.lower() for cell in row[:2]] in (["topic", "type"], ["name", "type"]):
            columns = [cell.lower() for cell in row]
            _check_columns(columns, path, line)
            first = False
            continue
        first = False
        if len(row) > len(columns) or len(row) < 2:
            raise RegistryError(f"{len(row)} columns where {len(columns)} were expected: {','.join(row)!r}", path, line)
        if row[0].lstrip("/") in seen:
            raise RegistryError(
                f"duplicate topic {row[0]!r}; it stands first in line {seen[row[0].lstrip('/')]}", path, line
            )
        seen[row[0].lstrip("/")] = line
        options = {key: cell for key, cell in zip(columns[2:], row[2:], strict=False) if cell}
        for part in _parts(row[0], row[1], options):
            if topic_id >= MAX_TOPICS:
                raise RegistryError(
                    f"topic {MAX_TOPICS + 1}, {part[0]!r}: a link carries at most {MAX_TOPICS}", path, line
                )
            try:
                yield _topic(topic_id, *part)
            except ConfigError as error:
                raise RegistryError(str(error), path, line) from error
            topic_id += 1


def _check_columns(columns: Sequence[str], path: str | Path, line: int) -> None:
    known = [*(field.name for field in fields(SendOptions)), "publish_as"]
    for column in columns[2:]:
        if column not in known:
            raise RegistryError(f"unknown column {column!r}; known are {', '.join(known)}", path, line)
        if columns.count(column) > 1:
            raise RegistryError(f"column {column!r} stands twice", path, line)


def _parts(name: str, kind: str, options: Mapping[str, str]) -> Iterator[tuple[str, str, Mapping[str, str]]]:
    """Name, type and options of the topics and services for which a row stands."""
    for part, type_name in parts(name, kind).items():
        own = dict(options)
        if "publish_as" in own:
            own["publish_as"] += part.removeprefix(name)
        yield part, type_name, own


def _topic(topic_id: int, name: str, kind: str, options: Mapping[str, str]) -> Topic:
    if fault := topic_fault(name if name.startswith("/") else f"/{name}"):
        raise ConfigError(f"malformed topic name {name!r}: {fault}")
    options = dict(options)
    publish_as = options.pop("publish_as", AUTO)
    try:
        type_name = kind if is_service(kind) else normalize_type(kind)
        topic_options = build(SendOptions, options)
        checked_topic_form(publish_as)
    except ConfigError as error:
        raise ConfigError(f"topic {name!r}: {error}") from error
    except ValueError as error:
        raise ConfigError(f"topic {name!r}: publish_as = {publish_as!r}: {error}") from error
    return Topic(topic_id, name, type_name, topic_options, publish_as)
