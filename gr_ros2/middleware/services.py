"""Services on a ROS graph: serialized requests and replies, without what names the client.

Invariants: payloads are whole CDR messages with the encapsulation header, the same on every middleware; callbacks run
in a thread of the back-end and must not block it for long; no callback runs after ``close`` has returned.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from typing import NamedTuple

from gr_ros2.middleware.base import Middleware, Qos

RequestCallback = Callable[[Hashable, bytes], None]
"""Takes a request: the client, to be given back with the reply, and the message."""
ReplyCallback = Callable[[int, bytes], None]
"""Takes a reply: the number that was given with the request, and the message."""
ServerCallback = Callable[[bool], None]
"""Takes whether a server is there."""


SERVICE_QOS = Qos("reliable", "volatile", 1000)
"""The QoS of services in ROS, except for the depth, which is 10 there. So a burst of calls passes."""
DESCRIPTION, DESCRIPTION_TYPE = "get_type_description", "type_description_interfaces/srv/GetTypeDescription"
"""The service with which a node describes types since Iron: its name below that of the node, and its type."""


OTHER_RMW = (
    "has another RMW than rmw_cyclonedds_cpp; for its services, start the link where ROS 2 is sourced, with "
    "--middleware rclpy"
)
"""What is said of a program whose services the embedded DDS cannot carry."""


class Witness(NamedTuple):
    """A participant that can say what a type is.

    :param digest: hash of the type as it uses it, ``RIHS01_…``
    :param services: absolute names of its services ``get_type_description``, of one node or of several
    """

    digest: str
    services: tuple[str, ...]


class ServiceServer(ABC):
    """A server of this participant."""

    @abstractmethod
    def reply(self, client: Hashable, payload: bytes) -> None:
        """Send the reply to a request (raises MiddlewareError once closed).

        :param client: as it came with the request
        """

    @abstractmethod
    def close(self) -> None:
        """Leave the graph. Idempotent."""


class ServiceClient(ABC):
    """A client of this participant."""

    @abstractmethod
    def call(self, number: int, payload: bytes) -> None:
        """Send a request (raises MiddlewareError once closed, or where no server is there).

        :param number: given back with the reply
        """

    @abstractmethod
    def close(self) -> None:
        """Leave the graph. Idempotent."""


class ServiceGraph(Middleware):
    """A participant that can have servers and clients."""

    @abstractmethod
    def discover_services(self) -> dict[str, str]:
        """Types, by absolute name, of the services of the graph, without the servers of this participant.

        Services that have clients only are left out where the middleware can tell.
        """

    def uncallable(self) -> frozenset[str]:
        """Those of the services found that cannot be called from here, because of the RMW of their servers."""
        return frozenset()

    @abstractmethod
    def serve(self, service: str, type_name: str, on_request: RequestCallback, node: str = "") -> ServiceServer:
        """Make a server, which may take any time to reply.

        :param service: absolute name
        :param type_name: ``package/srv/Type``, or ``package/action/Type_SendGoal`` or ``_GetResult``
        :param node: absolute name of the node to which it belongs, where the middleware can show others than its own;
            '' is the participant's own
        """

    @abstractmethod
    def client(self, service: str, type_name: str, on_reply: ReplyCallback, on_server: ServerCallback) -> ServiceClient:
        """Make a client.

        :param on_server: called when a server has come, and when the last one has left. Servers of this participant do
            not count
        """

    def witnesses(self, topic: str, type_name: str) -> list[Witness]:  # noqa: ARG002 - not every graph has them
        """Who uses a type on a topic and can be asked about it, without this participant."""
        return []

    def guarded(self, service: str, callback: Callable[[], None]) -> None:
        """Call back about a service. An exception is counted and logged, and the thread goes on, as for topics."""
        self.deliver(service, lambda _: callback(), b"")
