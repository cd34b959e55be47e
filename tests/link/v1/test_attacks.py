"""An attacker who has recorded everything and can send anything: nothing of it is delivered, nothing is confirmed, and
the link goes on when the attack is over."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from gr_ros2.link.events import Delivered, Rejected
from gr_ros2.link.v1.sealing import SOURCE_ROW, Keys, Seal, SealMode
from gr_ros2.wire.control import Report
from gr_ros2.wire.v1 import Header, Part, Standing, body_room, write_body, write_header, write_standing
from tests.link.v1.air import KEY, Air, Robot, registry

SEALED: list[SealMode] = ["authenticate", "encrypt"]
OTHER = bytes(32)


def pair(mode: SealMode = "encrypt", **settings: object) -> tuple[Robot, Robot, Air]:
    one, two = Robot(1, registry(), mode=mode, **settings), Robot(2, registry(), mode=mode, **settings)
    air = Air(one, two, loss=0.1)
    talk(one, air, 0, 30)
    return one, two, air


def talk(one: Robot, air: Air, first: int, count: int) -> None:
    for number in range(first, first + count):
        one.end.submit(0, b"genuine %d" % number, air.now)
        air.run(0.03)
    air.run(1.0)


def attack(victim: Robot, packets: list[bytes], now: float) -> None:
    """None of it is delivered, and nothing of what arrives changes what was."""
    assert packets
    before = len(victim.delivered())
    for data in packets:
        victim.receive(data, now)
    victim.events += victim.end.handle_timeout(now)
    assert len(victim.delivered()) == before


def of(air: Air, robot: Robot) -> list[bytes]:
    return [data for who, data in air.recorded if who is robot]


def check_alive(one: Robot, two: Robot, air: Air, seconds: float = 2.0) -> None:
    """Something new crosses soon. What was sent just before a receiver restarted may not: it could be a replay."""
    two.events.clear()
    for number in range(int(seconds * 10)):
        one.end.submit(0, b"after it %d" % number, air.now)
        air.run(0.1, lambda: bool(two.delivered()))
        if two.delivered():
            return
    raise AssertionError("nothing crosses any more")


@pytest.mark.parametrize("mode", SEALED)
def test_forged_flipped_cut_and_spliced_packets(mode: SealMode) -> None:
    one, two, air = pair(mode)
    rng = random.Random(1)
    recorded = of(air, one)

    def bad() -> Iterator[bytes]:
        for data in recorded:
            other = rng.choice(recorded)
            flipped = bytearray(data)
            flipped[rng.randrange(64)] ^= 1 << rng.randrange(8)
            cut = rng.randrange(1, 64)
            yield bytes(flipped)
            yield data[:cut]
            yield data[:cut] + other[cut:] if data[:cut] != other[:cut] and data[cut:] != other[cut:] else b""
            yield data[:2] + rng.randbytes(62)
            yield rng.randbytes(64)

    attack(two, list(bad()), air.now)
    assert two.end.received.rejected["tag"] > 0
    check_alive(one, two, air)


@pytest.mark.parametrize("mode", SEALED)
@pytest.mark.parametrize("restarts", ["none", "sender", "receiver", "both", "receiver, long after"])
def test_replays_at_once_and_after_restarts(mode: SealMode, restarts: str) -> None:
    one, two, air = pair(mode)
    recorded = of(air, one)
    if "receiver" in restarts or restarts == "both":
        two.start()
    if restarts in ("sender", "both"):
        one.start()
    if "long" in restarts:
        air.run(15.0)
    attack(two, recorded, air.now)
    two.slot(air.now)
    attack(two, recorded[::-1], air.now)
    check_alive(one, two, air)
    attack(two, recorded, air.now)
    check_alive(one, two, air)


def test_replays_after_the_window_and_a_clock_set_back() -> None:
    one, two, air = pair()
    recorded = of(air, one)
    one.start()
    check_alive(one, two, air)
    attack(two, recorded, air.now)
    assert two.end.received.rejected["replayed"] > 0
    # A robot whose state file is lost and whose clock was set back is refused, and the reason has a name.
    one.start(boot=5)
    two.end.received.rejected.clear()
    talk(one, air, 100, 5)
    assert b"genuine 104" not in two.delivered()
    assert two.end.received.rejected["replayed"] > 0


def test_a_retired_key_and_no_key() -> None:
    one, two, air = pair()
    foreign = Robot(1, registry())
    foreign.keys = Keys((OTHER,), "encrypt")
    foreign.boot = one.boot + 100
    foreign.start()
    foreign.end.submit(0, b"foreign", 0.0)
    attack(two, [data for n in range(20) if (data := foreign.slot(n / 75)) is not None], air.now)
    assert two.end.received.rejected["wrong_key"] > 0
    open_one = Robot(1, registry())
    open_one.boot = one.boot + 100
    open_one.start()
    attack(two, [data for n in range(20) if (data := open_one.slot(n / 75)) is not None], air.now)
    assert two.end.received.rejected["not_sealed"] > 0
    reader = Robot(3)
    reader.receive(of(air, one)[0], 0.0)
    assert reader.end.received.rejected["no_key"] == 1
    assert isinstance(reader.events[-1], Rejected)
    check_alive(one, two, air)


def test_keys_are_changed_without_stopping() -> None:
    one, two, air = pair()
    for robot, keys in (
        (two, (KEY, OTHER)),
        (one, (OTHER, KEY)),
        (two, (OTHER, KEY)),
        (one, (OTHER,)),
        (two, (OTHER,)),
    ):
        robot.keys = Keys(keys, "encrypt")
        robot.start()
        check_alive(one, two, air)


def test_another_robots_packet_under_this_robots_id() -> None:
    one, two, air = pair()
    three = Robot(3, registry(), mode="encrypt")
    three.end.submit(0, b"of three", 0.0)
    packets = [data for n in range(20) if (data := three.slot(n / 75)) is not None]
    attack(two, [data[:1] + b"\1" + data[2:] for data in packets], air.now)
    attack(two, [data[:1] + b"\2" + data[2:] for data in packets], air.now)
    check_alive(one, two, air)


def test_nothing_is_confirmed_that_never_arrived() -> None:
    one, two, air = pair()
    air.lost = lambda sender, _: sender is one
    one.end.submit(0, b"not heard", air.now)
    air.run(0.2)
    newest = one.end.window.newest
    forged = Report(1, one.boot & 0xFFFF, newest & 0xFFFF, (1 << 64) - 1, True, 0)
    clear = write_header(Header(3, True, 2, two.end.window.newest & 0xFFFF)) + write_standing(Standing(100))
    body = write_body([forged], body_room(64, sealed=True)).ljust(64 - 14, b"\0")
    for trailer in (Seal(OTHER, 2, two.boot, encrypt=True), Seal(KEY, 1, one.boot, encrypt=True)):
        one.receive(trailer.close(clear, body, two.end.window.newest, 100), air.now)
    recorded = of(air, two)
    one_before = one.end.window.unconfirmed(air.now)
    for data in recorded:
        one.receive(data, air.now)
    assert one_before
    assert one.end.window.unconfirmed(air.now)
    air.lost = lambda *_: False
    air.run(1.0)
    assert b"not heard" in two.delivered()


def test_a_report_of_an_earlier_start_confirms_nothing() -> None:
    one, two, air = pair("none")
    recorded = of(air, two)
    one.start()
    air.lost = lambda *_: True
    one.end.submit(0, b"new", air.now)
    air.run(0.06)
    for data in recorded:
        one.receive(data, air.now)
    assert one.end.window.unconfirmed(air.now)


def test_no_link_is_silenced_for_longer_than_the_attack_lasts() -> None:
    one, two, air = pair()
    recorded = of(air, one) + of(air, two)
    rng = random.Random(4)
    for number in range(100):
        for _ in range(20):
            data = bytearray(rng.choice(recorded))
            if rng.random() < 0.7:
                data[rng.randrange(64)] ^= 1 << rng.randrange(8)
            two.receive(bytes(data), air.now)
            one.receive(bytes(data), air.now)
        one.end.submit(0, b"meanwhile %d" % number, air.now)
        air.run(0.04)
    air.run(1.0)
    here = [payload for payload in two.delivered() if payload.startswith(b"meanwhile")]
    assert here == [b"meanwhile %d" % number for number in range(100)]


def test_no_pair_of_key_and_nonce_comes_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over restarts, wrapping numbers, rows used up and a change of keys; the same packet sent again is the same."""
    seen: dict[tuple[bytes, int, int, int, bool], bytes] = {}
    close = Seal.close
    boots = {}

    def watched(self: Seal, clear: bytes, body: bytes, number: int, row: int, *, plain: bool = False) -> bytes:
        data = close(self, clear, body, number, row, plain=plain)
        name = (*boots[id(self)], number, row)
        assert seen.setdefault(name, data) == data  # type: ignore[arg-type]
        return data

    init = Seal.__init__

    def noted(self: Seal, key: bytes, src_id: int, boot: int, *, encrypt: bool) -> None:
        init(self, key, src_id, boot, encrypt=encrypt)
        boots[id(self)] = (key, src_id, boot)
        kept.append(self)

    kept: list[Seal] = []
    monkeypatch.setattr(Seal, "__init__", noted)
    monkeypatch.setattr(Seal, "close", watched)
    rng = random.Random(2)
    one = Robot(1, registry(), mode="encrypt")
    now = 0.0
    for part in range(4):
        if part:
            one.keys = Keys((KEY, OTHER) if part % 2 else (OTHER, KEY), "encrypt")
            one.start()
        for _ in range(70_000 if part == 0 else 3000):
            now += SLOT
            if part == 0 or rng.random() < 0.05:
                one.end.submit(rng.randrange(3), rng.randbytes(30), now)
            one.slot(now)
    assert len(seen) > 70_000
    assert {row for *_, row in seen} >= {SOURCE_ROW, *range(128)}


SLOT = 0.001


def test_a_message_of_the_attackers_own_is_not_taken_in_the_clear() -> None:
    one, two, air = pair()
    body = write_body([Part(0, b"mine")], body_room(64))
    clear = write_header(Header(0, False, 1, one.end.window.newest + 1 & 0xFFFF))
    packet = Keys().own(1, one.boot).close(clear, body, one.end.window.newest + 1, SOURCE_ROW)
    assert not any(isinstance(event, Delivered) for event in two.receive(packet, air.now))
    assert two.end.received.rejected["not_sealed"] == 1
