"""A node with a custom type in another process: ``describing_peer.py DOMAIN TOPIC pub|sub REPLY``.

It publishes or subscribes, with the hash of the type in its user data, and serves ``/wheels/get_type_description``.
REPLY says how: ``right``, ``refuse``, ``other`` (it describes another type), ``damaged`` or ``silent``. It says
``ready``, ``asked`` for each request, and ``data HEX`` for each message; takes messages in hex.
"""

from __future__ import annotations

import sys
from collections.abc import Hashable

from gr_ros2.middleware import Publisher, Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.middleware.ros_graph import endpoint_user_data
from gr_ros2.middleware.services import DESCRIPTION_TYPE
from gr_ros2.middleware.type_descriptions import request
from tests.middleware.describing import CUSTOM, CUSTOM_TEXT, OTHER_TEXT, hash_of_text, reply, types_of
from tests.said import say

DIGEST = hash_of_text(CUSTOM_TEXT)


class Node(DdsMiddleware):
    """A participant that has the type."""

    def _user_data(self, type_name: str) -> bytes:
        assert type_name == CUSTOM
        return endpoint_user_data(DIGEST)


def main(domain: str, topic: str, role: str, how: str) -> None:
    node = Node(domain_id=int(domain), node_name="wheels")
    replies = {
        "right": reply(types_of(CUSTOM_TEXT), CUSTOM),
        "refuse": reply(types_of(CUSTOM_TEXT), CUSTOM, failure="not here"),
        "other": reply(types_of(OTHER_TEXT), CUSTOM),
        "damaged": reply(types_of(CUSTOM_TEXT), CUSTOM)[:99],
    }

    def answer(client: Hashable, payload: bytes) -> None:
        assert payload.startswith(request(CUSTOM, DIGEST).rstrip(b"\0"))
        say("asked")
        if how in replies:
            server.reply(client, replies[how])

    server = node.serve("/wheels/get_type_description", DESCRIPTION_TYPE, answer)
    qos = Qos("reliable", "volatile", 100)
    endpoint = (
        node.advertise(topic, CUSTOM, qos)
        if role == "pub"
        else node.subscribe(topic, CUSTOM, qos, lambda data: say("data", data.hex()))
    )
    say("ready")
    for line in sys.stdin:
        assert isinstance(endpoint, Publisher)
        endpoint.publish(bytes.fromhex(line.strip()))
    node.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
