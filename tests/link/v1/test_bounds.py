"""Work and memory per packet are bounded, whatever its numbers say."""

from __future__ import annotations

import tracemalloc

import pytest

from fuzz.loop import work
from gr_ros2.core.errors import ReplayedError
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Rejected
from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, SealMode
from gr_ros2.wire import v1
from gr_ros2.wire.control import CAN_HEAR, Hello
from gr_ros2.wire.mac_block import Block, write_block
from gr_ros2.wire.v1 import (
    BROADCAST,
    QOS_REPAIR,
    EntryV1,
    Header,
    PacketV1,
    Part,
    RepairHeader,
    encode,
)
from tests.link.v1.air import Air, Robot, keys, registry

MOST_LINES = 5_000


def hello(boot: int, number: int) -> bytes:
    packet = PacketV1(
        Header(3, False, 1, number & 0xFFFF), (Hello(boot, number >> 16, 1, 0),), RepairHeader(9, clear=True)
    )
    return v1.encode(packet, 64, boot, number >> 16)


def test_a_forged_hello_does_not_hang_a_robot_without_a_key() -> None:
    one, two = Robot(1, registry()), Robot(2, registry())
    air = Air(one, two)
    air.run(1.0)
    lines, events = work(lambda: two.end.receive(AirPacket(hello(one.boot, 0xFFFF_FFFF << 16)), air.now))
    assert lines < MOST_LINES
    assert isinstance(events[-1], Rejected)
    assert isinstance(events[-1].error, ReplayedError)
    one.end.messages.submit(0, b"still here", air.now)
    air.run(1.0)
    assert two.delivered() == [b"still here"]
    # A robot of which nothing was heard for long may have sent many packets meanwhile.
    air.robots = [two]
    air.run(12.0)
    for number in (5_000_000, (1 << 48) - 1):
        lines, _ = work(lambda number=number: two.end.receive(AirPacket(hello(one.boot, number)), air.now))
        assert lines < MOST_LINES
        air.run(12.0)


def test_a_sealed_robot_that_comes_back_after_millions_of_packets() -> None:
    one, two = Robot(1, registry(), mode="encrypt"), Robot(2, registry(), mode="encrypt")
    air = Air(one, two)
    air.run(1.0)
    one.end.window.packets.newest = 5_000_000  # as if it had sent them out of range
    most = 0
    receive = two.receive

    def counted(data: bytes, now: float) -> list[object]:
        nonlocal most
        lines, events = work(lambda: receive(data, now))
        most = max(most, lines)
        return events  # type: ignore[return-value]

    two.receive = counted  # type: ignore[method-assign, assignment]
    one.end.messages.submit(0, b"back", air.now)
    air.run(3.0)
    one.end.messages.submit(0, b"back again", air.now)
    air.run(3.0)
    assert b"back again" in two.delivered()
    assert most < MOST_LINES


def test_jumps_of_short_packets_cost_no_more_than_others() -> None:
    end = EndpointV1(None, Settings(2, 64, any_length=True), boot=1)
    end.receive(AirPacket(hello(7, 0)), 0.0)
    trailer = keys("none").own(1, 7)
    for step in range(1, 200):
        number = step * 32_000
        data = trailer.close(v1.write_header(Header(0, False, 1, number & 0xFFFF)), b"", number, NOT_A_REPAIR)
        lines, _ = work(
            lambda data=data, step=step: (end.receive(AirPacket(data), step * 0.1), end.handle_timeout(step * 0.1))
        )
        assert len(data) == 8
        assert lines < MOST_LINES


def test_a_chain_of_repairs_is_bounded() -> None:
    room = 50
    decoder = RepairDecoder(room, lambda _: True, 30_000)
    for number in range(1, 20_000):
        decoder.repair(number, 3, 5, bytes(room))
    assert decoder.equations <= 4096
    lines, found = work(lambda: decoder.source(0, bytes(room)))  # what 4096 packets have prepared
    assert 4000 < len(found) <= 4097
    assert lines < 2_000_000


