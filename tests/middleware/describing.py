"""A node's side of ``get_type_description``: replies for any types, serialized as a node does."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
_FORMS = {Nodetype.ARRAY: 48, Nodetype.SEQUENCE: 144}
_NUMBERS = {
    "int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9, "float32": 10,
    "float64": 11, "char": 3, "bool": 15, "byte": 16, "string": 17, "wstring": 18,
}  # fmt: skip
_INTERFACES = "type_description_interfaces"
_RESPONSE = f"{_INTERFACES}/msg/Reply"
STORE.register(
    get_types_from_msg(
        f"bool successful\nstring failure_reason\n{_INTERFACES}/TypeDescription type_description\n"
        f"{_INTERFACES}/TypeSource[] type_sources\n{_INTERFACES}/KeyValue[] extra_information",
        _RESPONSE,
    )
)


def needed(types: Typesdict, type_name: str) -> Typesdict:
    """A type and those that it is made of."""
    found: Typesdict = {}

    def add(name: str) -> None:
        if name not in found:
            found[name] = types[name]
            for _, kind in types[name][1]:
                single = kind[1][0] if kind[0] in _FORMS else kind
                if single[0] == Nodetype.NAME:
                    add(single[1])

    add(type_name)
    return found


def description(types: Typesdict, type_name: str) -> Any:
    """A ``TypeDescription``."""
    kinds = {part: STORE.types[f"{_INTERFACES}/msg/{part}"] for part in ("Field", "FieldType")}

    def one(name: str) -> Any:
        members = types[name][1] or [("structure_needs_at_least_one_member", (Nodetype.BASE, ("uint8", 0)))]
        fields = [kinds["Field"](member, kinds["FieldType"](*_told(kind)), "") for member, kind in members]
        return STORE.types[f"{_INTERFACES}/msg/IndividualTypeDescription"](name, fields)

    others = [one(name) for name in sorted(needed(types, type_name)) if name != type_name]
    return STORE.types[f"{_INTERFACES}/msg/TypeDescription"](one(type_name), others)


def reply(types: Typesdict, type_name: str, *, failure: str = "") -> bytes:
    """The serialized reply of a node that knows these types."""
    whole = description(types, type_name)
    return bytes(STORE.serialize_cdr(STORE.types[_RESPONSE](not failure, failure, whole, [], []), _RESPONSE))


def _told(kind: FieldDesc) -> tuple[int, int, int, str]:
    form = capacity = 0
    single: Any = kind
    if kind[0] in _FORMS:
        single, capacity = kind[1]
        form = 96 if kind[0] == Nodetype.SEQUENCE and capacity else _FORMS[kind[0]]
    if single[0] == Nodetype.NAME:
        return form + 1, capacity, 0, single[1]
    name, bound = single[1]
    return form + (21 if bound and name == "string" else _NUMBERS[name]), capacity, bound, ""


CUSTOM = "robot_msgs/msg/WheelState"
CUSTOM_TEXT = "std_msgs/Header header\nstring[] names\nfloat64[4] speeds\ngeometry_msgs/Quaternion tilt\nint32 mode\n"
OTHER_TEXT = "std_msgs/Header header\nfloat64[4] speeds\nstring[] names\n"
"""Another version of it."""


def types_of(text: str) -> Typesdict:
    """All types of ROS, and the custom one as a text defines it."""
    return {**STORE.fielddefs, **get_types_from_msg(text, CUSTOM)}


def hash_of_text(text: str) -> str:
    """RIHS01 hash of the custom type."""
    store = Typestore()
    store.fielddefs = types_of(text)
    return store.hash_rihs01(CUSTOM)


def message(number: int, *, frame: str = "base") -> bytes:
    """A serialized message of the custom type."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(CUSTOM_TEXT, CUSTOM))
    kinds: Any = store.types
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](1000 + number, 5), frame)
    tilt = kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    speeds = np.array([number / 8, 1.0, 2.0, 3.0])
    made = kinds[CUSTOM](header, ["left", "right"], speeds, tilt, number)
    return bytes(store.serialize_cdr(made, CUSTOM))
