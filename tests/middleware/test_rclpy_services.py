"""Servers and clients through rclpy, on a stand-in of the few parts of rclpy that they touch, which behaves as its
executor does: it sends whatever a callback returns. ``test_rclpy.py`` asks a real rclpy, where there is one."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.middleware import Publisher, Qos, Subscription, TopicInfo
from gr_ros2.middleware.base import MessageCallback
from gr_ros2.middleware.rclpy_services import MAX_PENDING, RclpyClient, RclpyParticipant, RclpyServer, service_class

KIND = "stand_in_interfaces/srv/Add"


class Add:
    """A service type as rosidl makes it."""

    class Request(bytes):
        pass

    class Response(bytes):
        pass


class Future:
    def __init__(self) -> None:
        self._done: list[Callable[[Future], None]] = []
        self._result: Any = None

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        self._done.append(callback)

    def cancelled(self) -> bool:
        return False

    def result(self) -> Any:
        return self._result

    def set_result(self, result: Any) -> None:
        self._result = result
        for callback in self._done:
            callback(self)


class Service:
    def __init__(self, callback: Callable[[Any, Any], Any]) -> None:
        self.callback = callback
        self.sent: list[tuple[Any, Any]] = []

    def send_response(self, response: Any, header: Any) -> None:
        if not isinstance(response, Add.Response):
            raise TypeError
        self.sent.append((response, header))

    def execute(self, request: Any, header: Any) -> None:
        """What the executor does with a request."""
        self.send_response(self.callback(request, Add.Response()), header)


class Client:
    def __init__(self) -> None:
        self.ready = False
        self.futures: list[Future] = []
        self.removed: list[Future] = []

    def service_is_ready(self) -> bool:
        return self.ready

    def call_async(self, request: Any) -> Future:
        assert isinstance(request, Add.Request)
        self.futures.append(Future())
        return self.futures[-1]

    def remove_pending_request(self, future: Future) -> None:
        self.removed.append(future)


class Node(RclpyParticipant):
    """A participant whose executor is the caller."""

    name = "rclpy"

    def __init__(self) -> None:
        super().__init__()
        self.made: list[Any] = []
        self.destroyed: list[Any] = []

    def check_open(self) -> None:
        pass

    def in_executor(self, work: Callable[[], None]) -> None:
        work()

    def make(self, kind: str, service_type: Any, name: str, *callback: Callable[..., Any], node: str = "") -> Any:  # noqa: ARG002
        assert (service_type, name) == (Add, "/add")
        self.made.append(Service(*callback) if kind == "service" else Client())
        return self.made[-1]

    def destroy(self, kind: str, endpoint: Any) -> None:
        assert isinstance(endpoint, {"service": Service, "client": Client}[kind])
        self.destroyed.append(endpoint)

    def to_bytes(self, message: Any) -> bytes:
        return bytes(message)

    def to_message(self, payload: bytes, message_type: Any) -> Any:
        return message_type(payload)

    def serve(self, service: str, type_name: str, on_request: Any, node: str = "") -> RclpyServer:
        raise NotImplementedError

    def client(self, service: str, type_name: str, on_reply: Any, on_server: Any) -> RclpyClient:
        raise NotImplementedError

    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: MessageCallback) -> Subscription:
        raise NotImplementedError

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Publisher:
        raise NotImplementedError

    def discover(self) -> list[TopicInfo]:
        raise NotImplementedError

    def discover_services(self) -> dict[str, str]:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError


@pytest.fixture(autouse=True)
def interfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """The Python package of the service type, and of an action."""
    impl = SimpleNamespace(SendGoalService="send", GetResultService="result")
    for folder, name, value in (("srv", "Add", Add), ("action", "Go", SimpleNamespace(Impl=impl))):
        module = ModuleType(f"stand_in_interfaces.{folder}")
        setattr(module, name, value)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(sys.modules, "stand_in_interfaces", ModuleType("stand_in_interfaces"))


def test_a_reply_is_sent_when_it_comes_and_not_when_the_callback_returns() -> None:
    node, taken = Node(), []
    server = RclpyServer(node, "/add", KIND, lambda client, payload: taken.append((client, payload)))
    (service,) = node.made
    service.execute(Add.Request(b"1 + 1"), "header 1")
    service.execute(Add.Request(b"2 + 2"), "header 2")
    assert taken == [("header 1", b"1 + 1"), ("header 2", b"2 + 2")]
    assert not service.sent
    server.reply("header 2", b"4")
    server.reply("header 1", b"2")
    assert service.sent == [(b"4", "header 2"), (b"2", "header 1")]
    server.close()
    server.close()
    assert node.destroyed == [service]
    with pytest.raises(MiddlewareError, match="reply of /add: it is closed"):
        server.reply("header 1", b"2")


def test_a_callback_that_fails_is_counted_and_the_executor_goes_on() -> None:
    node = Node()
    RclpyServer(node, "/add", KIND, lambda *_: 1 / 0)  # type: ignore[arg-type, return-value]
    node.made[0].execute(Add.Request(b""), "header")
    assert node.counters == {"callback_failed:/add": 1}


def test_a_client_calls_while_a_server_is_there() -> None:
    node, told, got = Node(), [], []
    client = RclpyClient(node, "/add", KIND, lambda *reply: got.append(reply), told.append)
    (endpoint,) = node.made
    client.look()
    with pytest.raises(MiddlewareError, match="no server is there"):
        client.call(1, b"1 + 1")
    endpoint.ready = True
    client.look()
    client.look()
    client.call(7, b"1 + 1")
    client.call(8, b"2 + 2")
    endpoint.futures[1].set_result(Add.Response(b"4"))
    endpoint.futures[0].set_result(Add.Response(b"2"))
    assert got == [(8, b"4"), (7, b"2")]
    endpoint.ready = False
    client.look()
    assert told == [True, False]
    client.close()
    assert node.destroyed == [endpoint]


def test_replies_that_never_come_take_no_memory_without_end() -> None:
    node = Node()
    client = RclpyClient(node, "/add", KIND, lambda *_: None, lambda _: None)
    (endpoint,) = node.made
    endpoint.ready = True
    client.look()
    for number in range(MAX_PENDING + 2):
        client.call(number, b"")
    assert endpoint.removed == endpoint.futures[:2]


def test_types_are_those_of_the_sourced_workspaces() -> None:
    assert service_class(KIND) is Add
    assert service_class("stand_in_interfaces/action/Go_SendGoal") == "send"
    assert service_class("stand_in_interfaces/action/Go_GetResult") == "result"
    with pytest.raises(ConfigError, match="type no_such_package/srv/Add cannot be imported"):
        service_class("no_such_package/srv/Add")
