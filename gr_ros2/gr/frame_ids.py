"""Frame names of several robots on one graph: a prefix per sender, and all their transforms on one topic (REP 105).

Invariants: only the frame names of a message change. The message is encoded again as its type defines, and alignment
gaps become zero. If ROS distributions define a type differently, the definition that fits the bytes is used. A frame
name that already has the prefix stays as it is; an empty one stays empty. A message that cannot be decoded passes
unchanged and is counted by name. The newest static transform of each child frame is kept, for at most ``MAX_STATIC``
frames.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, cast

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from gr_ros2.core.names import filled
from gr_ros2.middleware import Middleware, Qos
from gr_ros2.middleware.type_definitions import DAMAGED, typestores

TF_TYPE = "tf2_msgs/msg/TFMessage"
MAX_STATIC = 4096
"""Number of static transforms kept for late joiners. Those of further child frames are published once and counted."""

_HEADER = "std_msgs/msg/Header"
_ENDING = "_frame_id"
"""The ending of members that hold a frame name: child_frame_id, body_frame_id, reference_frame_id."""
_LITTLE_ENDIAN = 1
_TF_DEPTH = 100

Plan = tuple[tuple[str, bool, Any], ...]
"""Members that hold frame names: name, whether it is a sequence or array, and the plan of its content (None: a frame
name)."""


def prefixed_frame(prefix: str, frame: str) -> str:
    """A frame name with a prefix, without the leading slash that tf2 forbids."""
    if not frame or frame.startswith(prefix):
        return frame
    return prefix + frame.lstrip("/")


class FramePrefix:
    """Adds a prefix to the frame names of messages: ``frame_id`` of every Header, and every ``…_frame_id``.

    :param form: the prefix, in which ``{robot}`` is the sender; '' changes nothing
    :param counters: counts messages that passed unchanged: ``frame_unknown_type`` (no definition of the type) and
        ``frame_damaged`` (the bytes are not a message of the type)
    """

    def __init__(self, form: str, counters: Counter[str]) -> None:
        self._form = form
        self._counters = counters
        self._plans: dict[str, list[tuple[Typestore, Plan]]] = {}
        """Plans by type name, one for each definition of the type; the most likely definition comes first."""

    def learn(self, type_name: str, store: Typestore) -> None:
        """Use a definition of a type that was not known, or in preference to those that were."""
        self._plans[type_name] = [(store, _plan(store, type_name)), *self._plans_of(type_name)]

    def apply(self, type_name: str, src_id: int, payload: bytes) -> bytes:
        """The message with prefixed frame names, or the unchanged message."""
        if not self._form:
            return payload
        plans = self._plans_of(type_name)
        if not plans:
            self._counters["frame_unknown_type"] += 1
            return payload
        if not any(plan for _, plan in plans):
            return payload
        for store, plan in plans:
            message = _decode(store, type_name, payload)
            if message is not None:
                _rename(message, plan, filled(self._form, src_id))
                return _encode(store, type_name, message, payload)
        self._counters["frame_damaged"] += 1
        return payload

    def _plans_of(self, type_name: str) -> list[tuple[Typestore, Plan]]:
        plans = self._plans.get(type_name)
        if plans is None:
            plans = self._plans[type_name] = [(store, _plan(store, type_name)) for store in typestores(type_name)]
        return plans


STATIC_DEPTH = 100
"""Smallest queue depth of a subscription to static transforms, as in tf2's listener. All broadcasters share this depth,
and each of them publishes different transforms. A DDS drops further messages without notice."""


class StaticTransforms:
    """All static transforms of several broadcasters. Each broadcaster knows only its own.

    :param counters: counts ``tf_damaged`` (bytes that are not a message) and ``tf_static_full`` (transforms not kept)
    """

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._newest: dict[str, Any] = {}  # by child frame
        self._store = typestores(TF_TYPE)[0]

    def union(self, payload: bytes) -> bytes | None:
        """A message with all transforms so far, including those in ``payload``; None if ``payload`` is not a message.

        A ``payload`` that already has all transforms is returned unchanged.
        """
        message = _decode(self._store, TF_TYPE, payload)
        if message is None:
            self._counters["tf_damaged"] += 1
            return None
        news = {transform.child_frame_id: transform for transform in message.transforms}
        for child, transform in news.items():
            if child in self._newest or len(self._newest) < MAX_STATIC:
                self._newest[child] = transform
            else:
                self._counters["tf_static_full"] += 1
        if self._newest.keys() <= news.keys():
            return payload
        message.transforms = list({**self._newest, **news}.values())
        return _encode(self._store, TF_TYPE, message, payload)


class MergedTransforms:
    """One topic with the transforms of all robots, and one latched topic with all their static transforms.

    :param topics: absolute names of the two, the moving transforms first
    :param counters: see :class:`StaticTransforms`
    """

    def __init__(self, topics: tuple[str, ...], middleware: Middleware, counters: Counter[str]) -> None:
        self._static = StaticTransforms(counters)
        moving, static = topics
        self._moving_publisher = middleware.advertise(moving, TF_TYPE, Qos("reliable", "volatile", _TF_DEPTH))
        self._static_publisher = middleware.advertise(static, TF_TYPE, Qos("reliable", "transient_local", 1))

    def add(self, payload: bytes, *, static: bool) -> None:
        """Publish the transforms of one robot's message. Its frame names already have the prefix.

        :raises MiddlewareError: when publishing fails
        """
        if not static:
            self._moving_publisher.publish(payload)
            return
        union = self._static.union(payload)
        if union is not None:
            self._static_publisher.publish(union)

    def close(self) -> None:
        """Close both publishers."""
        self._moving_publisher.close()
        self._static_publisher.close()


def _plan(store: Typestore, type_name: str) -> Plan:
    """The members of a message type that hold frame names; () if there are none."""
    plan: list[tuple[str, bool, Any]] = []
    for name, described in store.fielddefs[type_name][1]:
        kind, detail = cast("tuple[Nodetype, Any]", described)
        repeated = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        if repeated:
            kind, detail = detail[0]
        if kind is Nodetype.NAME:
            if inner := _plan(store, detail):
                plan.append((name, repeated, inner))
        elif (
            not repeated
            and detail[0] == "string"
            and (name.endswith(_ENDING) or (type_name, name) == (_HEADER, "frame_id"))
        ):
            plan.append((name, False, None))
    return tuple(plan)


def _rename(message: Any, plan: Plan, prefix: str) -> None:
    for name, repeated, inner in plan:
        value = getattr(message, name)
        if inner is None:
            setattr(message, name, prefixed_frame(prefix, value))
            continue
        for part in value if repeated else (value,):
            _rename(part, inner, prefix)


def _decode(store: Typestore, type_name: str, payload: bytes) -> Any:
    """The decoded message; None if the bytes are not a message of the type."""
    if len(payload) < 5 or payload[0] or payload[1] > _LITTLE_ENDIAN:
        return None
    try:
        return store.deserialize_cdr(payload, type_name)
    except DAMAGED:
        return None


def _encode(store: Typestore, type_name: str, message: Any, like: bytes) -> bytes:
    """The bytes of a message, in the byte order of ``like``."""
    return bytes(store.serialize_cdr(message, type_name, little_endian=like[1] == _LITTLE_ENDIAN))
