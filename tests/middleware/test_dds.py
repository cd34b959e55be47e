"""The embedded DDS: processes, domains, interfaces, QoS that adapts, what the ROS graph is told."""

from __future__ import annotations

import re
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.middleware import Qos, cdr_dds, ros_graph
from gr_ros2.middleware.base import Durability
from gr_ros2.middleware.cdr_dds import RawReader
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.middleware.dds_domains import POOL, configuration
from gr_ros2_lab.race.namespaces import Namespace, inside
from tests.domains import domain
from tests.lab.race.support import needs_namespaces
from tests.middleware.support import ADAPT, BEST_EFFORT, CUSTOM, LATCHED, RELIABLE, STRING, Peer, message, same
from tests.waiting import PATIENCE_S, wait_for

ROOT = Path(__file__).parents[2]
PEER = [sys.executable, "-m", "tests.middleware.dds_peer"]


@pytest.fixture
def join(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., DdsMiddleware]]:
    """Makes participants on the loopback interface that are closed at the end."""
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    made: list[DdsMiddleware] = []

    def make(offset: int = 0, node_name: str = "test") -> DdsMiddleware:
        made.append(DdsMiddleware(domain_id=domain(offset), node_name=node_name))
        return made[-1]

    yield make
    for middleware in made:
        middleware.close()


@pytest.fixture
def peer(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Peer]]:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    made: list[Peer] = []

    def make(role: str, topic: str, type_name: str, qos: Qos, offset: int = 0) -> Peer:
        words = [qos.reliability or "adapt", qos.durability or "adapt", str(qos.depth)]
        made.append(Peer([*PEER, str(domain(offset)), topic, type_name, role, *words]))
        wait_for(lambda: made[-1].ready, "the other process")
        return made[-1]

    yield make
    for other in made:
        other.close()


@pytest.mark.parametrize("qos", [RELIABLE, BEST_EFFORT, LATCHED], ids=["reliable", "best effort", "latched"])
def test_between_processes(join: Callable[..., DdsMiddleware], peer: Callable[..., Peer], qos: Qos) -> None:
    received: list[bytes] = []
    there = peer("sub", "/out", CUSTOM, qos)
    source = peer("pub", "/in", CUSTOM, qos)
    middleware = join()
    publisher = middleware.advertise("/out", CUSTOM, qos)
    subscription = middleware.subscribe("/in", CUSTOM, qos, received.append)
    wait_for(lambda: publisher.matched() and there.matched and subscription.matched() and source.matched, "match")
    sent = [message(i, size) for i, size in enumerate((8, 724, 5828, 1_000_000 if qos == RELIABLE else 60_000))]
    for payload in sent:
        publisher.publish(payload)
    source.publish(sent)
    wait_for(lambda: len(there.received) >= 4 and len(received) >= 4, "messages")
    assert received == sent and there.received == sent


def test_a_message_tells_how_long_it_has_waited_behind_which_newer_ones_came(
    join: Callable[..., DdsMiddleware],
) -> None:
    waits: list[float] = []
    begun, sent = threading.Event(), threading.Event()

    def take(_: bytes) -> None:
        begun.set()
        assert sent.wait(PATIENCE_S)
        waits.append(subscription.waited_s)

    subscription = join().subscribe("/odom", STRING, RELIABLE, take)
    publisher = join(node_name="other").advertise("/odom", STRING, RELIABLE)
    wait_for(lambda: publisher.matched() and subscription.matched(), "match")
    publisher.publish(message(0))
    assert begun.wait(PATIENCE_S)
    times = []
    for number in range(1, 4):
        publisher.publish(message(number))
        times.append(time.monotonic())
        wait_for(lambda: time.monotonic() > times[-1] + 0.02, "time to pass")
    sent.set()
    wait_for(lambda: len(waits) == 4, "messages")
    assert waits[0] == waits[3] == 0
    assert waits[1] > waits[2] >= 0.015


