"""What a node says about a type: the service ``get_type_description``, which nodes have since ROS 2 Iron (REP-2016).

Invariants: pure functions; nothing is believed that does not have the asked hash; whatever a node replies, the only
error is a DescriptionError, and time and memory are bounded by the size of the reply.
"""

from __future__ import annotations

import hashlib
import json
import keyword
import re
from functools import cache
from typing import Any, NamedTuple, cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gr_ros2.core.errors import DescriptionError
from gr_ros2.middleware.services import DESCRIPTION_TYPE
from gr_ros2.middleware.type_definitions import DAMAGED

MAX_REPLY = 1 << 20
"""Bytes of the largest reply that is read."""
MAX_VALUES = 10_000
"""Most values of a message without counting the elements of sequences and arrays; a larger type is not used."""
MAX_DEPTH = 30
"""Most messages within each other."""

_REQUEST, _RESPONSE = (DESCRIPTION_TYPE.replace("/srv/", "/msg/") + f"_{part}" for part in ("Request", "Response"))
_REQUEST_TEXT = "string type_name\nstring type_hash\nbool include_type_sources\n"
_RESPONSE_TEXT = """\
bool successful
string failure_reason
type_description_interfaces/TypeDescription type_description
type_description_interfaces/TypeSource[] type_sources
type_description_interfaces/KeyValue[] extra_information
"""

_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*){2}", re.ASCII)
_MEMBER = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_NESTED, _BOUNDED_STRING = 1, 21
_BASE = {
    2: "int8", 3: "uint8", 4: "int16", 5: "uint16", 6: "int32", 7: "uint32", 8: "int64", 9: "uint64",
    10: "float32", 11: "float64", 13: "char", 15: "bool", 16: "byte", 17: "string", _BOUNDED_STRING: "string",
}  # fmt: skip
"""Names of the types that ROS messages consist of, by their numbers in type_description_interfaces/msg/FieldType. Wide
strings and long doubles are left out, as in :mod:`gr_ros2.compression`."""
_FORMS = 48
"""Numbers from one form of a member to the next."""
_SINGLE, _ARRAY, _BOUNDED_SEQUENCE = range(3)


class Described(NamedTuple):
    """A type as a node has described it.

    :param digest: its RIHS01 hash, which was computed from the definitions
    :param types: its definition and those of the types that it is made of
    """

    type_name: str
    digest: str
    types: Typesdict

    def store(self) -> Typestore:
        """A store of these types, which reads and writes their messages.

        :raises DescriptionError: a member is named like a word of Python
        """
        if words := [name for _, members in self.types.values() for name, _ in members if keyword.iskeyword(name)]:
            raise DescriptionError(f"{self.type_name}: member {words[0]!r} cannot be a name in Python")
        store = Typestore()
        store.register(self.types)
        return store


def request(type_name: str, digest: str) -> bytes:
    """The serialized request for a type.

    :param digest: its hash, ``RIHS01_…``
    """
    store = _messages()
    return bytes(store.serialize_cdr(store.types[_REQUEST](type_name, digest, include_type_sources=False), _REQUEST))


def read_reply(payload: bytes, type_name: str, digest: str) -> Described:
    """A type from the reply of a node.

    :param digest: the hash that was asked for
    :raises DescriptionError: the node does not know the type, describes another one, or the reply is damaged
    """
    if len(payload) > MAX_REPLY:
        raise DescriptionError(f"{type_name}: a description of {len(payload)} bytes; at most {MAX_REPLY} are read")
    try:
        reply: Any = _messages().deserialize_cdr(payload, _RESPONSE)
    except DAMAGED as error:
        raise DescriptionError(f"{type_name}: the description cannot be read ({type(error).__name__})") from error
    if not reply.successful:
        raise DescriptionError(f"{type_name}: the node gives no description ({reply.failure_reason})")
    description = reply.type_description
    name, found = description.type_description.type_name, hash_of(description)
    if (name, found) != (type_name, digest):
        raise DescriptionError(f"{type_name}: the node describes {name} of hash {found}, asked was {digest}")
    types = {one.type_name: _definition(one) for one in _parts(description)}
    _check_size(types, type_name)
    return Described(type_name, digest, types)


def hash_of(description: Any) -> str:
    """RIHS01 hash of a type_description_interfaces/msg/TypeDescription (REP-2016)."""

    def told(one: Any) -> dict[str, Any]:
        kinds = ("type_id", "capacity", "string_capacity", "nested_type_name")
        fields = [{"name": f.name, "type": {kind: getattr(f.type, kind) for kind in kinds}} for f in one.fields]
        return {"type_name": one.type_name, "fields": fields}

    first, *others = _parts(description)
    text = json.dumps({"type_description": told(first), "referenced_type_descriptions": [told(o) for o in others]})
    return "RIHS01_" + hashlib.sha256(text.encode()).hexdigest()


def _parts(description: Any) -> list[Any]:
    return [description.type_description, *description.referenced_type_descriptions]


def _definition(one: Any) -> tuple[list[Any], list[tuple[str, FieldDesc]]]:
    """A definition, in rosbags' form."""
    names = [field.name for field in one.fields]
    if not _TYPE_NAME.fullmatch(one.type_name) or not all(map(_MEMBER.fullmatch, names)):
        raise DescriptionError(f"{one.type_name!r}: a description with a name that ROS does not allow")
    if len(set(names)) != len(names) or not names:
        raise DescriptionError(f"{one.type_name}: a description without members, or with two of one name")
    return [], [(field.name, _kind(field.type, f"{one.type_name}.{field.name}")) for field in one.fields]


def _kind(told: Any, where: str) -> FieldDesc:
    form, number = divmod(told.type_id - 1, _FORMS)
    single: Any  # mypy takes pairs of alternatives for alternatives of pairs
    kind: Any
    if number + 1 == _NESTED:
        single = (Nodetype.NAME, told.nested_type_name)
    elif number + 1 in _BASE:
        single = (Nodetype.BASE, (_BASE[number + 1], told.string_capacity if number + 1 == _BOUNDED_STRING else 0))
    else:
        raise DescriptionError(f"{where}: members of kind {told.type_id} are not read here")
    if form == _SINGLE:
        kind = single
    elif form == _ARRAY:
        kind = (Nodetype.ARRAY, (single, told.capacity))
    else:
        kind = (Nodetype.SEQUENCE, (single, told.capacity if form == _BOUNDED_SEQUENCE else 0))
    return cast("FieldDesc", kind)


def _check_size(types: Typesdict, type_name: str) -> None:
    """Refuse types that are not described, contain themselves, or have too many values.

    :raises DescriptionError: such a type
    """
    sizes: dict[str, int] = {}

    def size(name: str, depth: int) -> int:
        if name not in types or depth > MAX_DEPTH:
            raise DescriptionError(f"{type_name}: {name} is not described, or more than {MAX_DEPTH} deep")
        if name not in sizes:
            sizes[name] = sum(_size_of(kind, depth) for _, kind in types[name][1])
            if sizes[name] > MAX_VALUES:
                raise DescriptionError(f"{type_name}: {name} has more than {MAX_VALUES} values")
        return sizes[name]

    def _size_of(kind: FieldDesc, depth: int) -> int:
        if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            return _size_of(kind[1][0], depth)
        return size(str(kind[1]), depth + 1) if kind[0] == Nodetype.NAME else 1

    size(type_name, 0)


@cache
def _messages() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in ((_REQUEST, _REQUEST_TEXT), (_RESPONSE, _RESPONSE_TEXT)):
        store.register(get_types_from_msg(text, name))
    return store
