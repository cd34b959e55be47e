"""Frame names of several robots on one graph: a prefix per sender, and all their transforms on one topic (REP 105).

Invariants: only the frame names of a message change (:mod:`gr_ros2.gr.members`). A frame name that already has the
prefix stays as it is; an empty one stays empty. The newest static transform of each child frame is kept, for at most
``MAX_STATIC`` frames.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from rosbags.typesys.store import Typestore

from gr_ros2.core.names import filled
from gr_ros2.gr.members import HEADER, ChangedMembers, decoded, encoded
from gr_ros2.middleware import Middleware, Qos
from gr_ros2.middleware.type_definitions import typestores

TF_TYPE = "tf2_msgs/msg/TFMessage"
MAX_STATIC = 4096
"""Number of static transforms kept for late joiners. Those of further child frames are published once and counted."""

_ENDING = "_frame_id"
"""The ending of members that hold a frame name: child_frame_id, body_frame_id, reference_frame_id."""
_TF_DEPTH = 100
STATIC_DEPTH = 100
"""Smallest queue depth of a subscription to static transforms, as in tf2's listener. All broadcasters share this depth,
and each of them publishes different transforms. A DDS drops further messages without notice."""


def prefixed_frame(prefix: str, frame: str) -> str:
    """A frame name with a prefix, without the leading slash that tf2 forbids."""
    if not frame or frame.startswith(prefix):
        return frame
    return prefix + frame.lstrip("/")


class FramePrefix:
    """Adds a prefix to the frame names of messages: ``frame_id`` of every Header, and every ``…_frame_id``.

    :param form: the prefix, in which ``{robot}`` is the sender; '' changes nothing
    :param counters: counts messages that passed unchanged, see :class:`ChangedMembers`
    """

    def __init__(self, form: str, counters: Counter[str]) -> None:
        self._form = form
        self._members = ChangedMembers("frame", _is_frame, counters)

    def learn(self, type_name: str, store: Typestore) -> None:
        """Use a definition of a type that was not known, or in preference to those that were."""
        self._members.learn(type_name, store)

    def apply(self, type_name: str, src_id: int, payload: bytes) -> bytes:
        """The message with prefixed frame names, or the unchanged message."""
        if not self._form:
            return payload
        prefix = filled(self._form, src_id)

        def rename(part: Any, name: str) -> None:
            setattr(part, name, prefixed_frame(prefix, getattr(part, name)))

        return self._members.apply(type_name, payload, rename)


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
        message = decoded(self._store, TF_TYPE, payload)
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
        return encoded(self._store, TF_TYPE, message, payload)


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


def _is_frame(type_name: str, name: str, text: bool) -> bool:
    return text and (name.endswith(_ENDING) or (type_name, name) == (HEADER, "frame_id"))
