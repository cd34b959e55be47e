"""Topics that many things share, taken apart by *instance*, as DDS calls it, and joined again.

``/tf`` carries transforms of many frames, ``/diagnostics`` the state of many devices: "the newest message" or "5
messages/s" means nothing for such a topic unless it is counted for each of them. The key of an instance is what a
message says of itself in some fields: ``transforms[].child_frame_id`` is one key for each element of ``transforms``.

Invariants: the parts of a message in which no key comes twice, joined in order, are the message again, but for
alignment gaps and the order of bytes; a message without elements has no parts and no instances; a key is made of
numbers, texts and tuples of such.
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from gr_ros2.codecs.messages import store
from gr_ros2.core.errors import ConfigError, DamagedError
from gr_ros2.middleware.type_definitions import DAMAGED
from gr_ros2.settings.registry import Topic

FIELDS = {
    "tf2_msgs/msg/TFMessage": "transforms[].child_frame_id",
    "diagnostic_msgs/msg/DiagnosticArray": "status[].name",
    "sensor_msgs/msg/JointState": "name",
    "sensor_msgs/msg/MultiDOFJointState": "joint_names",
    "visualization_msgs/msg/Marker": "ns, id",
    "visualization_msgs/msg/MarkerArray": "markers[].ns, markers[].id",
}
"""The fields that tell the instances of a type apart, by type."""

Key = Hashable
NONE = "none"
"""Instead of fields: messages are not told apart."""
_log = logging.getLogger(__name__)


class InstancePart(NamedTuple):
    """What a message says of one instance.

    :param message: a message of the same type, with this one element where instances are elements
    """

    key: Key
    message: bytes


@dataclass(frozen=True)
class _Path:
    """:param names: of a field, from the message or from an element down"""

    names: tuple[str, ...]

    def of(self, value: Any) -> Key:
        for name in self.names:
            value = getattr(value, name)
        if isinstance(value, np.ndarray):
            return tuple(value.tolist())
        return tuple(value) if isinstance(value, list) else value


class Instances:
    """The instances of a type.

    :param fields: paths, separated by commas, such as ``name`` or ``list[].id``; '' = those of ``FIELDS``
    :param types: with the definition of the type; None = those that ROS ships
    :raises ConfigError: for a type that has none and no fields given, or a path that the type does not have
    """

    def __init__(self, type_name: str, fields: str = "", types: Typestore | None = None) -> None:
        self._type, self._types = type_name, types or store()
        text = fields or FIELDS.get(type_name, "")
        if not text:
            raise ConfigError(f"instance: {type_name} is not known to have instances; name the field that is the key")
        if type_name not in self._types.fielddefs:
            raise ConfigError(f"instance: {type_name} is not defined here")
        heads, paths = [], []
        for path in (part.strip() for part in text.split(",")):
            head, found, rest = path.partition("[].")
            if not found:
                head, rest = "", path
            heads.append(head)
            paths.append(_Path(tuple(rest.split("."))))
        if len(set(heads)) != 1 or "." in heads[0]:
            raise ConfigError(f"instance: {text!r} is not one list of the message, or fields beside any list")
        self._list, self._paths = heads[0], paths
        self._check(text)
        self.separate = not self._list or len(self._types.fielddefs[type_name][1]) > 1

    def keys(self, message: bytes) -> tuple[Key, ...]:
        """The key of each instance of a message, in order.

        :raises DamagedError: not a message of the type
        """
        value = self._read(message)
        return tuple(map(self._key, getattr(value, self._list) if self._list else [value]))

    def parts(self, message: bytes) -> list[InstancePart]:
        """The message taken apart. Where a key comes twice, so does it here.

        :raises DamagedError: not a message of the type
        """
        value = self._read(message)
        if not self._list:
            return [InstancePart(self._key(value), message)]
        found = []
        for element in getattr(value, self._list):
            alone = copy(value)
            setattr(alone, self._list, [element])
            found.append(InstancePart(self._key(element), bytes(self._types.serialize_cdr(alone, self._type))))
        return found

    def joined(self, parts: Iterable[InstancePart]) -> list[bytes]:
        """As few messages as may carry some parts: those whose other fields, such as a header's stamp, are equal are
        one message; a key comes at most once in it, and its last part counts.

        :raises DamagedError: for a part that is not a message of the type
        """
        if not self._list:
            return list({part.key: part.message for part in parts}.values())
        groups: dict[bytes, tuple[Any, dict[Key, Any]]] = {}
        for part in parts:
            value = self._read(part.message)
            _, found = groups.setdefault(self._rest(value), (value, {}))
            for element in getattr(value, self._list):
                found.pop(self._key(element), None)
                found[self._key(element)] = element
        made = []
        for value, found in groups.values():
            setattr(value, self._list, list(found.values()))
            made.append(bytes(self._types.serialize_cdr(value, self._type)))
        return made

    def merged(self, waiting: Sequence[bytes], message: bytes) -> bytes:
        """A message with what it and those before it say of each instance. Messages whose other fields differ are left
        out.

        :raises DamagedError: not messages of the type
        """
        if not self._list:
            return message
        value = self._read(message)
        rest, elements = self._rest(value), getattr(value, self._list)
        found: dict[Key, Any] = {}
        for earlier in map(self._read, waiting):
            if self._rest(earlier) == rest:
                found |= {self._key(element): element for element in getattr(earlier, self._list)}
        new = {self._key(element) for element in elements}
        older = [element for key, element in found.items() if key not in new]
        if not older:
            return message
        setattr(value, self._list, [*older, *elements])
        return bytes(self._types.serialize_cdr(value, self._type))

    def _rest(self, value: Any) -> bytes:
        """What a message says beside its elements."""
        alone = copy(value)
        setattr(alone, self._list, [])
        return bytes(self._types.serialize_cdr(alone, self._type))

    def _key(self, value: Any) -> Key:
        found = tuple(path.of(value) for path in self._paths)
        return found if len(found) > 1 else found[0]

    def _read(self, message: bytes) -> Any:
        try:
            return self._types.deserialize_cdr(message, self._type)
        except DAMAGED as error:
            raise DamagedError(f"damaged message: not a {self._type} ({' '.join(str(error).split())})") from error

    def _check(self, text: str) -> None:
        """Follow each path through the definitions."""
        for path in self._paths:
            type_name = self._type
            kind: Any = (Nodetype.NAME, type_name)
            for step, name in enumerate((*filter(None, [self._list]), *path.names)):
                members = dict(self._types.fielddefs[kind[1]][1]) if kind[0] == Nodetype.NAME else {}
                if name not in members:
                    raise ConfigError(f"instance: {self._type} has no field {text!r}; there is no {name!r}")
                kind = members[name]
                if step == 0 and self._list:
                    if kind[0] not in (Nodetype.ARRAY, Nodetype.SEQUENCE) or kind[1][0][0] != Nodetype.NAME:
                        raise ConfigError(f"instance: {self._list} of {self._type} is not a list of messages")
                    kind = kind[1][0]
            if kind[0] == Nodetype.NAME or (kind[0] != Nodetype.BASE and kind[1][0][0] == Nodetype.NAME):
                raise ConfigError(f"instance: {text!r} of {self._type} is a message, not a number or a text")


def instances_of(topic: Topic, definitions: Mapping[str, Any] | None = None) -> Instances | None:
    """The instances of a topic that a robot sends; None where it has none, or its type is not known yet.

    :param definitions: of its type and of those that it is made of, in the form of rosbags; None = those that ROS ships
    :raises ConfigError: for a path that the type does not have
    """
    fields = topic.options.instance
    if fields == NONE or not (fields or topic.type_name in FIELDS):
        return None
    types = store()
    if definitions is not None:
        types = get_typestore(Stores.EMPTY)
        types.register(dict(definitions))
    if topic.type_name not in types.fielddefs:
        return None
    try:
        return Instances(topic.type_name, fields, types)
    except ConfigError as error:
        if definitions is None:
            raise ConfigError(f"topic {topic.name}: {error}") from None
        _log.warning("topic %s: %s; its messages are not told apart", topic.name, error)
        return None