def test_latched_message_reaches_an_adapting_subscription_that_comes_late(
    join: Callable[..., DdsMiddleware], peer: Callable[..., Peer]
) -> None:
    source = peer("pub", "/tf_static", STRING, LATCHED)
    source.publish([message(1), message(2)])
    middleware = join()
    received: list[bytes] = []
    subscription = middleware.subscribe("/tf_static", STRING, ADAPT, received.append)
    wait_for(lambda: len(received) == 2, "the latched messages")
    assert subscription.qos == Qos("reliable", "transient_local", 100)
    source.publish([message(3)])
    wait_for(lambda: len(received) >= 3, "one more")
    assert received == [message(1), message(2), message(3)]


def test_a_subscription_adapts_as_publishers_come_and_go(join: Callable[..., DdsMiddleware]) -> None:
    here, first, second = join(), join(), join()
    received: list[bytes] = []
    subscription = here.subscribe("/map", STRING, ADAPT, received.append)
    assert subscription.qos == Qos("best_effort", "volatile", 100)

    latched = first.advertise("/map", STRING, LATCHED)
    latched.publish(message(1))
    wait_for(lambda: subscription.qos == Qos("reliable", "transient_local", 100), "upgrade")
    wait_for(lambda: received == [message(1)], "the latched message")

    lossy = second.advertise("/map", STRING, BEST_EFFORT)
    wait_for(lambda: subscription.qos == Qos("best_effort", "volatile", 100), "downgrade")
    wait_for(lossy.matched, "match")
    lossy.publish(message(2))
    latched.publish(message(3))
    wait_for(lambda: len(received) >= 3, "both publishers' messages")

    second.close()
    wait_for(lambda: subscription.qos == Qos("reliable", "transient_local", 100), "upgrade again")
    latched.publish(message(4))
    wait_for(lambda: message(4) in received, "the last message")
    wait_for(lambda: len(subscription.readers()) == 1, "end of the overlap")
    latched.publish(message(5))
    wait_for(lambda: message(5) in received, "a message to the one reader left")
    assert sorted(received) == [message(i) for i in range(1, 6)]
    assert here.counters == {}


def test_nothing_is_lost_or_repeated_while_adapting(join: Callable[..., DdsMiddleware]) -> None:
    here, first, second = join(), join(), join()
    received: list[bytes] = []
    subscription = here.subscribe("/odom", STRING, Qos(depth=0), received.append)
    steady = first.advertise("/odom", STRING, RELIABLE)
    wait_for(lambda: subscription.matched() and steady.matched(), "match")
    stop = threading.Event()
    sent: list[bytes] = []

    def publish() -> None:
        while not stop.wait(0.001):
            sent.append(message(len(sent)))
            steady.publish(sent[-1])

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        for _ in range(3):
            wait_for(lambda: subscription.qos == Qos("reliable", "volatile", 0), "reliable")
            passing = second.advertise("/odom", STRING, BEST_EFFORT)
            wait_for(lambda: subscription.qos == Qos("best_effort", "volatile", 0), "best effort")
            passing.close()
    finally:
        stop.set()
        thread.join()
    wait_for(lambda: len(received) >= len(sent), "all messages")
    assert received == sent


@pytest.mark.parametrize("durability", ["volatile", "transient_local"])
def test_no_message_comes_after_a_later_one_while_joining(
    join: Callable[..., DdsMiddleware], peer: Callable[..., Peer], durability: Durability
) -> None:
    """A busy publisher with a long past, and subscriptions that find out what it offers only once it sends to them."""
    source = peer("pub", "/odom", STRING, Qos("reliable", durability, 500))
    stop = threading.Event()

    def publish() -> None:
        for number in count(1):
            source.publish([message(number)])
            if stop.wait(0.001):
                break

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        for _ in range(6):
            here, received = join(), list[bytes]()
            here.subscribe("/odom", STRING, Qos(depth=0), received.append)
            wait_for(lambda received=received: len(received) > 200, "messages")
            here.close()
            numbers = [int.from_bytes(payload[4:8], "little") for payload in received]
            assert numbers == sorted(set(numbers))
            if durability == "transient_local":
                assert numbers == list(range(numbers[0], numbers[-1] + 1)), "the past is not whole"
                assert here.counters == {}
    finally:
        stop.set()
        thread.join()


