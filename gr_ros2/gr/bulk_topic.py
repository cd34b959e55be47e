"""Topics of the link itself that use what other topics leave of the air."""

from __future__ import annotations

from typing import Literal

from gr_ros2.link.endpoint import OpenEndpoint
from gr_ros2.settings.config import SendOptions


def add_bulk_topic(
    endpoint: OpenEndpoint, name: str, type_name: str, *, waiting: int, reliability: Literal["reliable", "best_effort"]
) -> int:
    """Announce a topic of class bulk; returns its id. Called with the lock of the endpoint held.

    :param waiting: messages of it that wait at most
    """
    options = SendOptions(qos="bulk", queue="fifo", queue_depth=waiting, reliability=reliability)
    topic_id = endpoint.messages.add([(name, type_name, options)])[-1].topic_id
    endpoint.used_air.leave_out(topic_id)
    endpoint.messages.offer(topic_id, offered=True)
    return topic_id
