from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from gr_ros2_lab.race.contenders import ADDRESSES, MTU
from gr_ros2_lab.race.links import RaceIpLink, RaceRadio
from gr_ros2_lab.race.namespaces import Namespace, inside
from gr_ros2_lab.race.tun import INTERFACE, QUEUE_BYTES
from tests.lab.race.support import needs_namespaces
from tests.waiting import PATIENCE_S, wait_for

pytestmark = needs_namespaces

HEADERS = 28
"""Bytes of IP and UDP."""
PORT = 5000
RADIO = RaceRadio(2e5, 0.0, 0)


def udp(namespace: Namespace, address: str) -> socket.socket:
    def opened() -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind((address, PORT))
        made.settimeout(PATIENCE_S)
        return made

    return inside(namespace.path, opened)


@pytest.fixture
def linked() -> Iterator[tuple[RaceIpLink, socket.socket, socket.socket]]:
    with ExitStack() as stack:
        spaces = [stack.enter_context(Namespace()) for _ in ADDRESSES]
        air = stack.enter_context(RaceIpLink(RADIO, (spaces[0].path, spaces[1].path)))
        ends = [stack.enter_context(udp(*pair)) for pair in zip(spaces, ADDRESSES, strict=True)]
        yield air, ends[0], ends[1]


def test_datagrams_cross_both_ways_and_every_byte_is_counted(
    linked: tuple[RaceIpLink, socket.socket, socket.socket],
) -> None:
    air, near, far = linked
    arrived, began = [], time.monotonic()
    for size in (1, 700, MTU - HEADERS):
        near.sendto(bytes(size), (ADDRESSES[1], PORT))
        assert far.recv(MTU) == bytes(size)
        arrived.append(time.monotonic())
    far.sendto(b"back", (ADDRESSES[0], PORT))
    assert near.recv(MTU) == b"back"
    report = air.report()
    assert list(report.forward.size) == [29, 728, MTU]
    assert list(report.forward.airtime) == [RADIO.airtime_s(size) for size in (29, 728, MTU)]
    over = [began, *report.forward.t]  # the air is free for the next frame then, although a thread may deliver it later
    gaps = zip(over[:-1], over[1:], report.forward.airtime, strict=True)
    assert all(after - before >= air * 0.999 for before, after, air in gaps)
    assert all(at >= end for at, end in zip(arrived, over[1:], strict=True))
    assert list(report.reverse.size) == [32]
    assert report.drops == {"queue_full": 0, "on_air": 0, "not_taken": 0}


def test_what_the_air_cannot_take_waits_in_a_bounded_queue_and_is_counted_beyond_it(
    linked: tuple[RaceIpLink, socket.socket, socket.socket],
) -> None:
    air, near, far = linked
    size, sent = 700, 40
    for number in range(sent):
        near.sendto(number.to_bytes(size, "big"), (ADDRESSES[1], PORT))
    wait_for(lambda: len(air.report().forward.t) + air.report().drops["queue_full"] == sent, "not all is accounted for")
    report = air.report()
    arrived = [int.from_bytes(far.recv(MTU), "big") for _ in report.forward.t]
    assert arrived == sorted(arrived)
    assert arrived[0] == 0
    assert QUEUE_BYTES // (size + HEADERS) <= len(arrived) < sent / 2
    gaps = [after - before for before, after in zip(report.forward.t, list(report.forward.t)[1:], strict=False)]
    assert min(gaps) >= RADIO.airtime_s(size + HEADERS) * 0.999


def test_nothing_is_left_in_a_namespace_when_the_air_is_closed() -> None:
    def names() -> list[str]:
        return [name for _, name in socket.if_nameindex()]

    with Namespace() as one, Namespace() as other:
        with RaceIpLink(RADIO, (one.path, other.path)):
            assert INTERFACE in inside(one.path, names)
        assert [inside(space.path, names) for space in (one, other)] == [["lo"], ["lo"]]
    assert INTERFACE not in names()
