"""Message definitions, for the parts that need more than bytes: bags and type hashes.

Invariants: an unknown type is never an error; it has no definition, and its bytes pass anyway. A definition that came
with the messages takes precedence over the one that ROS ships under the same name: types change from one distribution
to the next.
"""

from __future__ import annotations

import os
import struct
from functools import cache
from typing import NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

UNKNOWN = "# The definition of this type was not known where it was recorded; the bytes are complete.\n"
"""Placeholder in a bag for an unknown definition. It parses as a type without members."""
_IDL = "=" * 80 + "\nIDL: "
"""First line of a definition in IDL, as rosbag2 writes it."""


MADE = {
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n"
    ),
}
"""Types that ROS does not ship and that pictures come out as, with their definitions."""
_UNSHIPPED = {*MADE, "rosbag2_interfaces/msg/MessagesLostEvent"}
"""Types that links publish and that rosbags does not have: to look for one loads every distribution of ROS."""


class Definition(NamedTuple):
    """The text of a type, with those of the types it is made of, and its RIHS01 hash (REP-2011)."""

    text: str
    digest: str


DAMAGED = (SerdeError, struct.error, ValueError, IndexError, AssertionError, OverflowError, MemoryError)
"""What deserializing arbitrary bytes as a type may raise."""


@cache
def typestore() -> Typestore:
    """The types of the sourced ROS distribution, Humble's where none is sourced or rosbags has none of that name."""
    name = f"ROS2_{os.environ.get('ROS_DISTRO', 'humble').upper()}"
    return get_typestore(Stores[name] if name in Stores.__members__ else Stores.ROS2_HUMBLE)


def known(type_name: str) -> bool:
    """Whether a distribution of ROS ships ``package/msg/Type``."""
    return _shipped(type_name) is not None


def _shipped(type_name: str) -> Typestore | None:
    """The types of the first distribution that has a type; others are loaded only if :func:`typestore` lacks it."""
    if type_name in typestore().fielddefs:
        return typestore()
    return None if type_name in _UNSHIPPED else next(iter(typestores(type_name)), None)


@cache
def typestores(type_name: str) -> tuple[Typestore, ...]:
    """The types of one distribution for every definition that ``package/msg/Type`` ever had in ROS.

    That of :func:`typestore` comes first, then the oldest. () where ROS has none.
    """
    found: dict[str, Typestore] = {}
    for store in (typestore(), *_distributions()):
        if type_name in store.fielddefs:
            found.setdefault(_hash(store, type_name), store)
    return tuple(found.values())


def ships(type_name: str, digest: str) -> bool:
    """Whether a distribution of ROS ships ``package/msg/Type`` with this hash."""
    return any(_hash(store, type_name) == digest for store in typestores(type_name))


def definition(type_name: str, text: str | None = None) -> Definition:
    """What a bag says about a type.

    :param text: of the type, None = as ROS ships it; one that cannot be read is as good as none
    """
    if text is None and (store := _shipped(type_name) or _made(type_name)) is not None:
        return Definition(store.generate_msgdef(type_name, ros_version=2)[0], _hash(store, type_name))
    digest = text_hash(type_name, text) if text is not None else ""
    return Definition(text, digest) if text is not None and digest else _unknown(type_name)


def recorded_definition(type_name: str, text: str, digest: str) -> Definition:
    """What a copy of a bag says about a type: the same as the bag, read or not; where that has no text, what fits.

    :param text: '' = the bag has none
    :param digest: RIHS01 hash, '' = the bag has none
    """
    if text:
        return Definition(text, digest or text_hash(type_name, text) or _unknown(type_name).digest)
    if known(type_name) and digest in ("", type_hash(type_name)):
        return definition(type_name)
    for store in typestores(type_name):
        if _hash(store, type_name) == digest:
            return Definition(store.generate_msgdef(type_name, ros_version=2)[0], digest)
    unknown = _unknown(type_name)
    return Definition(unknown.text, digest or unknown.digest)


def same_type(type_name: str, text: str, other: str) -> bool:
    """Whether two texts define the same, whatever their comments."""
    return text == other or "" != text_hash(type_name, text) == text_hash(type_name, other)


def type_hash(type_name: str) -> str:
    """RIHS01 hash of a type ROS ships, '' for others."""
    store = _shipped(type_name)
    return "" if store is None else _hash(store, type_name)


def text_hash(type_name: str, text: str) -> str:
    """RIHS01 hash of what a text defines, '' where it cannot be read; what it does not bring along is ROS's."""
    store = Typestore()
    try:
        own = get_types_from_idl(text) if text.startswith(_IDL) else _without_char(get_types_from_msg(text, type_name))
        store.fielddefs = {**_as_hashed(typestore()).fielddefs, **own}
        return str(store.hash_rihs01(type_name))
    except (TypesysError, KeyError, RecursionError):  # the last of a type within itself
        return ""


def _hash(store: Typestore, type_name: str) -> str:
    return str(_as_hashed(store).hash_rihs01(type_name))


@cache
def _as_hashed(store: Typestore) -> Typestore:
    """Types as their hashes are made."""
    hashed = Typestore()
    hashed.fielddefs = _without_char(store.fielddefs)
    return hashed


def _without_char(types: Typesdict) -> Typesdict:
    """Definitions from ``.msg`` texts as their hashes see them: rosidl_adapter makes ``char`` a uint8 of IDL.

    A ``char`` that stands in an IDL text is another type, and stays one.
    """
    return {
        name: (constants, [(field, _uint8_for_char(kind)) for field, kind in fields])
        for name, (constants, fields) in types.items()
    }


def _uint8_for_char(kind: FieldDesc) -> FieldDesc:
    if kind[0] == Nodetype.BASE:
        return (Nodetype.BASE, ("uint8", 0)) if kind[1][0] == "char" else kind
    if kind[0] == Nodetype.NAME:
        return kind
    element, count = kind[1]
    return (kind[0], (_uint8_for_char(element), count))  # type: ignore[return-value]


@cache
def _distributions() -> tuple[Typestore, ...]:
    """The types of every distribution of ROS 2, the oldest first."""
    return tuple(get_typestore(store) for store in Stores if store.name.startswith("ROS2_"))


@cache
def _made(type_name: str) -> Typestore | None:
    """One of ``MADE``, with what it is made of."""
    if type_name not in MADE:
        return None
    store = Typestore()
    store.register({**typestore().fielddefs, **get_types_from_msg(MADE[type_name], type_name)})
    return store


def _unknown(type_name: str) -> Definition:
    return Definition(UNKNOWN, text_hash(type_name, UNKNOWN))
