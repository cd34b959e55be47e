"""What every middleware promises, asked of every row of the table alike, those of other packages too.

One whose SDK is missing is skipped, visibly. A row needs no line here unless it differs in what stands in ``DIFFERENT``
or ``NEEDED``.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import BackendMissingError, ConfigError, GrRos2Error, MiddlewareError
from gr_ros2.middleware import MIDDLEWARE, Middleware, Qos
from tests.domains import domain
from tests.middleware.support import ADAPT, BEST_EFFORT, CUSTOM, LATCHED, RELIABLE, STRING, message, same
from tests.waiting import wait_for


class World(ABC):
    """Two ends of one back-end.

    :ivar padding: zeros that may come behind a message
    :ivar custom_types: whether a type passes whose definition nobody has
    :ivar tells_depth: whether discovery tells a publisher's depth
    """

    padding = 0
    custom_types = True
    tells_depth = True

    @abstractmethod
    def publishing(self) -> Middleware: ...

    @abstractmethod
    def subscribing(self) -> Middleware: ...

    @abstractmethod
    def exchange(
        self, payloads: Sequence[bytes], type_name: str, offered: Qos, requested: Qos, *, late: bool = False
    ) -> list[bytes]:
        """Publish on /robot_1/topic, and what a subscription gets."""

    @abstractmethod
    def close(self) -> None: ...


class LiveWorld(World):
    """Two participants of one domain."""

    def __init__(self, name: str, padding: int = 0, *, custom_types: bool = True, tells_depth: bool = True) -> None:
        self.padding = padding
        self.custom_types = custom_types
        self.tells_depth = tells_depth
        make = MIDDLEWARE.load(name)
        self._ends: list[Middleware] = [make(domain_id=domain(), node_name=f"end_{i}") for i in range(2)]

    def publishing(self) -> Middleware:
        return self._ends[0]

    def subscribing(self) -> Middleware:
        return self._ends[1]

    def exchange(
        self, payloads: Sequence[bytes], type_name: str, offered: Qos, requested: Qos, *, late: bool = False
    ) -> list[bytes]:
        received: list[bytes] = []
        publisher = self._ends[0].advertise("/robot_1/topic", type_name, offered)
        if late:
            for payload in payloads:
                publisher.publish(payload)
        subscription = self._ends[1].subscribe("/robot_1/topic", type_name, requested, received.append)
        if not late:
            wait_for(lambda: publisher.matched() and subscription.matched(), "match")
            for payload in payloads:
                publisher.publish(payload)
        wait_for(lambda: len(received) >= len(payloads), f"{len(payloads)} messages")
        return received

    def close(self) -> None:
        for end in self._ends:
            end.close()


class BagWorld(World):
    """Write, close, read."""

    def __init__(self, path: Path, storage: str) -> None:
        self._path = path
        make = MIDDLEWARE.load("bag")
        self._reader: Middleware | None = None
        self._writer: Middleware = make(path=path, mode="write", storage=storage)
        self._make = make

    def publishing(self) -> Middleware:
        return self._writer

    def subscribing(self) -> Middleware:
        if self._reader is None:
            self._writer.close()
            self._reader = self._make(path=self._path, speed=0)
        return self._reader

    def exchange(
        self, payloads: Sequence[bytes], type_name: str, offered: Qos, requested: Qos, *, late: bool = False
    ) -> list[bytes]:
        del late  # a bag's reader is always late
        received: list[bytes] = []
        publisher = self._writer.advertise("/robot_1/topic", type_name, offered)
        for payload in payloads:
            publisher.publish(payload)
        reader = self.subscribing()
        reader.subscribe("/robot_1/topic", type_name, requested, received.append)
        assert not reader.finished
        reader.start()
        wait_for(lambda: reader.finished, "end of the bag")
        return received

    def close(self) -> None:
        self._writer.close()
        if self._reader is not None:
            self._reader.close()


DIFFERENT: dict[str, dict[str, Any]] = {
    "dds": {"padding": 3},
    "rclpy": {"padding": 3, "custom_types": False, "tells_depth": False},
}
"""Fields of :class:`World` in which a back-end differs."""
NEEDED = {"zenoh": "zenoh_router"}
"""Fixtures without which there is no graph."""
LIVE = [name for name, row in MIDDLEWARE.items() if row.scope != "none"]


@pytest.fixture(params=[*LIVE, "bag-mcap", "bag-sqlite3"])
def world(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    if request.param in LIVE:
        try:
            MIDDLEWARE.load(request.param)
        except BackendMissingError as missing:
            pytest.skip(str(missing))
        if request.param in NEEDED:
            request.getfixturevalue(NEEDED[request.param])
        world: World = LiveWorld(request.param, **DIFFERENT.get(request.param, {}))
    else:
        world = BagWorld(tmp_path / "bag", request.param.removeprefix("bag-"))
    try:
        yield world
    finally:
        world.close()


def check(received: Sequence[bytes], sent: Sequence[bytes], padding: int) -> None:
    assert len(received) == len(sent)
    for got, expected in zip(received, sent, strict=True):
        assert same(got, expected, padding), (got[:64], expected[:64])


@pytest.mark.parametrize("size", [5, 6, 7, 8, 724, 725, 65_537, 1_000_000])
def test_round_trip_byte_for_byte(world: World, size: int) -> None:
    payload = b"\0\1\0\0" + bytes(1 + i % 255 for i in range(size - 4))
    check(world.exchange([payload], STRING, RELIABLE, RELIABLE), [payload], world.padding)


def test_custom_type(world: World) -> None:
    if not world.custom_types:
        pytest.skip("rclpy needs a type's package; one that is not installed cannot pass")
    check(world.exchange([message(7)], CUSTOM, RELIABLE, RELIABLE), [message(7)], world.padding)


def test_many_messages_in_order(world: World) -> None:
    sent = [message(i, 64) for i in range(5000)]
    assert world.exchange(sent, STRING, RELIABLE, RELIABLE) == sent


def test_best_effort(world: World) -> None:
    assert world.exchange([message(1)], STRING, BEST_EFFORT, BEST_EFFORT) == [message(1)]


@pytest.mark.parametrize("requested", [LATCHED, ADAPT], ids=["asked for", "adapted"])
def test_late_joiner_gets_transient_local(world: World, requested: Qos) -> None:
    sent = [message(i) for i in range(5)]
    assert world.exchange(sent, STRING, LATCHED, requested, late=True) == sent


def test_a_volatile_late_joiner_gets_nothing_of_the_past(world: World) -> None:
    if isinstance(world, BagWorld):
        pytest.skip("a bag is nothing but the past")
    witnessed: list[bytes] = []
    received: list[bytes] = []
    publisher = world.publishing().advertise("/robot_1/topic", STRING, LATCHED)
    witness = world.subscribing().subscribe("/robot_1/topic", STRING, RELIABLE, witnessed.append)
    wait_for(lambda: publisher.matched() and witness.matched(), "match")
    publisher.publish(message(1))
    wait_for(witnessed.__len__, "a message")  # one on its way through a router still meets who subscribes meanwhile
    subscription = world.subscribing().subscribe("/robot_1/topic", STRING, RELIABLE, received.append)
    wait_for(lambda: publisher.matched() == 2 and subscription.matched(), "match")
    publisher.publish(message(2))
    wait_for(received.__len__, "a message")
    assert received == [message(2)]


def test_discover_tells_topic_type_and_qos(world: World) -> None:
    world.publishing().advertise("/robot_1/map", STRING, LATCHED)
    other = world.subscribing()
    wait_for(lambda: any(info.topic == "/robot_1/map" for info in other.discover()), "discovery")
    (info,) = [info for info in other.discover() if info.topic == "/robot_1/map"]
    assert info.type_name == STRING
    assert [(qos.reliability, qos.durability) for qos in info.publishers] == [("reliable", "transient_local")]


def test_a_subscription_hears_what_its_publishers_offer(world: World) -> None:
    """Two publishers before the subscription; where the graph is live, one leaves and another one comes."""
    heard: list[list[tuple[int, float, float]]] = []

    def hear(offers: Sequence[Qos]) -> None:
        heard.append(sorted((qos.depth * world.tells_depth, qos.lifespan_s, qos.deadline_s) for qos in offers))

    newest, timed = Qos("reliable", "volatile", 1), Qos("reliable", "volatile", 5, 0.25, 1.5)
    brief, long = (1 * world.tells_depth, 0.0, 0.0), (5 * world.tells_depth, 0.25, 1.5)
    first = world.publishing().advertise("/topic", STRING, newest)
    world.publishing().advertise("/topic", STRING, timed)
    subscription = world.subscribing().subscribe("/topic", STRING, RELIABLE, lambda _: None)
    subscription.follow(hear)
    wait_for(lambda: [brief, long] in heard, "both publishers")
    if isinstance(world, LiveWorld):
        first.close()
        wait_for(lambda: heard[-1] == [long], "the departure")
        world.publishing().advertise("/topic", STRING, newest)
        wait_for(lambda: heard[-1] == [brief, long], "the return")


def test_discover_leaves_own_endpoints_out(world: World) -> None:
    middleware = world.publishing()
    middleware.advertise("/robot_1/own", STRING, RELIABLE)
    if isinstance(world, LiveWorld):
        other = world.subscribing()
        wait_for(lambda: any(info.topic == "/robot_1/own" for info in other.discover()), "discovery by the other end")
    assert not [info for info in middleware.discover() if info.topic == "/robot_1/own"]


def test_a_failing_callback_stops_nothing(world: World) -> None:
    received: list[bytes] = []
    sent = [message(i) for i in range(3)]

    def callback(payload: bytes) -> None:
        received.append(payload)
        raise ValueError("a bug of the user's")

    publisher = world.publishing().advertise("/topic", STRING, RELIABLE)
    if isinstance(world, BagWorld):
        for payload in sent:
            publisher.publish(payload)
    middleware = world.subscribing()
    subscription = middleware.subscribe("/topic", STRING, RELIABLE, callback)
    middleware.start()
    if not isinstance(world, BagWorld):
        wait_for(lambda: publisher.matched() and subscription.matched(), "match")
        for payload in sent:
            publisher.publish(payload)
    wait_for(lambda: middleware.counters["callback_failed:/topic"] == 3, "three failures")
    assert received == sent


@pytest.mark.parametrize("topic", ["odom", "", "/", "/a//b", "/1st", "/with space", "/trailing/"])
def test_malformed_topic_is_an_error(world: World, topic: str) -> None:
    with pytest.raises(GrRos2Error):
        world.publishing().advertise(topic, STRING, RELIABLE)
    with pytest.raises(GrRos2Error):
        world.subscribing().subscribe(topic, STRING, RELIABLE, lambda _: None)


@pytest.mark.parametrize("type_name", ["Odometry", "", "nav_msgs/action/Odometry", "a/b/c/d"])
def test_malformed_type_is_an_error(world: World, type_name: str) -> None:
    with pytest.raises(ConfigError):
        world.publishing().advertise("/topic", type_name, RELIABLE)
    with pytest.raises(ConfigError):
        world.subscribing().subscribe("/topic", type_name, RELIABLE, lambda _: None)


def test_close_is_idempotent_and_final(world: World) -> None:
    publisher = world.publishing().advertise("/topic", STRING, RELIABLE)
    middleware = world.subscribing()
    subscription = middleware.subscribe("/topic", STRING, RELIABLE, lambda _: None)
    subscription.close()
    subscription.close()
    for end in (world.publishing(), middleware):
        end.close()
        end.close()
    publisher.close()
    publisher.close()
    with pytest.raises(MiddlewareError):
        publisher.publish(message(1))
    with pytest.raises(MiddlewareError):
        middleware.subscribe("/topic", STRING, RELIABLE, lambda _: None)
    assert publisher.matched() == 0 and subscription.matched() == 0


def test_no_callback_after_close(world: World) -> None:
    before = set(threading.enumerate())
    late: list[str] = []
    running = threading.Event()
    closed = False

    def callback(_: bytes) -> None:
        if closed:
            late.append("late")
        running.set()
        time.sleep(0.001)

    publisher = world.publishing().advertise("/topic", STRING, RELIABLE)
    if isinstance(world, BagWorld):
        for i in range(1000):
            publisher.publish(message(i))
    middleware = world.subscribing()
    subscription = middleware.subscribe("/topic", STRING, RELIABLE, callback)
    middleware.start()
    if not isinstance(world, BagWorld):
        wait_for(lambda: publisher.matched() and subscription.matched(), "match")
        for i in range(1000):
            publisher.publish(message(i))
    wait_for(running.is_set, "the first callback")
    middleware.close()
    closed = True
    ours = f"{middleware.name}-"
    threads = [thread for thread in set(threading.enumerate()) - before if thread.name.startswith(ours)]
    assert not late
    assert len(threads) <= (1 if isinstance(world, LiveWorld) else 0)  # that of the other end


def test_close_from_a_callback(world: World) -> None:
    done = threading.Event()
    publisher = world.publishing().advertise("/topic", STRING, LATCHED)
    publisher.publish(message(1))
    publisher.publish(message(2))
    middleware = world.subscribing()

    def callback(_: bytes) -> None:
        assert not done.is_set()
        middleware.close()
        done.set()

    middleware.subscribe("/topic", STRING, LATCHED, callback)
    middleware.start()
    wait_for(done.is_set, "close")
    assert not middleware.counters


def test_loads_by_name() -> None:
    loaded: dict[str, Any] = {name: MIDDLEWARE.load(name) for name in ("memory", "dds", "bag")}
    assert all(cls.name == name and issubclass(cls, Middleware) for name, cls in loaded.items())
