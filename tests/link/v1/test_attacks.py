"""An attacker who has recorded everything and can send anything: nothing of it is delivered, nothing is confirmed, and
the link goes on when the attack is over."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.tuning import Tuning
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered, Gone, Met, Rejected
from gr_ros2.link.fates import Fate
from gr_ros2.link.rate import Mcs
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys, Seal, SealMode, subkey
from gr_ros2.link.v1.writer import SendSlot
from gr_ros2.settings.config import SendOptions
from gr_ros2.wire.control import Ask, Report
from gr_ros2.wire.v1 import (
    QOS_REPAIR,
    Header,
    Part,
    RepairHeader,
    body_room,
    write_body,
    write_header,
    write_repair_header,
)
from tests.link.v1.air import KEY, Air, Robot, registry

TUNING = Tuning()

SEALED: list[SealMode] = ["authenticate", "encrypt"]
OTHER = bytes(32)


def pair(mode: SealMode = "encrypt", **settings: object) -> tuple[Robot, Robot, Air]:
    one, two = Robot(1, registry(), mode=mode, **settings), Robot(2, registry(), mode=mode, **settings)
    air = Air(one, two, loss=0.1)
    talk(one, air, 0, 30)
    return one, two, air


def talk(one: Robot, air: Air, first: int, count: int) -> None:
    for number in range(first, first + count):
        one.end.messages.submit(0, b"genuine %d" % number, air.now)
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
        one.end.messages.submit(0, b"after it %d" % number, air.now)
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
    # A robot whose state file is lost and whose clock was set back is taken once it proves that it is there now.
    recorded = of(air, one)
    one.start(boot=5)
    talk(one, air, 100, 60)
    assert b"genuine 159" in two.delivered()
    attack(two, recorded, air.now)
    check_alive(one, two, air)
    assert not set(two.delivered()) & {b"genuine %d" % number for number in range(30)}


def test_a_retired_key_and_no_key() -> None:
    one, two, air = pair()
    foreign = Robot(1, registry())
    foreign.keys = Keys((OTHER,), "encrypt")
    foreign.boot = one.boot + 100
    foreign.start()
    foreign.end.messages.submit(0, b"foreign", 0.0)
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
    three.end.messages.submit(0, b"of three", 0.0)
    packets = [data for n in range(20) if (data := three.slot(n / 75)) is not None]
    attack(two, [data[:1] + b"\1" + data[2:] for data in packets], air.now)
    attack(two, [data[:1] + b"\2" + data[2:] for data in packets], air.now)
    check_alive(one, two, air)


def test_nothing_is_confirmed_that_never_arrived() -> None:
    one, two, air = pair()
    air.lost = lambda sender, _: sender is one
    one.end.messages.submit(0, b"not heard", air.now)
    air.run(0.2)
    newest = one.end.window.packets.newest
    forged = Report(1, one.boot & 0xFFFF, newest & 0xFFFF, (1 << 64) - 1, True, 0)
    other = two.end.window.packets.newest
    clear = write_header(Header(3, True, 2, other & 0xFFFF)) + write_repair_header(RepairHeader(100))
    body = write_body([forged], body_room(64, sealed=True)).ljust(64 - 14, b"\0")
    for trailer in (Seal(OTHER, 2, two.boot, encrypt=True), Seal(KEY, 1, one.boot, encrypt=True)):
        one.receive(trailer.close(clear, body, other, 100), air.now)
    recorded = of(air, two)
    one_before = one.end.window.packets.unconfirmed(air.now)
    for data in recorded:
        one.receive(data, air.now)
    assert one_before
    assert one.end.window.packets.unconfirmed(air.now)
    air.lost = lambda *_: False
    air.run(1.0)
    assert b"not heard" in two.delivered()


def test_a_report_of_an_earlier_start_confirms_nothing() -> None:
    one, two, air = pair("none")
    recorded = of(air, two)
    one.start()
    air.lost = lambda *_: True
    one.end.messages.submit(0, b"new", air.now)
    air.run(0.06)
    for data in recorded:
        one.receive(data, air.now)
    assert one.end.window.packets.unconfirmed(air.now)


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
        one.end.messages.submit(0, b"meanwhile %d" % number, air.now)
        air.run(0.04)
    air.run(1.0)
    here = [payload for payload in two.delivered() if payload.startswith(b"meanwhile")]
    assert here == [b"meanwhile %d" % number for number in range(100)]


def test_forged_starts_silence_a_robot_for_half_of_the_time_at_most() -> None:
    """Without a key; hellos of a start that is no robot's, ten times a second."""
    one, two = Robot(1, registry()), Robot(2)
    air = Air(one, two)
    air.run(2.0)
    forger = Robot(1, registry())
    forger.start(boot=(1 << 64) - 1)
    for number in range(600):
        forged = forger.slot(air.now)
        if forged is not None:
            two.receive(forged, air.now)
        one.end.messages.submit(0, b"meanwhile %d" % number, air.now)
        air.run(0.1)
    here = [payload for payload in two.delivered() if payload.startswith(b"meanwhile")]
    assert len(here) >= 250
    assert len(set(here)) == len(here)


