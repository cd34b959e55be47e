from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from itertools import pairwise

import pytest

from gr_ros2_lab.race.channel import RaceChannel
from gr_ros2_lab.race.contenders import MTU, address_of
from gr_ros2_lab.race.links import RaceRadio
from gr_ros2_lab.race.namespaces import Namespace, inside
from gr_ros2_lab.race.tun import INTERFACE, QUEUE_BYTES
from tests.lab.race.support import needs_namespaces
from tests.waiting import PATIENCE_S, wait_for

pytestmark = needs_namespaces

HEADERS = 28
"""Bytes of IP and UDP."""
GROUP, PORT = "239.1.2.3", 5000
RADIO = RaceRadio(2e5, 0.0, 0)
ROBOTS = 3


def udp(namespace: Namespace, number: int) -> socket.socket:
    def opened() -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind(("", PORT))
        own = socket.inet_aton(address_of(number))
        made.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(GROUP) + own)
        made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, own)
        made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 0)
        made.settimeout(PATIENCE_S)
        return made

    return inside(namespace.path, opened)


@pytest.fixture
def joined(request: pytest.FixtureRequest) -> Iterator[tuple[RaceChannel, list[socket.socket]]]:
    radio = getattr(request, "param", RADIO)
    with ExitStack() as stack:
        spaces = [stack.enter_context(Namespace()) for _ in range(ROBOTS)]
        air = stack.enter_context(RaceChannel(radio, [space.path for space in spaces]))
        yield air, [stack.enter_context(udp(space, number)) for number, space in enumerate(spaces)]


def test_what_is_for_all_takes_the_air_once_and_what_is_for_each_once_for_each(
    joined: tuple[RaceChannel, list[socket.socket]],
) -> None:
    air, (one, *others) = joined
    one.sendto(b"to all", (GROUP, PORT))
    assert [other.recv(MTU) for other in others] == [b"to all"] * 2
    for number in (1, 2):
        one.sendto(b"to one", (address_of(number), PORT))
    assert [other.recv(MTU) for other in others] == [b"to one"] * 2
    report = air.report()
    assert list(report.forward.size) == [6 + HEADERS] * 3
    assert list(report.forward.airtime) == [RADIO.airtime_s(6 + HEADERS)] * 3
    assert report.drops == {"on_air": 0}


def test_robots_are_served_in_turn_one_after_the_other_from_bounded_queues(
    joined: tuple[RaceChannel, list[socket.socket]],
) -> None:
    air, (one, two, three) = joined
    size, sent = 700, 20
    for number in range(sent):
        for robot in (one, two):
            robot.sendto(number.to_bytes(size, "big"), (address_of(2), PORT))
    wait_for(lambda: len(air.report().forward.t) + air.report().drops.get("queue_full", 0) == 2 * sent, "more to come")
    report = air.report()
    senders = [three.recvfrom(MTU)[1][0] for _ in report.forward.t]
    assert QUEUE_BYTES // (size + HEADERS) * 2 <= len(senders) < 2 * sent
    assert all(before != after for before, after in pairwise(senders[2:9]))
    gaps = [after - before for before, after in pairwise(report.forward.t)]
    assert min(gaps) >= RADIO.airtime_s(size + HEADERS) * 0.999


@pytest.mark.parametrize("joined", [RaceRadio(1e8, 0.5, 1)], indirect=True)
def test_each_receiver_loses_by_itself(joined: tuple[RaceChannel, list[socket.socket]]) -> None:
    air, (one, *others) = joined
    sent = 100
    for number in range(sent):
        one.sendto(bytes([number]), (GROUP, PORT))
        wait_for(lambda most=number: len(air.report().forward.t) > most, "not sent")  # type: ignore[misc]
    got: list[set[bytes]] = [set() for _ in others]

    def all_told() -> bool:
        """Whether each packet has come to each receiver or is lost; the last one may be on its way."""
        for other, packets in zip(others, got, strict=True):
            other.setblocking(False)
            with suppress(BlockingIOError):
                while True:
                    packets.add(other.recv(MTU))
        return sum(map(len, got)) + air.report().drops["on_air"] == 2 * sent

    wait_for(all_told, "every packet at every receiver")
    assert got[0] != got[1]
    assert all(0.2 * sent < len(each) < 0.8 * sent for each in got)


def test_nothing_is_left_in_a_namespace_when_the_channel_is_closed() -> None:
    def names() -> list[str]:
        return [name for _, name in socket.if_nameindex()]

    with Namespace() as one, Namespace() as other:
        with RaceChannel(RADIO, [one.path, other.path]):
            assert INTERFACE in inside(one.path, names)
        assert [inside(space.path, names) for space in (one, other)] == [["lo"], ["lo"]]
