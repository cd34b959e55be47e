"""Servers and clients of services on the graph inside one process.

Invariants: all state is guarded by the graph's lock; every callback runs in the thread of its participant; a reply that
nobody waits for is dropped, as on a DDS.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable, Iterable

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware.delivery import CallbackThread
from gr_ros2.middleware.services import (
    ReplyCallback,
    RequestCallback,
    ServerCallback,
    ServiceClient,
    ServiceGraph,
    ServiceServer,
)


class MemoryServices:
    """The servers and clients of one graph.

    :param lock: of the graph
    """

    def __init__(self, lock: threading.RLock) -> None:
        self.lock = lock
        self.servers: list[MemoryServer] = []
        self.clients: list[MemoryClient] = []

    def left(self, participant: ServiceGraph) -> None:
        """A participant has left the graph."""
        ends: list[MemoryServer | MemoryClient] = [*self.servers, *self.clients]
        for end in ends:
            if end.participant is participant:
                end.close()

    def look(self) -> None:
        """Tell every client whether a server is there, where that has changed."""
        for client in self.clients:
            client.look()


class _MemoryEnd:
    def __init__(
        self, services: MemoryServices, participant: ServiceGraph, thread: CallbackThread, names: tuple[str, str]
    ) -> None:
        self.services, self.participant, self.thread, self.names = services, participant, thread, names
        self.closed = False

    def check_open(self) -> None:
        """:raises MiddlewareError: it is closed"""
        if self.closed:
            raise MiddlewareError(f"service {self.names[0]}: it is closed")


class MemoryServer(_MemoryEnd, ServiceServer):
    """A service within the process."""

    def __init__(
        self,
        services: MemoryServices,
        participant: ServiceGraph,
        thread: CallbackThread,
        names: tuple[str, str],
        on_request: RequestCallback,
    ) -> None:
        super().__init__(services, participant, thread, names)
        self._on_request = on_request
        with services.lock:
            services.servers.append(self)
            services.look()

    def take(self, client: Hashable, payload: bytes) -> None:
        """Take a request."""

        def step() -> None:
            if not self.closed:
                self._on_request(client, payload)

        self.thread.call(lambda: self.participant.guarded(self.names[0], step))

    def reply(self, client: Hashable, payload: bytes) -> None:
        with self.services.lock:
            self.check_open()
            for end in self.services.clients:
                end.take(client, bytes(payload))

    def close(self) -> None:
        with self.services.lock:
            if not self.closed:
                self.closed = True
                self.services.servers.remove(self)
                self.services.look()


class MemoryClient(_MemoryEnd, ServiceClient):
    """A client within the process."""

    def __init__(
        self,
        services: MemoryServices,
        participant: ServiceGraph,
        thread: CallbackThread,
        names: tuple[str, str],
        callbacks: tuple[ReplyCallback, ServerCallback],
    ) -> None:
        super().__init__(services, participant, thread, names)
        self._on_reply, self._on_server = callbacks
        self._available = False
        with services.lock:
            services.clients.append(self)
            self.look()

    def call(self, number: int, payload: bytes) -> None:
        with self.services.lock:
            self.check_open()
            servers = list(self._servers())
            if not servers:
                raise MiddlewareError(f"request of {self.names[0]}: no server is there")
            for server in servers:
                server.take((id(self), number), bytes(payload))

    def take(self, client: Hashable, payload: bytes) -> None:
        """Take a reply if it is for this client."""
        assert isinstance(client, tuple)
        whose, number = client

        def step() -> None:
            if not self.closed:
                self._on_reply(number, payload)

        if whose == id(self):
            self.thread.call(lambda: self.participant.guarded(self.names[0], step))

    def look(self) -> None:
        """Tell whether a server is there, if that has changed."""
        available = any(self._servers())
        if available != self._available:
            self._available = available
            self.thread.call(lambda: self.participant.guarded(self.names[0], lambda: self._on_server(available)))

    def close(self) -> None:
        with self.services.lock:
            if not self.closed:
                self.closed = True
                self.services.clients.remove(self)

    def _servers(self) -> Iterable[MemoryServer]:
        return (
            server
            for server in self.services.servers
            if server.names == self.names and server.participant is not self.participant
        )
