"""Servers and clients of services on the embedded DDS, as rmw_cyclonedds has them.

A request begins with 16 bytes that name it: 8 of the client, and a number of its own. The reply begins with the same.
The message follows. rmw_fastrtps has neither: there the identity is in inline QoS parameters of the DDS, which the
library does not give out. So its clients and servers are refused and counted as ``other_rmw:/service``; with the
middleware ``rclpy`` they take part.

A client that finds a server expects an answer. Where all nodes have another RMW, no server is on the graph. Beside
nodes of Cyclone DDS a server has a second writer of replies, through which nothing is written: to rmw_fastrtps a server
is there where requests have as many readers as replies have writers; rmw_cyclonedds looks for a pair of one identity.

Invariants: a server's reader exists only together with its two writers; a client says that a server is there only when
both its endpoints match those of one server.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Hashable

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware import ros_graph
from gr_ros2.middleware.cdr_dds import (
    DdsError,
    DiscoveredEndpoint,
    Entity,
    RawReader,
    RawWriter,
    create_topic,
    delete,
)
from gr_ros2.middleware.dds_endpoints import DdsParticipant
from gr_ros2.middleware.dds_events import DdsEvents
from gr_ros2.middleware.dds_found import FoundEndpoints
from gr_ros2.middleware.services import (
    OTHER_RMW,
    SERVICE_QOS,
    ReplyCallback,
    RequestCallback,
    ServerCallback,
    ServiceClient,
    ServiceServer,
)

ENCAPSULATION, HEADER = 4, 16
_NAME = 8
"""Bytes that name a client."""

_SERVICE_ID = re.compile(rb"(?:^|;)serviceid=([^;]*);")


def with_header(header: bytes, payload: bytes) -> bytes:
    """A message as it is on the DDS, from the bytes that name a request and the message alone."""
    return payload[:ENCAPSULATION] + header + payload[ENCAPSULATION:]


def without_header(data: bytes) -> tuple[bytes, bytes] | None:
    """The inverse of :func:`with_header`; None where the bytes are too few."""
    end = ENCAPSULATION + HEADER
    return (data[ENCAPSULATION:end], data[:ENCAPSULATION] + data[end:]) if len(data) >= end else None


class ServiceParticipant(DdsParticipant):
    """The same for its servers and clients."""

    pairs: DdsPairs
    """The endpoints of its servers and clients."""


class DdsPairs:
    """The servers and clients of a participant, each with a reader and a writer on the DDS.

    :param entity: the participant
    :param events: calls ``service`` of a server or client when something arrives, or matches change
    :param others: what others have on the domain
    """

    def __init__(
        self, participant: ServiceParticipant, entity: Entity, events: DdsEvents, others: FoundEndpoints
    ) -> None:
        self._participant, self._entity, self._events, self._others = participant, entity, events, others
        self._lock = threading.Lock()  # for the pairs
        self._pairs: list[DdsServer | DdsClient] = []
        self._offering = threading.Lock()  # for the servers
        self._servers: list[DdsServer] = []

    def add(self, server: DdsServer) -> None:
        """A new server, which is offered as long as somebody can call it."""
        with self._offering:
            self._servers.append(server)
            server.offer(on=self._others.takes_replies())

    def forget(self, server: DdsServer) -> None:
        """The server is closed: it is not offered any more."""
        with self._offering:
            if server in self._servers:
                self._servers.remove(server)

    def look(self) -> None:
        """Others have come or gone: offer the servers, or take them off the graph."""
        with self._offering:
            for server in self._servers:
                server.offer(on=self._others.takes_replies())

    def make(self, end: DdsServer | DdsClient) -> None:
        """Set the endpoints of a server or a client."""
        names = ros_graph.dds_service(end.name, end.type_name)
        topics = [create_topic(self._entity, *name) for name in names]
        data = [ros_graph.endpoint_user_data(self._others.hash_of(name)) + end.mark for _, name in names]
        # Writers are first, the spare ones before all: no client of Fast DDS finds as many writers as readers.
        writes = topics[end.writes], SERVICE_QOS
        spare = [RawWriter(self._entity, *writes, b"") for _ in range(end.spare_writers)]
        writer = RawWriter(self._entity, *writes, data[end.writes])
        reader = RawReader(self._entity, topics[end.reads], SERVICE_QOS, data[end.reads])
        for topic in topics:
            delete(topic)  # it lives on in its endpoints
        writer.watch_matches()
        reader.watch_matches()
        end.reader, end.writers = reader, (writer, *spare)
        with self._lock:
            self._pairs.append(end)
        self._events.attach(reader.entity, (reader.entity, reader.condition, writer.entity), end.service)
        self._participant.announce()

    def drop(self, end: DdsServer | DdsClient) -> None:
        """Delete the endpoints of a server or a client, where it has any."""
        if self._participant.closed:
            return
        with self._lock:
            if end not in self._pairs:
                return
            self._pairs.remove(end)
        self._events.detach(end.reader.entity)
        end.reader.delete()
        for writer in end.writers:
            writer.delete()
        self._participant.announce()

    def nodes(self) -> dict[str, tuple[list[bytes], list[bytes]]]:
        """GUIDs of all readers and writers, by the node that has them; '' is the participant's own."""
        found: dict[str, tuple[list[bytes], list[bytes]]] = {}
        with self._lock:
            for end in self._pairs:
                readers, writers = found.setdefault(end.node, ([], []))
                readers.append(end.reader.guid)
                writers.append(end.writers[0].guid)
        return found


