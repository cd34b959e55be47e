"""Changes some members of messages of any type, such as frame names or stamps, and nothing else.

Invariants: the message is encoded again as its type defines, and alignment gaps become zero. If ROS distributions
define a type differently, the definition that fits the bytes is used. A message that cannot be decoded passes unchanged
and is counted by name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, cast

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from gr_ros2.middleware.type_definitions import DAMAGED, typestores

HEADER = "std_msgs/msg/Header"
_LITTLE_ENDIAN = 1

Plan = tuple[tuple[str, bool, Any], ...]
"""Members that are changed or hold such: name, whether it is a sequence or array, and the plan of its content (None: it
is changed)."""


class ChangedMembers:
    """Messages of which some members are changed.

    :param what: what they are, in the names of ``counters``
    :param chosen: whether a member is changed: the type that it is in, its name, and whether it is a single text
    :param counters: counts messages that passed unchanged: ``WHAT_unknown_type`` (no definition of the type) and
        ``WHAT_damaged`` (the bytes are not a message of the type)
    """

    def __init__(self, what: str, chosen: Callable[[str, str, bool], bool], counters: Counter[str]) -> None:
        self._what, self._chosen, self._counters = what, chosen, counters
        self._plans: dict[str, list[tuple[Typestore, Plan]]] = {}
        """Plans by type name, one for each definition of the type; the most likely definition comes first."""

    def learn(self, type_name: str, store: Typestore) -> None:
        """Use a definition of a type that was not known, or in preference to those that were."""
        self._plans[type_name] = [(store, self._plan(store, type_name)), *self._plans_of(type_name)]

    def apply(self, type_name: str, payload: bytes, change: Callable[[Any, str], None]) -> bytes:
        """The message with changed members, or the unchanged message.

        :param change: changes a member, by the part of the message that it is in and by its name
        """
        plans = self._plans_of(type_name)
        if not plans:
            self._counters[f"{self._what}_unknown_type"] += 1
            return payload
        if not any(plan for _, plan in plans):
            return payload
        for store, plan in plans:
            message = decoded(store, type_name, payload)
            if message is not None:
                _change(message, plan, change)
                return encoded(store, type_name, message, payload)
        self._counters[f"{self._what}_damaged"] += 1
        return payload

    def leads(self, type_name: str, member: str) -> bool:
        """Whether all that is changed in messages of a type is this member of the Header with which they begin."""
        plans = self._plans_of(type_name)
        return bool(plans) and all(
            plan == ((store.fielddefs[type_name][1][0][0], False, ((member, False, None),)),)
            and store.fielddefs[type_name][1][0][1][1] == HEADER
            for store, plan in plans
        )

    def _plans_of(self, type_name: str) -> list[tuple[Typestore, Plan]]:
        plans = self._plans.get(type_name)
        if plans is None:
            plans = [(store, self._plan(store, type_name)) for store in typestores(type_name)]
            self._plans[type_name] = plans
        return plans

    def _plan(self, store: Typestore, type_name: str) -> Plan:
        """The members of a message type that are changed or hold such; () if there are none."""
        plan: list[tuple[str, bool, Any]] = []
        for name, described in store.fielddefs[type_name][1]:
            kind, detail = cast("tuple[Nodetype, Any]", described)
            repeated = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
            if repeated:
                kind, detail = detail[0]
            if self._chosen(type_name, name, not repeated and kind is Nodetype.BASE and detail[0] == "string"):
                plan.append((name, False, None))
            elif kind is Nodetype.NAME and (inner := self._plan(store, detail)):
                plan.append((name, repeated, inner))
        return tuple(plan)


def decoded(store: Typestore, type_name: str, payload: bytes) -> Any:
    """The decoded message; None if the bytes are not a message of the type."""
    if len(payload) < 5 or payload[0] or payload[1] > _LITTLE_ENDIAN:
        return None
    try:
        return store.deserialize_cdr(payload, type_name)
    except DAMAGED:
        return None


def encoded(store: Typestore, type_name: str, message: Any, like: bytes) -> bytes:
    """The bytes of a message, in the byte order of ``like``."""
    return bytes(store.serialize_cdr(message, type_name, little_endian=like[1] == _LITTLE_ENDIAN))


def _change(message: Any, plan: Plan, change: Callable[[Any, str], None]) -> None:
    for name, repeated, inner in plan:
        if inner is None:
            change(message, name)
            continue
        value = getattr(message, name)
        for part in value if repeated else (value,):
            _change(part, inner, change)
