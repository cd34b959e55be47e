"""Servers and clients of services through rclpy, whatever its RMW.

rclpy has no raw services: requests and replies are messages of Python classes, which are serialized here. Its executor
sends what a service's callback returns as the reply, at once. Here a reply may take any time. So the callback returns
the request, and ``send_response`` of that one service object is replaced: it is what learns the header of the request.
The reply is sent by the method of the class.

Invariants: nothing here imports rclpy; callbacks run in the executor's thread; memory is bounded by ``MAX_PENDING``.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable, Hashable
from functools import partial
from importlib import import_module
from typing import Any

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.middleware.rcl import translated
from gr_ros2.middleware.services import (
    ReplyCallback,
    RequestCallback,
    ServerCallback,
    ServiceClient,
    ServiceGraph,
    ServiceServer,
)

MAX_PENDING = 1024
"""Requests of one client that wait for a reply. Of more, the oldest is given up, and its reply will be dropped."""
_OF_ACTIONS = {"SendGoal": "SendGoalService", "GetResult": "GetResultService"}


def service_class(type_name: str) -> Any:
    """The Python class of ``package/srv/Type``, or of a service of ``package/action/Type``.

    :raises ConfigError: not in the sourced workspaces
    """
    package, folder, name = type_name.split("/")
    try:
        module = import_module(f"{package}.{folder}")
        if folder == "srv":
            return getattr(module, name)
        action, _, part = name.rpartition("_")
        return getattr(getattr(module, action).Impl, _OF_ACTIONS[part])
    # The import runs generated code and loads C libraries, which may raise other errors than ImportError.
    except Exception as error:
        raise ConfigError(
            f"type {type_name} cannot be imported ({error}); source the workspace that has it (. install/setup.bash) "
            "before starting, or use middleware 'dds', which needs no definitions"
        ) from error


class RclpyParticipant(ServiceGraph):
    """The interface of a participant for its servers and clients."""

    @abstractmethod
    def check_open(self) -> None:
        """:raises MiddlewareError: it is closed"""

    @abstractmethod
    def in_executor(self, work: Callable[[], None]) -> None:
        """Run work in the executor's thread."""

    @abstractmethod
    def make(self, kind: str, service_type: Any, name: str, *callback: Callable[..., Any], node: str = "") -> Any:
        """A service or a client of the node; of another node, which is shown for it, where ``node`` names one."""

    @abstractmethod
    def destroy(self, kind: str, endpoint: Any) -> None:
        """Destroy it, in the executor's thread."""

    @abstractmethod
    def to_bytes(self, message: Any) -> bytes:
        """A message, serialized."""

    @abstractmethod
    def to_message(self, payload: bytes, message_type: Any) -> Any:
        """The inverse of ``to_bytes``."""


class RclpyServer(ServiceServer):
    """A service on the graph of rclpy."""

    def __init__(
        self, participant: RclpyParticipant, service: str, type_name: str, on_request: RequestCallback, node: str = ""
    ) -> None:
        self._participant, self._name, self._on_request = participant, service, on_request
        self._type = service_class(type_name)
        self._closed = False
        self._ready = threading.Event()
        self._endpoint = participant.make("service", self._type, service, self._handed_on, node=node)
        self._send = self._endpoint.send_response
        self._endpoint.send_response = self._taken
        self._ready.set()

    def reply(self, client: Hashable, payload: bytes) -> None:
        if self._closed:
            raise MiddlewareError(f"reply of {self._name}: it is closed")
        self._participant.check_open()
        with translated(f"reply of {self._name} failed"):
            self._send(self._participant.to_message(payload, self._type.Response), client)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._participant.in_executor(partial(self._participant.destroy, "service", self._endpoint))

    def _handed_on(self, request: Any, _response: Any) -> Any:
        """The callback. A request that comes at once waits until its header can be learned."""
        self._ready.wait()
        return request

    def _taken(self, request: Any, header: Any) -> None:
        """Called by the executor with what the callback returned."""
        if not self._closed:
            payload = self._participant.to_bytes(request)
            self._participant.guarded(self._name, lambda: self._on_request(header, payload))


class RclpyClient(ServiceClient):
    """A client on the graph of rclpy. ``look`` has to be called again and again."""

    def __init__(
        self,
        participant: RclpyParticipant,
        service: str,
        type_name: str,
        on_reply: ReplyCallback,
        on_server: ServerCallback,
    ) -> None:
        self._participant, self._name = participant, service
        self._on_reply, self._on_server = on_reply, on_server
        self._type = service_class(type_name)
        self._closed = self._available = False
        self._pending: dict[int, Any] = {}
        self._endpoint = participant.make("client", self._type, service)

    def look(self) -> None:
        """Look whether a server is there. In the executor's thread."""
        if self._closed:
            return
        available = bool(self._endpoint.service_is_ready())
        if available != self._available:
            self._available = available
            self._participant.guarded(self._name, lambda: self._on_server(available))

    def is_of(self, endpoint: object) -> bool:
        """Whether this is the client of an endpoint of rclpy."""
        return self._endpoint is endpoint

    def call(self, number: int, payload: bytes) -> None:
        if self._closed:
            raise MiddlewareError(f"request of {self._name}: it is closed")
        self._participant.check_open()
        if not self._available:
            raise MiddlewareError(f"request of {self._name}: no server is there")
        with translated(f"request of {self._name} failed"):
            request = self._participant.to_message(payload, self._type.Request)
            future = self._pending[number] = self._endpoint.call_async(request)
        if len(self._pending) > MAX_PENDING:
            self._endpoint.remove_pending_request(self._pending.pop(next(iter(self._pending))))
        future.add_done_callback(partial(self._answered, number))

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._participant.in_executor(partial(self._participant.destroy, "client", self._endpoint))

    def _answered(self, number: int, future: Any) -> None:
        self._pending.pop(number, None)
        if self._closed or future.cancelled():
            return
        payload = self._participant.to_bytes(future.result())
        self._participant.guarded(self._name, lambda: self._on_reply(number, payload))