def test_a_fixed_part_of_the_qos_stays(join: Callable[..., DdsMiddleware]) -> None:
    here, there = join(), join()
    subscription = here.subscribe("/a", STRING, Qos("best_effort", None, 5), lambda _: None)
    there.advertise("/a", STRING, LATCHED)
    wait_for(lambda: subscription.qos == Qos("best_effort", "transient_local", 5), "durability")


@pytest.mark.parametrize(
    ("offered", "requested", "policy"),
    [
        (Qos("best_effort", "volatile"), Qos("reliable", "volatile"), "reliability"),
        (Qos("reliable", "volatile"), Qos("reliable", "transient_local"), "durability"),
    ],
)
def test_incompatible_qos_is_counted_on_both_ends(
    join: Callable[..., DdsMiddleware],
    caplog: pytest.LogCaptureFixture,
    offered: Qos,
    requested: Qos,
    policy: str,
) -> None:
    here, there = join(), join()
    here.subscribe("/a", STRING, requested, lambda _: None)
    publishers = [there.advertise("/a", STRING, offered) for _ in range(3)]
    name = f"incompatible_qos:/a:{policy}"
    wait_for(lambda: here.counters[name] == 3 and there.counters[name] == 3, "both counters")
    assert not any(publisher.matched() for publisher in publishers)
    lines = lambda: sum(name in record.message for record in caplog.records)  # noqa: E731
    wait_for(lambda: lines() == 2, "a line of each participant, which follows its first count")


def test_another_type_under_the_same_name_is_counted(join: Callable[..., DdsMiddleware]) -> None:
    here, there = join(), join()
    subscription = here.subscribe("/a", STRING, ADAPT, lambda _: None)
    there.advertise("/a", CUSTOM, LATCHED)
    wait_for(lambda: here.counters["incompatible_type:/a"] == 1, "the counter")
    assert subscription.matched() == 0 and subscription.qos == Qos("best_effort", "volatile", 100)


@pytest.mark.parametrize("depth", [3, 100])
def test_depth_bounds_what_waits_and_drops_are_counted(join: Callable[..., DdsMiddleware], depth: int) -> None:
    here, there = join(), join()
    reached, release = threading.Event(), threading.Event()
    received: list[bytes] = []

    def callback(payload: bytes) -> None:
        received.append(payload)
        reached.set()
        release.wait(PATIENCE_S)

    subscription = here.subscribe("/a", STRING, Qos("reliable", "volatile", depth), callback)
    publisher = there.advertise("/a", STRING, RELIABLE)
    wait_for(lambda: publisher.matched() and subscription.matched(), "match")
    publisher.publish(message(0))
    wait_for(reached.is_set, "the first callback")
    for i in range(1, 201):
        publisher.publish(message(i))  # within a process the DDS hands over before this returns
    release.set()
    wait_for(lambda: len(received) == depth + 1, "what was kept")
    assert received == [message(i) for i in (0, *range(201 - depth, 201))]
    assert here.counters == {"samples_lost:/a": 200 - depth}
    assert subscription.lost == 200 - depth


def test_a_subscriber_that_does_not_keep_up_blocks_for_a_second_at_most(
    join: Callable[..., DdsMiddleware], peer: Callable[..., Peer]
) -> None:
    there = peer("sub", "/a", STRING, RELIABLE)
    middleware = join()
    publisher = middleware.advertise("/a", STRING, RELIABLE)
    wait_for(lambda: publisher.matched() and there.matched, "match")
    there.signal(signal.SIGSTOP)
    sent = 0
    with pytest.raises(MiddlewareError, match="does not keep up"):
        for _ in range(10_000):
            publisher.publish(message(sent, 8000))
            sent += 1
    there.signal(signal.SIGCONT)
    assert middleware.counters == {"publish_blocked:/a": 1}
    wait_for(lambda: len(there.received) >= sent, "what was accepted")
    assert there.received == [message(i, 8000) for i in range(sent)]


