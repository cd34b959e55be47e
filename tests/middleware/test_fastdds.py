"""The embedded DDS against an independent one: Fast DDS from Debian, over the loopback interface, both directions."""

from __future__ import annotations

import logging
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from gr_ros2.middleware import Qos, ros_graph
from gr_ros2.middleware.dds import DdsMiddleware
from tests.compiled import compiled
from tests.domains import domain
from tests.middleware.calling import ADD, Adder, Caller
from tests.middleware.support import ADAPT, BEST_EFFORT, CUSTOM, LATCHED, Peer, message, same
from tests.waiting import wait_for

SOURCE = Path(__file__).parents[1] / "peers" / "fastdds_peer.cpp"
OPAQUE = Path(__file__).parents[2] / "gr_ros2_lab" / "race" / "fastdds_opaque.hpp"
HEADER = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")
THIRD = Path("/usr/include/fastdds/rtps/transport/UDPv4TransportDescriptor.hpp")
"""Fast DDS 3 has it; before, it was called `….h` and half of all names were `fastrtps`."""
OLDEST = (2, 6, 2)
"""Fast DDS before that throws the announcement of every Cyclone DDS 11 participant away: it holds binary properties."""
RELIABLE = Qos("reliable", "volatile", 100)


def installed() -> tuple[int, ...]:
    """Version of Fast DDS's headers."""
    header = "fastdds/config.hpp" if THIRD.exists() else "fastrtps/config.h"
    command = ["g++", "-E", "-dM", "-include", header, "-x", "c++", "/dev/null"]
    macros = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = dict(re.findall(r"#define FAST(?:DDS|RTPS)_VERSION_(M\w+) (\d+)", macros))
    return tuple(int(found[part]) for part in ("MAJOR", "MINOR", "MICRO"))


@pytest.fixture(scope="session")
def program(pytestconfig: pytest.Config) -> Path:
    """The peer."""
    if not HEADER.exists() or not shutil.which("g++"):
        pytest.skip("needs g++ and Fast DDS's headers: apt install g++ and libfastdds-dev or libfastrtps-dev")
    if installed() < OLDEST:
        pytest.skip(f"Fast DDS is {installed()}: from {OLDEST} on it hears Cyclone DDS 11")
    library = "-lfastdds" if THIRD.exists() else "-lfastrtps"
    return compiled(pytestconfig, SOURCE, "peer", ("-std=c++17", library, "-lfastcdr", "-lpthread"), [OPAQUE])


@pytest.fixture
def peer(program: Path) -> Iterator[Callable[..., Peer]]:
    made: list[Peer] = []

    def make(
        role: str, topic: str, qos: Qos, *, user_data: str = "", names: Sequence[str] = (), offset: int = 2
    ) -> Peer:
        names = names or [ros_graph.dds_topic(topic), ros_graph.dds_type(CUSTOM)]
        words = [qos.reliability or "", qos.durability or "", str(qos.depth)]
        if qos.lifespan_s and qos.deadline_s:
            words += [str(qos.lifespan_s * 1e3), str(qos.deadline_s * 1e3)]
        environment = {"USER_DATA": user_data} if user_data else {}
        made.append(Peer([str(program), str(domain(offset)), *names, role, *words], environment))
        wait_for(lambda: made[-1].ready, "the Fast DDS process")
        return made[-1]

    yield make
    for other in made:
        other.close()


@pytest.fixture
def middleware(monkeypatch: pytest.MonkeyPatch) -> Iterator[DdsMiddleware]:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    with DdsMiddleware(domain_id=domain(2)) as made:
        yield made


def until_received(publish: Callable[[], None], received: list[bytes], payload: bytes) -> None:
    """Publish it again and again, until it has come."""

    def come() -> bool:
        publish()
        return any(same(got, payload, 3) for got in list(received))

    wait_for(come, f"a message of {len(payload)} bytes")


SIZES = (8, 9, 724, 1400, 5828, 60_000)