@pytest.mark.parametrize("packet_len", [220, 4095])
def test_memory_is_counted_as_it_is_used(packet_len: int) -> None:
    """First fragments of one byte, one to a packet: what they cost is bookkeeping."""
    most = 1_000_000
    end = EndpointV1(None, Settings(2, packet_len, max_source_bytes=most), boot=1)
    end.receive(AirPacket(hello(7, 0)), 0.0)
    trailer = keys("none").own(1, 7)
    room = v1.body_room(packet_len)

    def packet(number: int) -> bytes:
        body = v1.write_body([Part(number % 240, b"x", 0, 0, False)], room).ljust(packet_len - 8, b"\0")
        return trailer.close(v1.write_header(Header(0, False, 1, number)), body, number, NOT_A_REPAIR)

    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for number in range(1, 4_001):
        end.receive(AirPacket(packet(number)), number * 1e-3)
    used = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert used < most


def test_all_that_is_kept_of_one_robot_shares_its_memory() -> None:
    """Packets, incomplete messages, and messages that wait for a packet that never comes, together."""
    most, packet_len = 1_000_000, 1000
    one, two = Robot(1, registry(), packet_len=packet_len), Robot(2, packet_len=packet_len, max_source_bytes=most)
    air = Air(one, two)
    air.run(2.0)
    trailer, room = keys("none").own(1, one.boot), v1.body_room(packet_len)
    whole, begun = Part(2, b"reliable" * 8, 0, 0, True), [Part(n, b"odom", 0, 0, False) for n in (0, 1)]

    def packet(number: int) -> bytes:
        body = v1.write_body([*begun, *[whole] * 11], room).ljust(packet_len - 8, b"\0")
        return trailer.close(v1.write_header(Header(0, False, 1, number)), body, number, NOT_A_REPAIR)

    after_a_gap = one.end.window.packets.newest + 2
    packets = [packet(number) for number in range(after_a_gap, after_a_gap + 1000)]
    tracemalloc.start()
    before, used = tracemalloc.get_traced_memory()[0], 0
    for number, data in enumerate(packets):
        two.end.receive(AirPacket(data), air.now + number * 1e-3)
        used = max(used, tracemalloc.get_traced_memory()[0] - before)
    tracemalloc.stop()
    assert 0.5 * most < used < most


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_a_report_costs_no_more_the_more_was_sent(mode: SealMode) -> None:
    one, two = Robot(1, registry(), mode=mode), Robot(2, registry(), mode=mode)
    air = Air(one, two)
    air.run(1.0)
    window = one.end.window
    for number in range(window.packets.newest + 1, 20_000):
        window.sent(number, b"", (), 1.0)
    lines = [work(lambda: window.peers.report(2, 19_990, 0, settled=True, loss=0.1, now=air.now))[0] for _ in range(2)]
    assert lines[1] < MOST_LINES


def forged(
    boot: int, number: int, *entries: EntryV1, to: int = BROADCAST, block: bytes = b"", **repair: int | bool
) -> bytes:
    """A packet of robot 1, as anybody can make it where no key is set."""
    header = Header(QOS_REPAIR if repair else 0, False, 1, number, to, int(to != BROADCAST), block)
    fields = RepairHeader(**repair) if repair else None  # type: ignore[arg-type]
    combined = b"\xff" * (64 - v1.CRC_LEN - header.size - v1.REPAIR_HEADER_LEN) if repair.get("mask") else b""
    return encode(PacketV1(header, entries, fields, combined), 64, boot)


@pytest.mark.parametrize("shares", [False, True])
def test_a_combination_that_is_longer_than_bodies_are_is_refused(shares: bool) -> None:
    """After a hello for one robot, bodies have two bytes less; with a short block, a packet has room for more."""
    two = Robot(2, registry())
    block = write_block(Block(1, (2, 3))) if shares else b""
    to = BROADCAST if shares else 2
    two.receive(forged(5, 0, Hello(5, 0, CAN_HEAR, 0), to=to, block=block, repair_id=0, clear=True), 0.0)
    two.receive(forged(5, 3, block=block, repair_id=1, mask=3), 0.1)
    assert two.end.received.rejected["pad"] == 1
    two.receive(forged(5, 4, Part(0, b"a message"), to=to, block=block), 0.2)
    assert two.end.neighbours.all[1].inbox.newest == 4