def test_a_program_that_forgets_to_close_ends_all_the_same() -> None:
    script = (
        "from gr_ros2.middleware.dds import DdsMiddleware, Qos\n"
        f"m = DdsMiddleware(domain_id={domain()}, localhost_only=True)\n"
        "m.subscribe('/a', 'std_msgs/String', Qos(), print)\n"
        "m.advertise('/a', 'std_msgs/String', Qos()).publish(bytes([0, 1, 0, 0, 1, 0, 0, 0, 0]))\n"
    )
    assert subprocess.run([sys.executable, "-c", script], cwd=ROOT, timeout=PATIENCE_S).returncode == 0


def test_domains_do_not_mix(join: Callable[..., DdsMiddleware]) -> None:
    here, same_domain, other_domain = join(), join(), join(offset=1)
    received: list[bytes] = []
    here.subscribe("/a", STRING, RELIABLE, received.append)
    stranger = other_domain.advertise("/a", STRING, LATCHED)
    publisher = same_domain.advertise("/a", STRING, LATCHED)
    stranger.publish(message(1))
    publisher.publish(message(2))
    wait_for(publisher.matched, "match")
    publisher.publish(message(3))
    wait_for(lambda: message(3) in received, "the message of this domain")
    assert message(1) not in received and stranger.matched() == 0
    assert [info.topic for info in other_domain.discover()] == []


def test_our_own_publisher_reaches_our_own_subscription(join: Callable[..., DdsMiddleware]) -> None:
    middleware = join()
    received: list[bytes] = []
    publisher = middleware.advertise("/a", STRING, LATCHED)
    publisher.publish(message(1))
    middleware.subscribe("/a", STRING, ADAPT, received.append)
    wait_for(lambda: received == [message(1)], "the latched message")
    assert middleware.discover() == []


def test_padding_is_zeros_up_to_three(join: Callable[..., DdsMiddleware]) -> None:
    here, there = join(), join()
    received: list[bytes] = []
    subscription = here.subscribe("/a", STRING, RELIABLE, received.append)
    publisher = there.advertise("/a", STRING, RELIABLE)
    wait_for(lambda: publisher.matched() and subscription.matched(), "match")
    sent = [b"\0\1\0\0" + b"\xff" * n for n in range(1, 20)]
    for payload in sent:
        publisher.publish(payload)
    wait_for(lambda: len(received) >= len(sent), "messages")
    assert all(same(got, payload, 3) for got, payload in zip(received, sent, strict=True))


@pytest.mark.parametrize("payload", [b"", b"\0\1\0\0", b"\xff\xff\0\0\1\2\3\4"], ids=["empty", "header only", "no CDR"])
def test_what_is_no_cdr_is_refused(join: Callable[..., DdsMiddleware], payload: bytes) -> None:
    publisher = join().advertise("/a", STRING, RELIABLE)
    with pytest.raises(MiddlewareError, match="is not CDR"):
        publisher.publish(payload)