@pytest.mark.parametrize("qos", [RELIABLE, BEST_EFFORT, LATCHED], ids=["reliable", "best effort", "latched"])
def test_from_fast_dds(middleware: DdsMiddleware, peer: Callable[..., Peer], qos: Qos) -> None:
    received: list[bytes] = []
    source = peer("pub", "/in", qos)
    subscription = middleware.subscribe("/in", CUSTOM, qos, received.append)
    wait_for(lambda: subscription.matched() and source.matched, "match")
    sent = [message(i, size) for i, size in enumerate(SIZES)]
    if qos.reliability == "best_effort":
        # Fast DDS matches in its own time, and a fragment may be lost: each is sent until it has come.
        for payload in sent:
            until_received(lambda p=payload: source.publish([p]), received, payload)
    else:
        first = message(99)
        until_received(lambda: source.publish([first]), received, first)
        source.publish(sent)
        wait_for(lambda: same(received[-1], sent[-1], 3), "the last message")
        assert all(same(got, payload, 3) for got, payload in zip(received[-len(sent) :], sent, strict=True))


@pytest.mark.parametrize("qos", [RELIABLE, BEST_EFFORT, LATCHED], ids=["reliable", "best effort", "latched"])
def test_to_fast_dds(middleware: DdsMiddleware, peer: Callable[..., Peer], qos: Qos) -> None:
    there = peer("sub", "/out", qos)
    publisher = middleware.advertise("/out", CUSTOM, qos)
    wait_for(lambda: publisher.matched() and there.matched, "match")
    sent = [message(i, size) for i, size in enumerate(SIZES)]
    if qos.reliability == "best_effort":
        for payload in sent:
            until_received(lambda p=payload: publisher.publish(p), there.received, payload)
    else:
        for payload in sent:
            publisher.publish(payload)
        wait_for(lambda: len(there.received) >= len(sent), "messages")
        assert all(same(got, payload, 3) for got, payload in zip(there.received, sent, strict=True))


def test_a_megabyte_both_ways(middleware: DdsMiddleware, peer: Callable[..., Peer]) -> None:
    received: list[bytes] = []
    there, source = peer("sub", "/out", LATCHED), peer("pub", "/in", LATCHED)
    sent = message(1, 1_000_000)
    source.publish([sent])
    middleware.subscribe("/in", CUSTOM, LATCHED, received.append)
    middleware.advertise("/out", CUSTOM, LATCHED).publish(sent)
    wait_for(lambda: received and there.received, "both")
    assert received == [sent] and there.received == [sent]


def test_latched_message_reaches_a_late_fast_dds_subscriber(
    middleware: DdsMiddleware, peer: Callable[..., Peer]
) -> None:
    publisher = middleware.advertise("/map", CUSTOM, LATCHED)
    sent = [message(i) for i in range(5)]
    for payload in sent:
        publisher.publish(payload)
    there = peer("sub", "/map", LATCHED)
    wait_for(lambda: len(there.received) >= 5, "the latched messages")
    assert there.received == sent


def test_an_open_subscription_adapts_to_fast_dds_publishers(
    middleware: DdsMiddleware, peer: Callable[..., Peer]
) -> None:
    received: list[bytes] = []
    latched = peer("pub", "/map", LATCHED)
    latched.publish([message(1)])
    subscription = middleware.subscribe("/map", CUSTOM, ADAPT, received.append)
    wait_for(lambda: received == [message(1)], "the latched message")
    assert subscription.qos == Qos("reliable", "transient_local", 100)
    lossy = peer("pub", "/map", BEST_EFFORT)
    wait_for(lambda: subscription.qos == Qos("best_effort", "volatile", 100), "downgrade")
    until_received(lambda: lossy.publish([message(2)]), received, message(2))
    lossy.close()
    wait_for(lambda: subscription.qos == Qos("reliable", "transient_local", 100), "upgrade")
    latched.publish([message(3)])
    wait_for(lambda: message(3) in received, "the last message")
    assert received.count(message(1)) == 1 and received.count(message(3)) == 1


