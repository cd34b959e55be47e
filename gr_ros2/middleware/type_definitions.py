"""Message definitions of the types ROS ships, for those places that want more than bytes: bags and type hashes.

Law: a type that is not known is no error anywhere; it has no definition, and its bytes pass all the same.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from functools import cache

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

UNKNOWN = "# The definition of this type was not known where it was recorded; the bytes are complete.\n"
"""Stands in a bag for a definition nobody had. It parses as a type without members."""

DAMAGED = (SerdeError, struct.error, ValueError, IndexError, AssertionError, OverflowError, MemoryError)
"""What deserializing arbitrary bytes as a type may raise."""


@cache
def typestore() -> Typestore:
    """The types of the sourced ROS distribution, Humble's where none is sourced or rosbags has none of that name."""
    name = f"ROS2_{os.environ.get('ROS_DISTRO', 'humble').upper()}"
    return get_typestore(Stores[name] if name in Stores.__members__ else Stores.ROS2_HUMBLE)


def known(type_name: str) -> bool:
    """Whether ROS ships ``package/msg/Type``."""
    return type_name in typestore().fielddefs


def definition(type_name: str, custom: Mapping[str, str] | None = None) -> tuple[str, str]:
    """The ``.msg`` text (with what it depends on) and the RIHS01 hash of a type.

    :param custom: texts of further types by name
    """
    text = (custom or {}).get(type_name)
    if text is None:
        if known(type_name):
            return typestore().generate_msgdef(type_name, ros_version=2)[0], type_hash(type_name)
        text = UNKNOWN
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(typestore().fielddefs)
        store.register(get_types_from_msg(text, type_name))
        return text, str(store.hash_rihs01(type_name))
    except (TypesysError, KeyError):
        return definition(type_name, {type_name: UNKNOWN})


def type_hash(type_name: str) -> str:
    """RIHS01 hash of a type ROS ships (REP-2011), '' for others."""
    return str(typestore().hash_rihs01(type_name)) if known(type_name) else ""