def test_ros_discovery_info_names_the_node_and_its_endpoints(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    watching = POOL.join(domain(), ros_graph.discovery_options(), b"")
    try:
        topic = cdr_dds.create_topic(watching, ros_graph.DISCOVERY_TOPIC, ros_graph.DISCOVERY_TYPE)
        reader = RawReader(watching, topic, LATCHED)
        node = DdsMiddleware(domain_id=domain(), node_name="radio", namespace="/robot_1")
        try:
            subscription = node.subscribe("/in", STRING, RELIABLE, lambda _: None)
            publisher = node.advertise("/out", STRING, RELIABLE)
            expected = ("/robot_1", "radio", [r.guid for r in subscription.readers()], [publisher.writer.guid])
            seen: list[tuple[str, str, list[bytes], list[bytes]]] = []

            def listed() -> bool:
                seen.extend(parse_entities(sample.payload, 24) for sample in reader.take())
                return bool(seen) and seen[-1] == expected

            wait_for(listed, "the node with both endpoints")
            subscription.close()
            expected = ("/robot_1", "radio", [], [publisher.writer.guid])
            wait_for(listed, "the node without the subscription")
        finally:
            node.close()
    finally:
        POOL.leave(domain(), watching)


def parse_entities(data: bytes, gid_bytes: int) -> tuple[str, str, list[bytes], list[bytes]]:
    """rmw_dds_common/msg/ParticipantEntitiesInfo of one node, read independently of our writer of it."""
    at = 4 + gid_bytes
    assert data[:4] == b"\0\1\0\0" and data[20:at] == bytes(gid_bytes - 16)

    def number() -> int:
        nonlocal at
        at = 4 + -(-(at - 4) // 4) * 4
        at += 4
        return int(struct.unpack_from("<I", data, at - 4)[0])

    def text() -> str:
        nonlocal at
        size = number()
        at += size
        assert data[at - 1] == 0
        return data[at - size : at - 1].decode()

    def gids() -> list[bytes]:
        nonlocal at
        count = number()
        at += count * gid_bytes
        return [data[at - (count - i) * gid_bytes :][:16] for i in range(count)]

    assert number() == 1
    found = text(), text(), gids(), gids()
    assert not data[at:].strip(b"\0") and len(data) - at < 4
    return found


def test_a_domain_is_on_loopback_or_not_for_the_whole_process(join: Callable[..., DdsMiddleware]) -> None:
    join()
    with pytest.raises(ConfigError, match="RANGE=LOCALHOST, asked for ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"):
        DdsMiddleware(domain_id=domain(), localhost_only=False)


INTERFACES = (
    "ip link set lo up && ip link add eth9 type veth peer name eth8 && ip addr add 10.9.8.7/24 dev eth9"
    " && ip addr add 10.9.9.7/24 dev eth8 && ip link set eth8 up && ip link set eth9 up"
)
JOINED_GROUPS = """
from gr_ros2.middleware.dds import DdsMiddleware
with DdsMiddleware(domain_id=7):
    for line in open("/proc/net/igmp"):
        if line[0].isdigit():
            device = line.split()[1]
        elif "00FFEF" in line:
            print(device + "@" + line.split()[0])
"""
SPDP, ELSEWHERE = "0100FFEF", "0200FFEF"
RANGE, PEERS, URI = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "CYCLONEDDS_URI"


@pytest.mark.parametrize("reach", ["SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT"])
def test_type_objects_of_fast_dds_are_left_alone(reach: str) -> None:
    options = ros_graph.discovery_options("auto", {RANGE: reach})
    assert "<IgnoreTypeInformation>1.15</IgnoreTypeInformation>" in configuration(options, 100, {})


OTHER_DEVICE = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='eth9'/></Interfaces></General></Domain>"
    "</CycloneDDS>"
)
OTHER_GROUP = (
    "<CycloneDDS><Domain><Discovery><SPDPMulticastAddress>239.255.0.2</SPDPMulticastAddress></Discovery></Domain>"
    "</CycloneDDS>"
)


@pytest.mark.parametrize(
    ("environment", "groups"),
    [
        ({"ROS_LOCALHOST_ONLY": "1"}, [f"lo@{SPDP}"]),
        ({"ROS_LOCALHOST_ONLY": "1", RANGE: "SUBNET"}, [f"lo@{SPDP}"]),
        ({"ROS_LOCALHOST_ONLY": "0"}, [f"eth8@{SPDP}"]),
        ({RANGE: "SUBNET", PEERS: "10.9.8.6"}, [f"eth8@{SPDP}"]),
        ({RANGE: "LOCALHOST"}, [f"lo@{SPDP}"]),
        ({RANGE: "LOCALHOST", PEERS: "10.9.8.6;localhost"}, [f"lo@{SPDP}"]),
        ({RANGE: "OFF"}, []),
        ({RANGE: "SYSTEM_DEFAULT"}, [f"eth8@{SPDP}"]),
        ({RANGE: "SUBNET", URI: OTHER_DEVICE}, [f"eth9@{SPDP}"]),
        ({RANGE: "LOCALHOST", URI: OTHER_GROUP}, [f"lo@{ELSEWHERE}"]),
    ],
)
def test_discovery_is_on_the_interface_that_the_environment_says(
    environment: dict[str, str], groups: list[str]
) -> None:
    """In a network namespace of its own, with two more interfaces: where is which discovery group joined?"""

    def isolated(command: str) -> subprocess.CompletedProcess[str]:
        paths = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "PYTHONPATH": str(ROOT)}
        words = ["unshare", "-n", "sh", "-c", command]
        return subprocess.run(words, env={**paths, **environment}, capture_output=True, text=True, timeout=PATIENCE_S)

    if not shutil.which("unshare") or isolated(INTERFACES).returncode:
        pytest.skip("needs the right to make a network namespace and a device in it")
    result = isolated(f"{INTERFACES} && exec {sys.executable} -c '{JOINED_GROUPS}'")
    assert result.stdout.split() == groups, result.stderr