def test_discovery_of_fast_dds_endpoints(middleware: DdsMiddleware, peer: Callable[..., Peer]) -> None:
    peer("pub", "/robot_1/odom", LATCHED)
    peer("sub", "/robot_2/odom", BEST_EFFORT)
    wait_for(lambda: len(middleware.discover()) == 2, "both topics")
    published, subscribed = middleware.discover()
    assert (published.topic, published.type_name) == ("/robot_1/odom", CUSTOM)
    assert [(q.reliability, q.durability) for q in published.publishers] == [("reliable", "transient_local")]
    assert [(q.reliability, q.durability) for q in subscribed.subscribers] == [("best_effort", "volatile")]


def test_lifespan_and_deadline_are_told_and_the_depth_is_not(
    middleware: DdsMiddleware, peer: Callable[..., Peer]
) -> None:
    peer("pub", "/odom", Qos("reliable", "volatile", 1, 0.25, 1.5))
    wait_for(middleware.discover, "the topic")
    (found,) = middleware.discover()
    (offer,) = found.publishers
    assert (offer.lifespan_s, offer.deadline_s) == pytest.approx((0.25, 1.5), abs=1e-6)
    assert offer.depth == Qos().depth, "what is not told is no depth of 1"


PEI_HASH = "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
"""Of rmw_dds_common/msg/ParticipantEntitiesInfo since Iron."""


def listed_gid_bytes(info: bytes) -> int:
    """Bytes of a Gid in ParticipantEntitiesInfo of one node: behind the first of them stands the number of nodes."""
    return next((size for size in (16, 24) if info[4 + size : 8 + size] == b"\1\0\0\0"), 0)


def test_gids_are_as_wide_as_the_graph_has_them(peer: Callable[..., Peer], monkeypatch: pytest.MonkeyPatch) -> None:
    """A node of Humble sees 24 bytes, also beside another gr-ros2; once one of Jazzy is there, both see 16."""
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    names = (ros_graph.DISCOVERY_TOPIC, ros_graph.DISCOVERY_TYPE)
    latched = Qos("reliable", "transient_local", 1)
    with (
        DdsMiddleware(domain_id=domain(3), node_name="one") as one,
        DdsMiddleware(domain_id=domain(3), node_name="two"),
    ):
        humble = peer("sub", "", latched, names=names, offset=3)
        wait_for(lambda: len({info[4:20] for info in humble.received}) == 2, "both nodes")
        one.advertise("/a", CUSTOM, RELIABLE)  # by now each gr-ros2 knows the other
        wait_for(lambda: len(humble.received) >= 3, "the node with its publisher")
        assert {listed_gid_bytes(info) for info in humble.received} == {24}
        jazzy = peer("sub", "", latched, names=names, user_data=f"typehash={PEI_HASH};", offset=3)
        wait_for(lambda: len({i[4:20] for i in jazzy.received if listed_gid_bytes(i) == 16}) == 2, "both nodes anew")


def test_a_type_has_the_hash_that_the_graph_gives_it(middleware: DdsMiddleware, peer: Callable[..., Peer]) -> None:
    given = "RIHS01_" + 64 * "5"
    peer("pub", "/in", RELIABLE, user_data=f"typehash={given};")
    wait_for(middleware.discover, "the publisher")
    publisher = middleware.advertise("/out", CUSTOM, RELIABLE)
    with DdsMiddleware(domain_id=domain(2), node_name="watching") as watching:

        def told() -> list[str]:
            found = watching._others.publishers("/out")
            return [ros_graph.announced_hash(e.user_data) for e in found if e.key == publisher.writer.guid]

        wait_for(told, "our publisher")
        assert told() == [given]


def test_clients_and_servers_of_fast_dds_are_refused_by_name(
    middleware: DdsMiddleware, peer: Callable[..., Peer]
) -> None:
    taken: list[object] = []
    there: list[bool] = []
    middleware.serve("/served", ADD, lambda *request: taken.append(request))
    middleware.client("/called", ADD, lambda *_: None, there.append)
    client = peer("pub", "", RELIABLE, names=ros_graph.dds_service("/served", ADD)[0])
    server = peer("sub", "", RELIABLE, names=ros_graph.dds_service("/called", ADD)[0])
    wait_for(lambda: client.matched and server.matched, "both to be found")

    def refused() -> bool:
        client.publish([message(1, 40)])
        return {"other_rmw:/served", "other_rmw:/called"} <= middleware.counters.keys()

    wait_for(refused, "both to be refused")
    assert not taken
    assert not there


