"""Who only looks on reads what two robots said: all of it with the key, what is in the clear without one."""

from __future__ import annotations

import pytest

from fuzz.loop import inputs
from gr_ros2.core.errors import WireError
from gr_ros2.link.reader import Dissection, Reader
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.wire.control import Hello, Report
from gr_ros2.wire.v1 import Header, PacketV1, Part, encode
from tests.link.v1.air import KEY, Air, Robot, registry

MODES: list[SealMode] = ["none", "authenticate", "encrypt"]


def talk(mode: SealMode, *, restart: bool = False) -> list[bytes]:
    """What is in the air between two robots, one of which starts again."""
    one, two = Robot(1, registry(), mode=mode, hears=True), Robot(2, mode=mode)
    air = Air(one, two, loss=0.2, seed=4)
    for number in range(30):
        if restart and number == 15:
            one.start()
        one.end.messages.submit(number % 3, b"%03d " % number * (40 if number % 3 == 2 else 5), air.now)
        air.run(0.06)
    air.run(0.5)
    return list(dict.fromkeys(data for _, data in air.recorded))  # what is sent again is the same


def read(packets: list[bytes], keys: tuple[bytes, ...] = ()) -> tuple[Reader, list[Dissection]]:
    reader = Reader(64, keys)
    for data in packets:
        reader.learn(data)
    return reader, [reader.read(data) for data in packets]


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize("mode", MODES)
def test_every_packet_is_checked_and_every_message_seen(mode: SealMode, restart: bool) -> None:
    reader, looks = read(talk(mode, restart=restart), (KEY,) if mode != "none" else ())
    assert {look.check for look in looks} == {"CRC ok" if mode == "none" else "tag ok"}
    assert not any(look.hidden for look in looks)
    parts = [part for look in looks for index in range(len(look.entries)) if (part := look.message(index))]
    assert b"".join(part.payload for part in parts if part.topic_id == 2) == b"".join(
        b"%03d " % number * 40 for number in range(2, 30, 3)
    )
    assert {row.name for look in looks for row in look.announced} == {"odom", "scan", "map"}
    assert {topic_id: row.name for topic_id, row in reader.topics[1].items()} == {0: "odom", 1: "scan", 2: "map"}
    kinds = {type(entry) for look in looks for entry in look.entries}
    assert {Hello, Report} <= kinds
    assert any(look.combined for look in looks)
    assert all(look.combined for look in looks if look.repair is not None and look.repair.mask)


def test_without_the_key_the_clear_part_is_shown() -> None:
    _, looks = read(talk("authenticate"))
    assert {look.check for look in looks} == {"tag not checked: no key"}
    assert not any(look.hidden for look in looks)
    _, looks = read(talk("encrypt"))
    assert all(bool(look.hidden) != (look.repair is not None and look.repair.clear) for look in looks)
    assert {type(entry) for look in looks for entry in look.entries} >= {Hello}
    numbers = [look.number for look in looks if look.header.src_id == 1 and look.repair is None]
    assert numbers == sorted(set(numbers))


def test_another_key_and_a_packet_without_a_hello() -> None:
    packets = talk("encrypt")
    reader = Reader(64, (bytes(32),))
    for data in packets:
        reader.learn(data)
    hello, message = packets[0], next(data for data in packets if data[0] & 3 != 3 and data[1] == 1)
    with pytest.raises(WireError, match="none of these keys") as refused:
        reader.read(hello)
    assert refused.value.kind == "wrong_key"
    assert reader.read(message).check == "not opened: no hello of robot 1 among these packets"
    plain = next(data for data in talk("none") if data[0] & 3 != 3 and data[1] == 1)
    look = Reader(64).read(plain)
    assert look.check == "CRC not checked: no hello of robot 1 among these packets"
    assert look.entries


@pytest.mark.parametrize("mode", MODES)
def test_damage_is_named(mode: SealMode) -> None:
    packets = talk(mode)
    reader, _ = read(packets, (KEY,) if mode != "none" else ())
    damaged = 0
    for data in packets:
        with pytest.raises(WireError) as refused:
            reader.read(data[:-1] + bytes((data[-1] ^ 1,)))
        damaged += refused.value.kind in ("crc", "tag", "wrong_key")
    assert damaged == len(packets)


def test_any_bytes_are_read_or_refused_by_name() -> None:
    packets = talk("none")
    reader, _ = read(packets)
    refused = taken = 0
    for data, _ in zip(inputs(packets, 9), range(5_000), strict=False):
        reader.learn(data)
        for one in (reader, Reader(64)):
            try:
                taken += one.read(data).header.src_id >= 0
            except WireError:
                refused += 1
    assert taken > len(packets)
    assert refused > 3_000


def test_forged_hellos_do_not_pile_up() -> None:
    """Without a key, anybody can announce starts without end."""
    reader = Reader(64)
    for boot in range(1, 1001):
        forger = Robot(1)
        forger.start(boot)
        reader.learn(forger.slot(0.0) or b"")
    packets = talk("none")
    for data in packets:
        reader.learn(data)
    assert sum(reader.read(data).check == "CRC ok" for data in packets) == len(packets)
    assert len(reader._starts[1]) <= 256


def test_a_hello_behind_a_message_tells_how_the_packets_of_its_start_are_read() -> None:
    """Where turns are rare, a robot without a key sends no other."""
    hello = Hello(7 << 32, 0, 1, 0)
    packets = [
        encode(PacketV1(Header(0, False, 1, number), (Part(0, b"odom"), *also)), 64, hello.boot)
        for number, also in ((1, ()), (2, (hello,)))
    ]
    _, looks = read(packets)
    assert [look.check for look in looks] == ["CRC ok"] * 2
    damaged = bytearray(packets[1])
    damaged[10] ^= 1
    assert read([bytes(damaged), packets[0]])[1][1].check.startswith("CRC not checked")