def started(stack: ExitStack, path: str, role: str, chosen: str, named: str = "") -> Peer:
    """A node in a network namespace, with a range and static peers."""
    environment = {"ROS_LOCALHOST_ONLY": "0", RANGE: chosen, PEERS: named}
    command = [*PEER, "7", "/a", STRING, role, "reliable", "transient_local", "1"]
    peer = inside(path, lambda: Peer(command, environment))
    stack.callback(peer.close)
    wait_for(lambda: peer.ready, "a node that has started")
    return peer


@needs_namespaces
@pytest.mark.parametrize(
    ("first", "second"),
    [
        (("LOCALHOST", "10.9.8.6"), ("LOCALHOST", "10.9.8.7")),
        (("LOCALHOST", "10.9.8.6"), ("SUBNET", "")),  # hears nothing of the second, so it has to ask more than once
        (("SUBNET", ""), ("LOCALHOST", "10.9.8.7")),
    ],
)
def test_static_peers_are_found_on_another_machine(first: tuple[str, str], second: tuple[str, str]) -> None:
    """Two network namespaces, a cable between them; the second machine starts when the first has long asked for it."""
    with ExitStack() as stack:
        one, other = (stack.enter_context(Namespace()).path for _ in range(2))
        ends = ((one, "10.9.8.7", "eth9", first, "pub"), (other, "10.9.8.6", "eth8", second, "sub"))
        cable = f"ip link add eth9 type veth peer name eth8 && ip link set eth8 netns {other}"
        inside(one, lambda: subprocess.run(cable, shell=True, check=True))
        for path, address, device, *_ in ends:
            setup = f"ip link set lo up && ip addr add {address}/24 dev {device} && ip link set {device} up"
            inside(path, lambda command=setup: subprocess.run(command, shell=True, check=True))  # type: ignore[misc]
        peers = [started(stack, path, role, *discovery) for path, _, _, discovery, role in ends]
        peers[0].publish([message(1)])
        wait_for(lambda: peers[1].received == [message(1)], "the message across the cable")


@needs_namespaces
@pytest.mark.parametrize("ranges", [("SUBNET", "LOCALHOST"), ("LOCALHOST", "SUBNET")])
def test_nodes_of_one_machine_find_each_other_whatever_their_range(ranges: tuple[str, str]) -> None:
    """In a network namespace with a further interface, which the node on SUBNET uses."""
    with ExitStack() as stack:
        machine = stack.enter_context(Namespace()).path
        inside(machine, lambda: subprocess.run(INTERFACES, shell=True, check=True))
        peers = [started(stack, machine, role, chosen) for role, chosen in zip(("pub", "sub"), ranges, strict=True)]
        peers[0].publish([message(1)])
        wait_for(lambda: peers[1].received == [message(1)], "the message from one interface to the other")


def announcements(stack: ExitStack, domain_id: int) -> socket.socket:
    """What the participants of a domain on the loopback interface send to everybody."""
    multicast = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    multicast.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    multicast.bind(("239.255.0.1", 7400 + 250 * domain_id))
    membership = socket.inet_aton("239.255.0.1") + socket.inet_aton("127.0.0.1")
    multicast.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    return multicast