def test_no_service_is_offered_where_every_node_would_wait_in_vain(
    middleware: DdsMiddleware, peer: Callable[..., Peer], caplog: pytest.LogCaptureFixture
) -> None:
    """A node of Fast DDS that finds a server expects an answer."""
    server, other = (middleware.serve(name, ADD, lambda *_: None) for name in ("/served", "/other"))
    names = (ros_graph.DISCOVERY_TOPIC, ros_graph.DISCOVERY_TYPE)
    with DdsMiddleware(domain_id=domain(2), node_name="link") as another_link:  # no node of ROS
        wait_for(lambda: "/served" in another_link.discover_services(), "the service")
        before = peer("pub", "", RELIABLE, names=ros_graph.dds_service("/served", ADD)[0])
        wait_for(lambda: before.matched, "a client to find it")
        node = peer("pub", "", Qos("reliable", "transient_local", 1), names=names)
        wait_for(lambda: "/served" not in another_link.discover_services(), "the service to go")
        gone = {"not_offered:/served", "not_offered:/other"}
        wait_for(lambda: gone <= middleware.counters.keys(), "both to be counted")
        said = lambda: [record for record in caplog.records if "not_offered" in record.getMessage()]  # noqa: E731
        wait_for(lambda: any(record.levelno >= logging.WARNING for record in said()), "a line about it")
        assert [record.levelname for record in said() if record.levelno >= logging.WARNING] == ["WARNING"]
        later = middleware.serve("/later", ADD, lambda *_: None)
        client = peer("pub", "", RELIABLE, names=ros_graph.dds_service("/later", ADD)[0])
        wait_for(lambda: not before.matched, "the node to learn that the service has gone")
        assert not client.matched
        node.close()
        wait_for(lambda: {"/served", "/later"} <= another_link.discover_services().keys(), "both, without that node")
    server.close()
    other.close()
    later.close()


def test_a_client_of_fast_dds_waits_for_our_server_where_one_of_cyclone_is_answered(
    middleware: DdsMiddleware, peer: Callable[..., Peer]
) -> None:
    """rmw_fastrtps calls a server there where its client matches as many readers of requests as writers of replies."""
    cyclone = Caller(middleware, "/served")
    with DdsMiddleware(domain_id=domain(2), node_name="link") as link:
        server = Adder(link, "/served")
        requests, replies = ros_graph.dds_service("/served", ADD)
        asks, hears = peer("pub", "", RELIABLE, names=requests), peer("sub", "", RELIABLE, names=replies)
        wait_for(lambda: (asks.matched, hears.matched) == (1, 2), "Fast DDS to find all of the server")
        wait_for(lambda: cyclone.there, "the client of Cyclone to find the server")
        cyclone.call(1)
        wait_for(lambda: cyclone.got == {1: [1001]}, "its answer")
        assert (asks.matched, hears.matched) == (1, 2)
        server.server.close()
        wait_for(lambda: (asks.matched, hears.matched) == (0, 0), "all of the server to leave")


def test_nodes_of_fast_dds_find_each_other_beside_a_link(
    middleware: DdsMiddleware, peer: Callable[..., Peer], capfd: pytest.CaptureFixture[str]
) -> None:
    """Each later listener hears what the native publishers and ours send, while the earlier ones run."""
    taken: list[bytes] = []
    ours = [middleware.advertise(f"/rx_robot_2/{name}", CUSTOM, RELIABLE) for name in "ab"]
    middleware.subscribe("/native", CUSTOM, ADAPT, taken.append)
    native = peer("pub", "/native", RELIABLE)
    for number in range(3):
        listeners = [peer("sub", topic, RELIABLE) for topic in ("/rx_robot_2/a", "/rx_robot_2/b", "/native")]
        sent = message(number)

        def all_heard(sent: bytes = sent, listeners: list[Peer] = listeners) -> bool:
            for publisher in ours:
                publisher.publish(sent)
            native.publish([sent])
            return all(sent in listener.received for listener in listeners) and sent in taken

        wait_for(all_heard, "every listener")
    assert "invalid type object" not in capfd.readouterr().err