def test_no_pair_of_key_and_nonce_comes_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over restarts, wrapping numbers, repair ids used up, a change of keys; a packet sent again is the same."""
    seen: dict[tuple[bytes, int, int, int, bool], bytes] = {}
    close = Seal.close
    boots = {}

    def watched(self: Seal, clear: bytes, body: bytes, number: int, repair_id: int, *, plain: bool = False) -> bytes:
        data = close(self, clear, body, number, repair_id, plain=plain)
        name = (*boots[id(self)], number, repair_id)
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
        for slot in range(13_000 if part == 0 else 3000):
            if part == 0 and slot == 4_000:  # as if more had been sent since, until the numbers come round
                one.end.window.packets.newest = one.end.window.packets.oldest = 60_000
            now += SLOT
            if part == 0 or rng.random() < 0.05:
                one.end.messages.submit(rng.randrange(3), rng.randbytes(30), now)
            one.slot(now)
    assert len(seen) > 10_000
    assert max(number for _, _, _, number, _ in seen) > 1 << 16
    assert {repair_id for *_, repair_id in seen} >= {NOT_A_REPAIR, *range(128)}


SLOT = 0.001


def test_a_message_of_the_attackers_own_is_not_taken_in_the_clear() -> None:
    one, two, air = pair()
    body = write_body([Part(0, b"mine")], body_room(64))
    clear = write_header(Header(0, False, 1, one.end.window.packets.newest + 1 & 0xFFFF))
    packet = Keys().own(1, one.boot).close(clear, body, one.end.window.packets.newest + 1, NOT_A_REPAIR)
    assert not any(isinstance(event, Delivered) for event in two.receive(packet, air.now))
    assert two.end.received.rejected["not_sealed"] == 1


def test_what_a_receiver_never_heard_is_not_taken_as_fresh() -> None:
    """Robot 2 is off while robot 1 starts and is recorded; then robot 1 is off, and robot 2 back with intact state."""
    one, two, air = pair()
    one.start()
    air.robots = [one]
    for number in range(100):
        one.end.messages.submit(0, b"old %d" % number, air.now)
        air.run(0.03)
    recorded = of(air, one)[-300:]
    attack(two, recorded, air.now + 1.0)  # still on
    two.start()
    air.robots = [two]
    air.run(3.0)
    attack(two, recorded, air.now)
    attack(two, recorded[::-1], air.now)
    attack(two, recorded, air.now + 100.0)


def test_what_was_withheld_is_not_taken_by_a_receiver_that_has_restarted() -> None:
    one, two, air = pair()
    air.lost = lambda sender, _: sender is one
    withheld = len(air.recorded)
    talk(one, air, 100, 100)
    recorded = [data for who, data in air.recorded[withheld:] if who is one]
    two.start()
    air.robots = [two]
    air.run(3600.0, lambda: air.now > 100.0)
    attack(two, recorded, air.now + 3600.0)


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_a_start_of_both_at_once_loses_no_first_message(mode: SealMode) -> None:
    for loss in (0.0, 0.3):
        one, two = Robot(1, registry(), mode=mode), Robot(2, registry(), mode=mode)
        air = Air(one, two, loss=loss)
        for number in range(20):
            for robot in (one, two):
                robot.end.messages.submit(0, b"%d" % number, air.now)
            air.step()
        air.run(5.0)
        assert len(one.delivered()) == len(two.delivered()) == 20


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_a_recorded_packet_is_no_sign_of_life(mode: SealMode) -> None:
    one, two = Robot(1, registry(), mode=mode), Robot(2, registry(), mode=mode)
    air = Air(one, two)  # without losses: what it replays, two has heard
    talk(one, air, 0, 30)
    recorded = of(air, one)
    snr_db = []
    two.end.mcs_table = (Mcs("the only one", 0.01, 10.0, 1.0),)  # so that it reports an SNR
    air.robots = [two]
    for _ in range(200):
        air.run(0.1)
        for data in recorded[-30:]:
            two.events += two.end.receive(AirPacket(data, snr_db=40.0), air.now)
        known = two.end.neighbours.all.get(1)
        assert known is not None
        assert not known.inbox.reports.unreported or air.now < 3.0
        snr_db.append(known.inbox.reports.snr.snr_db)
    assert any(isinstance(event, Gone) for event in two.events)
    assert snr_db[-1] is None


@pytest.mark.parametrize("mode", SEALED)
def test_recordings_make_a_robot_that_starts_again_meet_nobody(mode: SealMode) -> None:
    """The other robot is dead: its packets can prove nothing to this start."""
    one, two, air = pair(mode)
    recorded = of(air, one)
    two.start()
    two.events.clear()
    air.robots = [two]
    for number in range(600):
        if number % 2 == 0:
            two.receive(recorded[number // 2 % len(recorded)], air.now)
        air.run(0.05)
        assert not two.end.peers(air.now)
        assert not two.end.window.peers
        assert not two.end.knows(1)
    assert not [event for event in two.events if isinstance(event, (Met, Gone, Delivered))]
    assert two.end.received.dropped["unproven"] > 0
    air.robots = [one, two]
    one.start()
    check_alive(one, two, air)
    assert any(isinstance(event, Met) for event in two.events)


def test_forged_requests_take_a_share_of_the_air() -> None:
    """Anybody may ask where no key is set. 20 kB are a third of what this robot can send in the time."""
    topics = registry(map=SendOptions(qos="bulk", durability="transient_local"))
    one, forger = Robot(1, topics, packet_len=220), Robot(2, registry(), packet_len=220, hears=False)
    air = Air(one, forger)
    one.end.messages.submit(0, bytes(range(256)) * 80, air.now)
    air.run(10.0)
    sent, begin = len(of(air, one)), air.now
    while air.now < begin + 60.0:
        ask = forger.end._sending._writer.control([Ask(1, b"\x00\x00\xf0")], "hello", SendSlot(air.now))
        one.receive(ask.data, air.now)
        air.run(0.1)
    assert one.end.received.dropped["asked_too_often"] > 0
    parts = [data for data in of(air, one)[sent:] if data[0] & 3 != QOS_REPAIR]
    repeated = 60.0 / (10.0 * (1 - TUNING.hello_early / 2)) * 98 * 220
    assert 4 * 20_000 < sum(map(len, parts)) < 0.17 * 60 * 75 * 220 + repeated
    late = Robot(3, packet_len=220)
    air.robots = [one, late]
    assert air.run(60.0, lambda: bool(late.delivered())) < 30.0, "who needs it gets it all the same"


def test_equal_ids_are_told_to_both_and_share_no_key() -> None:
    one, other = Robot(1, registry(), mode="encrypt"), Robot(1, registry(), mode="encrypt")
    one.start(boot=5 << 32 | 77)
    other.start(boot=5 << 32 | 78)
    air = Air(one, other)
    one.end.messages.submit(0, b"secret", 0.0)
    other.end.messages.submit(0, b"public", 0.0)
    air.run(2.0)
    for robot in (one, other):
        assert robot.end.received.rejected["same_id"] > 0
        assert not robot.delivered()
    assert subkey(KEY, 1, one.boot) != subkey(KEY, 1, other.boot)


@pytest.mark.parametrize("hears", [True, False])
def test_a_state_that_cannot_be_stored(hears: bool) -> None:
    """Where only the state keeps replays out, nothing is used that is not stored; it recovers when the disk does."""
    one, two = Robot(1, registry(), mode="encrypt", hears=hears), Robot(2, registry(), mode="encrypt", hears=hears)
    air = Air(one, two)
    talk(one, air, 0, 5)
    save, full = two.stored.__setitem__, True

    def stored(src_id: int, value: tuple[int, int]) -> None:
        if full:
            raise ConfigError("state: cannot be written (No space left on device)")
        save(src_id, value)

    two.save = stored
    one.start()
    two.start()
    two.events.clear()
    talk(one, air, 10, 60)
    assert (len(two.delivered()) > 50) is hears
    assert two.end.received.dropped["state_not_written"] > 0
    assert two.end.received.rejected["not_stored"] > 0 or hears
    recorded = of(air, one)
    full = False
    check_alive(one, two, air, 15.0)  # one way, the table of topics comes again every 10 s
    two.start()
    attack(two, recorded, air.now)
    check_alive(one, two, air, 15.0)


def test_what_was_withheld_for_long_is_not_executed() -> None:
    """Packets withheld for 45 s, then released after their sender has stopped: nothing with a deadline is taken."""
    rows = registry(cmd_vel=SendOptions(queue="deadline", deadline_s=1.0), log=SendOptions())
    one, two = Robot(1, rows, mode="encrypt"), Robot(2, registry(), mode="encrypt")
    air = Air(one, two, loss=0.2)
    for number in range(100):
        one.end.messages.submit(0, b"go %d" % number, air.now)
        air.run(0.05)
    assert len(two.delivered()) > 90
    withheld = len(air.recorded)
    usual = air.lost
    air.lost = lambda sender, receiver: sender is one or usual(sender, receiver)
    for number in range(100):
        one.end.messages.submit(0, b"late %d" % number, air.now)
        one.end.messages.submit(1, b"line %d" % number, air.now)
        air.run(0.1)
    recorded = [data for who, data in air.recorded[withheld:] if who is one]
    air.robots = [two]
    air.run(35.0)
    for data in recorded:
        two.receive(data, air.now)
    air.run(5.0)
    assert not any(payload.startswith(b"late") for payload in two.delivered())
    assert two.end.received.lost[1, 0, Fate.NOT_FRESH.value] > 50
    assert any(payload.startswith(b"line") for payload in two.delivered())  # nobody said that it must be fresh


def test_what_was_said_before_the_other_robot_could_prove_that_it_hears_is_repaired() -> None:
    """The hello of the other robot comes later than a sender without proofs would have fallen silent."""
    one, two = Robot(1, registry(), mode="encrypt"), Robot(2, registry(), mode="encrypt")
    air = Air(one, two)
    air.lost = lambda sender, _: sender is two
    one.end.messages.submit(0, b"said once", air.now)
    air.run(3.0)
    assert not two.delivered()
    air.lost = lambda _, __: False
    air.run(3.0)
    assert two.delivered() == [b"said once"]
    assert one.end.idle


def test_a_sealed_robot_that_nobody_hears_falls_silent() -> None:
    one = Robot(1, registry(), mode="encrypt")
    air = Air(one)
    one.end.messages.submit(0, b"said once", air.now)
    air.run(TUNING.unreported_meeting_s + 2.0)
    assert one.end.idle


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_what_is_fresh_is_taken(loss: float) -> None:
    rows = registry(cmd_vel=SendOptions(queue="deadline", deadline_s=1.0))
    one, two = Robot(1, rows, mode="encrypt"), Robot(2, registry(), mode="encrypt")
    air = Air(one, two, loss=loss)
    air.run(2.0)
    for number in range(600):
        one.end.messages.submit(0, b"go %d" % number, air.now)
        air.run(0.1)
    assert len(two.delivered()) >= 599
    assert not two.end.received.lost[1, 0, Fate.NOT_FRESH.value]