def test_a_participant_on_loopback_announces_itself_often(join: Callable[..., DdsMiddleware]) -> None:
    """Nodes on another interface find it only then. Beside it, one with Cyclone DDS's own interval, which is 8 s."""
    general = '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>'
    with ExitStack() as stack:
        stack.callback(
            cdr_dds.delete, cdr_dds.create_domain(domain(1), f"<CycloneDDS><Domain>{general}</Domain></CycloneDDS>")
        )
        ours, theirs = (announcements(stack, domain(number)) for number in (0, 1))
        names = {ours: join().own_guid[:12], theirs: cdr_dds.guid(cdr_dds.create_participant(domain(1), b""))[:12]}
        heard = {ours: 0, theirs: 0}
        while heard[ours] < 12:
            ready, _, _ = select.select([ours, theirs], [], [], PATIENCE_S)
            assert ready, "waited for an announcement"
            for one in ready:
                heard[one] += names[one] in one.recv(65536)[:20]
        assert 0 < heard[theirs] <= heard[ours] / 4


def test_ros_domain_id_is_honoured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain(3)))
    with DdsMiddleware() as middleware:
        assert middleware.domain_id == domain(3)


@pytest.mark.parametrize(
    ("settings", "environment"),
    [
        ({"domain_id": 233}, {}),
        ({"domain_id": -2}, {}),
        ({}, {"ROS_DOMAIN_ID": "robot"}),
        ({}, {"ROS_DOMAIN_ID": "300"}),
        ({"domain_id": 5}, {"ROS_LOCALHOST_ONLY": "yes"}),
        ({"domain_id": 5, "localhost_only": False}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "near"}),
        ({"domain_id": 5, "node_name": "a node"}, {}),
        ({"domain_id": 5, "namespace": "/1"}, {}),
    ],
)
def test_bad_settings_are_errors(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, object], environment: dict[str, str]
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError):
        DdsMiddleware(**settings)  # type: ignore[arg-type]


def test_a_thousand_opened_and_closed_endpoints_leave_nothing_behind(join: Callable[..., DdsMiddleware]) -> None:
    here, there = join(), join()
    for _ in range(250):
        subscription = here.subscribe("/a", STRING, ADAPT, lambda _: None)
        publisher = there.advertise("/a", STRING, LATCHED)
        publisher.publish(message(1))
        subscription.close()
        publisher.close()
    wait_for(lambda: there.discover() == [] and here.discover() == [], "an empty graph")
    assert here.counters == {} and there.counters == {}


def test_participants_open_and_close_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    for _ in range(10):
        with DdsMiddleware(domain_id=domain()) as here, DdsMiddleware(domain_id=domain()) as there:
            received: list[bytes] = []
            here.subscribe("/a", STRING, LATCHED, received.append)
            there.advertise("/a", STRING, LATCHED).publish(message(1))
            wait_for(received.__len__, "the message")
            assert received == [message(1)]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("dds-")]


LAST_DOMAIN = """
import sys
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from tests.waiting import wait_for
with DdsMiddleware(domain_id=232, node_name=sys.argv[1], localhost_only=sys.argv[2] == "localhost") as one:
    publisher = one.advertise(f"/{sys.argv[1]}", "std_msgs/msg/String", Qos())
    other = {"first": "/second", "second": "/first"}[sys.argv[1]]
    wait_for(lambda: other in {info.topic for info in one.discover()}, "the other")
    print("found", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("where", ["localhost", "subnet"])
def test_in_the_last_domain_all_is_found_and_one_line_says_how_many_fit(where: str) -> None:
    """Port 65536, which DDS would ask for the 64th participant, does not exist."""
    command = [sys.executable, "-c", LAST_DOMAIN]
    pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with (
        subprocess.Popen([*command, "first", where], text=True, cwd=ROOT, **pipes) as first,
        subprocess.Popen([*command, "second", where], text=True, cwd=ROOT, **pipes) as second,
    ):
        for process in (first, second):
            assert process.stdout is not None
            assert process.stdout.readline() == "found\n"
        for process in (first, second):
            (line,) = process.communicate()[1].splitlines()
            assert re.match("domain 232: its ports end after 63 participants of a machine, .*; set ROS_DOMAIN_ID", line)
