"""What a client of Foxglove's protocol sees of a link."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import sys
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="needs foxglove-sdk")

from rich.console import Console
from tornado.httpclient import HTTPRequest
from tornado.websocket import websocket_connect

from gr_ros2.cli.dashboard import foxglove_server
from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.messages import GRID, IMAGE, VIDEO, read
from gr_ros2.core.errors import BackendMissingError, ConfigError
from gr_ros2.dashboard.addresses import own_addresses
from gr_ros2.dashboard.foxglove import BACKLOG, FoxgloveServer
from gr_ros2.link.events import Accepted, Announced, Delivered
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.settings.registry import Topic
from gr_ros2.wire.table import AnnouncedTopic
from tests.codecs import scenes
from tests.codecs.test_instances import TF, transforms
from tests.domains import domain
from tests.waiting import PATIENCE_S, wait_for

QOS = Qos("reliable", "volatile", 0)
ROWS = (AnnouncedTopic(0, "tf", TF), AnnouncedTopic(1, "map", GRID, latched=True))


def _run() -> Any:
    """A link that sends /tf as robot 1."""
    sent = SimpleNamespace(frames=None, named=lambda: [("/robot_1/tf", Topic(0, "tf", TF))])
    return SimpleNamespace(
        sources={1: SimpleNamespace(subscriptions=sent)},
        received_as=lambda src, name: f"/rx_robot_{src}/{name}",
        calls=None,
    )


@pytest.fixture
def server() -> Any:
    with FoxgloveServer("127.0.0.1", 0) as made:
        made.run_started(_run())
        made.receiver_event(Announced(2, ROWS), 0.0)
        yield made


class Client:
    """A client that subscribes to every topic, and again to those of which nothing comes: the SDK tells of a channel
    slightly before it takes subscriptions of it.

    :param first: messages that it sends at first
    """

    def __init__(self, port: int, first: tuple[str | bytes, ...] = ()) -> None:
        self.channels: dict[int, Any] = {}
        self.services: dict[str, Any] = {}
        self.replies: list[bytes | str] = []
        """Of services, or why there is none."""
        self.calls: list[tuple[str, bytes]] = []
        """Still to be made."""
        self.seen: list[tuple[str, bytes]] = []
        self._port, self._asked, self._first = port, 0, first
        self._of: dict[int, int] = {}
        """The channel of each subscription."""

    def watch(self, until: Callable[[], bool], work: Callable[[], None] = lambda: None) -> None:
        """Take part until something is so; ``work`` is done at each look."""
        asyncio.run(asyncio.wait_for(self._run(until, work), PATIENCE_S))

    async def _run(self, until: Callable[[], bool], work: Callable[[], None]) -> None:
        request = HTTPRequest(f"ws://127.0.0.1:{self._port}")
        connection = await websocket_connect(request, subprotocols=["foxglove.sdk.v1"])
        for message in self._first:
            await connection.write_message(message, binary=isinstance(message, bytes))
        waiting = asyncio.ensure_future(_read(connection))
        while not until():
            work()
            while self.calls:
                name, payload = self.calls.pop()
                head = struct.pack("<BIII", 2, self.services[name]["id"], 1, len(b"cdr")) + b"cdr"
                await connection.write_message(head + payload, binary=True)
            done, _ = await asyncio.wait([waiting], timeout=0.02)
            if done:
                await self._take(connection, waiting.result())
                waiting = asyncio.ensure_future(_read(connection))
            else:
                heard = {topic for topic, _ in self.seen}
                await self._ask(
                    connection, [n for n, channel in self.channels.items() if channel["topic"] not in heard]
                )
        waiting.cancel()
        connection.close()

    async def _take(self, connection: Any, message: str | bytes | None) -> None:
        assert message is not None, "the server has closed the connection"
        if isinstance(message, bytes):
            if message[0] == 1:
                (number,) = struct.unpack_from("<I", message, 1)
                self.seen.append((self.channels[self._of[number]]["topic"], message[13:]))
            elif message[0] == 3:
                self.replies.append(message[13 + len(b"cdr") :])
            return
        said = json.loads(message)
        if said["op"] == "serviceCallFailure":
            self.replies.append(said["message"])
        self.services |= {each["name"]: each for each in said.get("services", ())}
        for number in said.get("serviceIds", ()):
            self.services = {name: each for name, each in self.services.items() if each["id"] != number}
        for channel in said.get("channels", ()) if said["op"] == "advertise" else ():
            self.channels[channel["id"]] = channel
            await self._ask(connection, [channel["id"]])

    async def _ask(self, connection: Any, numbers: list[int]) -> None:
        for number in numbers:
            self._asked += 1
            self._of[self._asked] = number
            asked = {"id": self._asked, "channelId": number}
            await connection.write_message(json.dumps({"op": "subscribe", "subscriptions": [asked]}))


async def _read(connection: Any) -> Any:
    return await connection.read_message()


def test_what_is_sent_and_what_comes_out_is_seen_as_it_is_with_its_definition(server: FoxgloveServer) -> None:
    client = Client(server.port)
    sent, came = transforms("odom"), transforms("arm")

    def work() -> None:
        server.sender_event(1, Accepted(0, 0, sent, 0.0))
        server.receiver_event(Delivered(2, 0, came, 0), 0.0)

    client.watch(lambda: {("/robot_1/tf", sent), ("/rx_robot_2/tf", came)} <= set(client.seen), work)
    channel = next(iter(client.channels.values()))
    assert (channel["encoding"], channel["schemaName"], channel["schemaEncoding"]) == ("cdr", TF, "ros2msg")
    assert "geometry_msgs/TransformStamped[] transforms" in channel["schema"].replace("/msg/", "/")
    assert "MSG: geometry_msgs/" in channel["schema"]


@pytest.mark.parametrize("own", [False, True])
def test_a_camera_is_handed_on_as_the_video_that_crossed_the_link(server: FoxgloveServer, own: bool) -> None:
    """Beside the picture; who begins to watch gets a key frame. Depth is no video."""
    pytest.importorskip("av", reason="needs PyAV")
    encoder = CodedTopic(IMAGE).encoder()
    asked: list[tuple[int, int]] = []
    run = _run()
    run.wants_key = lambda *key: asked.append(key)
    rows = [Topic(2, "camera/image", IMAGE), Topic(3, "depth/image", IMAGE)]
    run.sources[1].subscriptions.frames = {2, 3}
    run.sources[1].subscriptions.named = lambda: [(f"/robot_1/{topic.name}", topic) for topic in rows]
    server.run_started(run)
    told = [AnnouncedTopic(topic.topic_id, topic.name, IMAGE, codec="frames") for topic in rows]
    server.receiver_event(Announced(2, tuple(told)), 0.0)
    pictures = [scenes.image(scenes.view(number, 64, 48), "rgb8", number) for number in range(4)]
    depth = scenes.image((scenes.room(0, 64, 48) * 1000).astype(np.uint16), "16UC1", 0)
    exact = CodedTopic(IMAGE, {"camera": "off", "depth": "off"}).encoder().encode(depth).data
    client, count = Client(server.port), 0

    def work() -> None:
        nonlocal count
        coded = encoder.encode(pictures[count % 4], 900, key=bool(asked) and not count % 8)
        for topic_id, frame, shown in ((2, coded.data, pictures[count % 4]), (3, exact, depth)):
            if own:
                server.sender_event(1, Accepted(count, topic_id, frame, float(count)))
            else:
                server.receiver_event(Delivered(2, topic_id, frame, 0, shown=shown), float(count))
        count += 1

    name = "/robot_1/camera/image/video" if own else "/rx_robot_2/camera/image/video"
    client.watch(lambda: len([topic for topic, _ in client.seen if topic == name]) > 12, work)
    assert (1 if own else 2, 2) in asked
    (channel,) = [channel for channel in client.channels.values() if channel["topic"] == name]
    assert channel["schemaName"] == VIDEO
    assert "uint8[] data" in channel["schema"]
    videos = [read(VIDEO, message) for topic, message in client.seen if topic == name]
    assert {video.format for video in videos} == {"h264"}
    assert any(bytes(video.data[4:5])[0] & 31 == 7 for video in videos), "a key frame begins with its parameters"
    assert not any("depth" in topic and "video" in topic for topic, _ in client.seen)
    assert own or ("/rx_robot_2/camera/image", pictures[0]) in client.seen


def test_who_comes_late_sees_the_map(server: FoxgloveServer) -> None:
    (message,) = scenes.exploring(1, 100)
    server.receiver_event(Delivered(2, 1, b"a frame", 0, shown=message), 0.0)
    client = Client(server.port)
    client.watch(lambda: bool(client.seen))
    assert client.seen == [("/rx_robot_2/map", message)]


def test_a_map_that_is_too_large_to_be_kept_leaves_no_older_one_for_who_comes_late(
    server: FoxgloveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    small, large = scenes.exploring(1, 50)[0], scenes.exploring(1, 100)[0]
    monkeypatch.setattr("gr_ros2.dashboard.foxglove._CACHED_BYTES", len(small))
    for message, kept in ((small, [small]), (small, [small]), (large, [])):
        server.receiver_event(Delivered(2, 1, b"a frame", 0, shown=message), 0.0)
        assert list(server._newest.values()) == kept


def test_a_client_that_reads_nothing_slows_nobody_and_loses_messages_of_its_own(server: FoxgloveServer) -> None:
    """It opens a connection, subscribes and never reads again, while more comes than any buffer of its holds."""
    big = transforms("x" * 100_000)
    server.receiver_event(Delivered(2, 0, big, 0), 0.0)
    with socket.create_connection(("127.0.0.1", server.port)) as slow:
        slow.sendall(
            b"GET / HTTP/1.1\r\nHost: h\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        )
        wait_for(lambda: b"101" in slow.recv(4096), "the server")
        number = next(iter(server._channels.values()))[1].id()
        asked = json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": number}]}).encode()
        slow.sendall(bytes((0x81, 0x80 | len(asked))) + bytes(4) + asked)
        channel = server._channels["/rx_robot_2/tf"][1]
        wait_for(channel.has_sinks, "the subscription")
        for _ in range(4 * BACKLOG):
            server.receiver_event(Delivered(2, 0, big, 0), 0.0)
        client, last = Client(server.port), transforms("last")
        client.watch(
            lambda: ("/rx_robot_2/tf", last) in client.seen,
            lambda: server.receiver_event(Delivered(2, 0, last, 0), 0.0),
        )
    assert client.seen[-1] == ("/rx_robot_2/tf", last)


def test_a_live_link_is_seen_by_both_names(tmp_path: Path) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    pytest.importorskip("zmq", reason="needs pyzmq")
    from gr_ros2.cli.link import _live
    from gr_ros2.observe.observers import RunObservers
    from tests.radio.test_instances import robot

    said = transforms("odom")
    with (
        FoxgloveServer("127.0.0.1", 0) as server,
        MemoryMiddleware(domain_id=domain(1)) as near,
        MemoryMiddleware(domain_id=domain(2)) as far,
    ):
        observers = RunObservers([server], threaded=True)
        two = robot(2, tmp_path, 1, observer=observers)
        observers.run_started(_live(two.link))
        with robot(1, tmp_path, 2), two:
            publishers = [near.advertise("/robot_1/tf", TF, QOS), far.advertise("/robot_2/tf", TF, QOS)]
            client = Client(server.port)

            def work() -> None:
                for publisher in publishers:
                    publisher.publish(said)

            wanted = {("/rx_robot_1/tf", said), ("/robot_2/tf", said)}
            try:
                client.watch(lambda: wanted <= set(client.seen), work)
            finally:
                observers.run_ended(None)
        assert observers.incomplete() == []


def test_a_service_of_another_robot_is_called_and_is_gone_with_its_server(tmp_path: Path) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    pytest.importorskip("zmq", reason="needs pyzmq")
    from gr_ros2.cli.link import _live
    from gr_ros2.observe.observers import RunObservers
    from tests.radio.test_instances import robot

    lamp, request, reply = "/rx_robot_2/lamp", b"\0\1\0\0\1", b"\0\1\0\0\1\0\0\0\1\0\0\0\0"
    with FoxgloveServer("127.0.0.1", 0) as server, MemoryMiddleware(domain_id=domain(2)) as far:
        asked: list[bytes] = []

        def answer(client: Any, payload: bytes) -> None:
            asked.append(payload)
            lamps.reply(client, reply)

        lamps = far.serve("/robot_2/lamp", "std_srvs/srv/SetBool", answer)
        other = far.serve("/robot_2/own", "own_package/srv/Own", lambda *_: None)
        observers = RunObservers([server], threaded=True)
        one = robot(1, tmp_path, 2, observer=observers)
        observers.run_started(_live(one.link))
        with one, robot(2, tmp_path, 1):
            client = Client(server.port)
            try:
                client.watch(lambda: len(client.services) == 2)
                assert client.services[lamp]["type"] == "std_srvs/srv/SetBool"
                assert client.services[lamp]["request"]["schema"].strip() == "bool data"
                assert "request" not in client.services["/rx_robot_2/own"]
                client.calls.append((lamp, request))
                client.watch(lambda: bool(client.replies))
                assert (asked, client.replies) == ([request], [reply])
                lamps.close()
                client.watch(lambda: lamp not in client.services)
            finally:
                observers.run_ended(None)
        other.close()
        assert observers.incomplete() == []


def test_without_the_sdk_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(BackendMissingError, match=r"--foxglove needs foxglove-sdk: pip install 'gr-ros2\[foxglove\]'"):
        FoxgloveServer("127.0.0.1", 0)


def test_who_serves_the_network_is_told_the_address_that_others_use(caplog: pytest.LogCaptureFixture) -> None:
    said = StringIO()
    with foxglove_server("0.0.0.0:0", Console(file=said, width=200)) as (served,):
        assert said.getvalue() == f"Foxglove: ws://{own_addresses()[0]}:{served.port}\n"
        assert "everybody on the network" in caplog.text


def test_a_client_that_sends_nonsense_is_served_and_fills_no_log(caplog: pytest.LogCaptureFixture) -> None:
    nonsense = ("{", "null", b"\xff", b"\x02", '{"op": "subscribe", "subscriptions": [{"id": 7, "channelId": 9999}]}')
    with foxglove_server("127.0.0.1:0", Console(file=StringIO())) as (served,):
        served.run_started(_run())
        client, sent = Client(served.port, nonsense), transforms("odom")
        client.watch(lambda: bool(client.seen), lambda: served.sender_event(1, Accepted(0, 0, sent, 0.0)))
    assert client.seen[0] == ("/robot_1/tf", sent)
    assert caplog.text == ""


def test_a_port_that_is_taken_is_named(server: FoxgloveServer) -> None:
    with pytest.raises(ConfigError, match=rf"foxglove = 127\.0\.0\.1:{server.port}: cannot be served there"):
        FoxgloveServer("127.0.0.1", server.port)