class _DdsEnd:
    """What servers and clients have in common.

    :ivar node: absolute name of the node to which it belongs; '' the participant's own
    :ivar reads: which topic it reads, 0 that of requests, 1 that of replies; likewise ``writes``
    """

    reader: RawReader
    writers: tuple[RawWriter, ...]
    """The first is for messages, and the others for nothing."""

    role = ""
    reads, writes = 0, 1
    spare_writers = 0

    def __init__(self, participant: ServiceParticipant, service: str, type_name: str, node: str = "") -> None:
        self.name, self.type_name, self.node = service, type_name, node
        self._participant = participant
        self._closed = False
        self._calling = threading.RLock()
        self.mark = b"%sid=%s;" % (self.role.encode(), ".".join(f"{byte:x}" for byte in os.urandom(16)).encode())
        """User data by which the two endpoints are known to belong together."""

    def _refuse(self, other: DiscoveredEndpoint) -> None:
        text = f"{self.name}: a {'client' if self.role == 'service' else 'server'} {OTHER_RMW}"
        self._participant.count_once(f"other_rmw:{self.name}", f"{text} (participant {other.participant.hex()})")

    def _write(self, writer: RawWriter, header: bytes, payload: bytes, what: str) -> None:
        if self._closed or self._participant.closed:
            raise MiddlewareError(f"{what} {self.name}: it is closed")
        try:
            writer.write(with_header(header, payload))
        except DdsError as error:
            raise MiddlewareError(f"{what} {self.name}: {error}") from error

    def _close(self) -> None:
        if not self._closed:
            self._closed = True
            with self._calling:  # a callback in progress ends first, unless this call comes from it
                pass
            self._participant.pairs.drop(self)  # type: ignore[arg-type]


class DdsServer(_DdsEnd, ServiceServer):
    """A server. ``reply`` may be called from any thread."""

    role = "service"
    spare_writers = 1

    def __init__(
        self, participant: ServiceParticipant, service: str, type_name: str, on_request: RequestCallback, node: str
    ) -> None:
        super().__init__(participant, service, type_name, node)
        self._on_request = on_request
        self._offered = False

    def offer(self, *, on: bool) -> None:
        """Put its endpoints on the graph, or take them off it."""
        with self._calling:
            if on == self._offered or self._closed:
                return
            self._offered = on
            if on:
                self._participant.pairs.make(self)
            else:
                text = f"{self.name} and all other services: not offered, since every node here {OTHER_RMW}"
                self._participant.count_once(f"not_offered:{self.name}", text, alike=True)
                self._participant.pairs.drop(self)

    def service(self) -> None:
        """Take requests. Called by the participant's thread."""
        with self._calling:
            if self._closed:
                return
            self.reader.matched()  # both reset the status that triggered: otherwise the thread is called again at once
            self.writers[0].matched()
            for sample in self.reader.take():
                client = self.reader.other(sample.source)
                if client is not None and not client.is_cyclone:
                    self._refuse(client)
                    continue
                parts = without_header(sample.payload)
                if parts is None:
                    self._participant.count(f"malformed:{self.name}", f"{self.name}: a request without a header")
                    continue
                header, payload = parts
                self._participant.guarded(self.name, lambda h=header, p=payload: self._on_request(h, p))  # type: ignore[misc]

    def reply(self, client: Hashable, payload: bytes) -> None:
        assert isinstance(client, bytes)
        if not self._offered and not self._closed:
            return  # its client has left
        self._write(self.writers[0], client, payload, "reply of")

    def close(self) -> None:
        self._participant.pairs.forget(self)
        self._close()


class DdsClient(_DdsEnd, ServiceClient):
    """A client. ``call`` may be called from any thread."""

    role = "client"
    reads, writes = 1, 0

    def __init__(
        self,
        participant: ServiceParticipant,
        service: str,
        type_name: str,
        on_reply: ReplyCallback,
        on_server: ServerCallback,
    ) -> None:
        super().__init__(participant, service, type_name)
        self._on_reply, self._on_server = on_reply, on_server
        self._name = os.urandom(_NAME)
        self._available = False
        participant.pairs.make(self)
        self.service()  # there may be matches already

    def service(self) -> None:
        """Take replies, and look whether a server is there. Called by the participant's thread."""
        with self._calling:
            if self._closed:
                return
            for sample in self.reader.take():
                parts = without_header(sample.payload)
                if parts is not None and parts[0].startswith(self._name):
                    number, payload = int.from_bytes(parts[0][_NAME:], "little", signed=True), parts[1]
                    self._participant.guarded(self.name, lambda n=number, p=payload: self._on_reply(n, p))  # type: ignore[misc]
            self.reader.matched()
            self.writers[0].matched()
            available = self._find_server()
            if available != self._available:
                self._available = available
                self._participant.guarded(self.name, lambda: self._on_server(available))

    def call(self, number: int, payload: bytes) -> None:
        if not self._available:
            raise MiddlewareError(f"request of {self.name}: no server is there")
        self._write(self.writers[0], self._name + number.to_bytes(8, "little", signed=True), payload, "request of")

    def close(self) -> None:
        self._close()

    def _find_server(self) -> bool:
        """Whether both endpoints match those of a server, as ``rmw_service_server_is_available`` decides."""
        own = self._participant.own_guid
        readers, writers = ([e for e in end.others() if e.participant != own] for end in (self.writers[0], self.reader))
        for reader in readers:
            if not reader.is_cyclone:
                # What is written reaches every reader, and this one would take the header for a part of the message.
                self._refuse(reader)
                return False
        needed, found = ({_service_id(endpoint) for endpoint in ends} for ends in (readers, writers))
        return bool(needed & found)


def _service_id(endpoint: DiscoveredEndpoint) -> bytes:
    match = _SERVICE_ID.search(endpoint.user_data)
    return match[1] if match else b""
