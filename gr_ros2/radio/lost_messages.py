"""Messages that a link lost, in the form in which rosbag2 tells of lost messages (``rosbag2_interfaces``).

So a bag of a link's topics (`ros2 bag record -a`) says by itself what is missing in it, and tools that read rosbag2's
events understand it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

LOST_TYPE = "rosbag2_interfaces/msg/MessagesLostEvent"
_STAT_TYPE = "rosbag2_interfaces/msg/MessagesLostEventTopicStat"
_EVENT = "string node_name\nMessagesLostEventTopicStat[] messages_lost_statistics\n"
_STAT = "string topic_name\nuint64 messages_lost_in_transport\nuint64 messages_lost_in_recorder\n"
"""The definitions of ROS 2 Lyrical."""


@cache
def _types() -> Typestore:
    store = Typestore()
    store.register({**get_types_from_msg(_STAT, _STAT_TYPE), **get_types_from_msg(_EVENT, LOST_TYPE)})
    return store


class LostMessages:
    """Compares snapshots of a link's counters.

    :param node_name: of the link, as the event names it
    """

    def __init__(self, node_name: str) -> None:
        self._node_name = node_name
        self._before: dict[str, int] = {}

    def event(self, stats: Mapping[str, Any]) -> bytes | None:
        """A message of ``LOST_TYPE`` about what was lost since the last one; None if nothing was.

        A topic that is received has the name under which it comes out here, a topic that is sent its own.

        :param stats: statistics of a ``RobotLink``
        """
        lost = {name: sum(topic["lost"].values()) for name, topic in stats["sink"]["topics"].items()}
        lost |= {
            name: sum(topic["refused"].values()) + topic["lost_on_graph"]
            for name, topic in stats["source"]["topics"].items()
        }
        new = {name: count - self._before.get(name, 0) for name, count in lost.items()}
        self._before = lost
        if not any(count > 0 for count in new.values()):
            return None
        return lost_event(self._node_name, new)


def lost_event(node_name: str, lost: Mapping[str, int]) -> bytes:
    """A message of ``LOST_TYPE``.

    :param lost: messages by the name of their topic
    """
    types = _types().types
    topics = [
        types[_STAT_TYPE](topic_name=name, messages_lost_in_transport=count, messages_lost_in_recorder=0)
        for name, count in lost.items()
        if count > 0
    ]
    message = types[LOST_TYPE](node_name=f"/{node_name}", messages_lost_statistics=topics)
    return bytes(_types().serialize_cdr(message, LOST_TYPE))


def lost_definition() -> str:
    """The definition of ``LOST_TYPE``, as a bag has it."""
    return _types().generate_msgdef(LOST_TYPE, ros_version=2)[0]
