"""Many on one channel: reports about what may be repaired, those first that miss something, and repairs for all."""

from __future__ import annotations

from math import inf
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from bench import reliable
from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.combining import Repair
from gr_ros2.link.v1.decoder import RepairDecoder, window_numbers
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.link.v1.order import Order
from gr_ros2.link.v1.reassembly import Reassembly
from gr_ros2.link.v1.repair import RepairWindow
from gr_ros2.link.v1.reports import SharedReporter
from gr_ros2.wire.v1 import Part

ROOM = 100
TUNING = Tuning()


def reporter() -> tuple[SharedReporter, RepairDecoder, Reassembly]:
    decoder = RepairDecoder(ROOM, lambda _: True, 1000)
    reassembly = Reassembly(10_000)
    order = Order(decoder, 1, 1.0, sure=10_000, fits=lambda _: False, room=ROOM)
    order.reported()
    access: Any = SimpleNamespace(turn_s=0.0)
    return SharedReporter((1, 1), decoder, order, Settings(2, access=access), reassembly), decoder, reassembly


def test_packets_that_nobody_repairs_are_not_reported() -> None:
    reports, _, _ = reporter()
    reports.arrived(late=False)
    reports.missed(3, counts=True)
    assert reports.due(5.0) == inf
    reports.confirm()
    assert reports.due(5.0) == TUNING.report_confirm_s, "it was never reported"
    reports.make(5.0)
    assert reports.due(5.0) == inf


def test_who_misses_something_reports_at_once() -> None:
    reports, decoder, reassembly = reporter()
    reports.arrived(late=False)
    decoder.source(2, b"")
    reassembly.add(Part(1, b"begin", 0, 0, False, False), 2, 0, repaired=False, now=0.0)
    assert reports.due(1.0) == inf, "the message goes on"
    decoder.source(3, b"")
    assert reports.due(1.0) == 1.0, "it does not"
    reports.make(1.0)
    assert reports.due(1.0) == 1.0 + TUNING.report_confirm_s, "the report may have been lost"


def window(peers: int) -> RepairWindow:
    """A sender of a message in order of three packets, which has left; the peers lose packets."""
    made = RepairWindow("thrifty", ROOM, shares=True)
    for src_id in range(peers):
        made.peers.meet(src_id, 0.0)
    made.sent(1, b"old", (Lifetime(expires=0.5),), 0.0)
    lifetime = Lifetime(in_order=True)
    for number in (2, 3, 4):
        lifetime.left = number == 4
        made.sent(number, b"body %d" % number, (lifetime,), float(number))
    return made


def test_one_repair_serves_peers_that_lack_different_packets() -> None:
    made = window(3)
    for src_id, lost in enumerate((2, 3, 4)):
        made.peers.report(src_id, 4, 0b11111 ^ 1 << 4 - lost, settled=True, loss=0.1, now=5.0)
    repair = made.urgent(5.0)
    assert isinstance(repair, Repair)
    assert (repair.number, repair.mask, repair.oldest) == (4, 0b111, True)
    made.sent(5, b"new", (Lifetime(),), 5.1)
    assert made.urgent(5.1) is None


def test_repairs_leave_room_for_new_messages() -> None:
    made = window(2)
    for src_id in (0, 1):
        made.peers.report(src_id, 4, 0b11001, settled=True, loss=0.1, now=5.0)
    assert made.urgent(5.0) is not None
    assert made.urgent(5.0) is None, "a new message goes first"
    assert made.next(5.0) is not None, "nothing new waits"


@pytest.mark.slow
def test_reliable_messages_arrive_beside_fresh_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("T0", 8.0), ("T1", 20.0), ("END", 30.0)):
        monkeypatch.setattr(reliable, name, value)
    both, alone = (reliable.talk(reliable=with_them, robots=6) for with_them in (True, False))
    assert len(both.delays) >= 5 * 6
    assert both.delays[-1] < inf
    assert both.reports <= 0.05
    assert both.age <= 1.3 * alone.age


@pytest.mark.parametrize("proven", [0, 30])
def test_who_came_after_older_packets_is_repaired_without_them(proven: int) -> None:
    """All of them are kept for a robot that is out of range."""
    sender = RepairWindow("thrifty", ROOM, shares=True)
    for src_id in (2, 3, 4):
        sender.peers.meet(src_id, 0.0)
    sender.peers.prove(4, proven)
    for number in range(1, 61):
        sender.sent(number, b"%d" % number, (Lifetime(in_order=True, left=True),), number / 10)
    sender.peers.leave(3)
    sender.peers.report(2, 60, (1 << 60) - 1, settled=True, loss=0.1, now=9.0)
    arrived = (1 << 29) - 1 ^ 1 << 20  # packets 32 to 60, but for 40
    sender.peers.report(4, 60, arrived, settled=proven == 0, loss=0.1, now=9.0)
    sender.peers.all[4].settled = 31 if not proven else 0
    repair = sender.urgent(9.0)
    while isinstance(repair, Repair) and 40 not in window_numbers(repair.number, repair.mask):
        sender.sent(sender.packets.newest + 1, b"", (), 9.0)
        repair = sender.urgent(9.0)
    assert isinstance(repair, Repair)
    assert min(window_numbers(repair.number, repair.mask)) >= 31


def test_what_a_peer_lacks_stays_urgent_when_it_asks_for_a_proof_again() -> None:
    sender = RepairWindow("thrifty", ROOM, shares=True)
    sender.peers.meet(2, 0.0)
    for number in range(1, 21):
        sender.sent(number, b"%d" % number, (Lifetime(in_order=True, left=True),), number / 10)
    for now in (3.0, 4.0):
        sender.peers.report(2, 20, 0b1111, settled=True, loss=0.1, now=now)  # it lacks 1 to 16
        found = 0
        for _ in range(40):
            sender.sent(sender.packets.newest + 1, b"", (), now)
            found += sender.urgent(now) is not None
        assert found >= 16, "one repair for each"
        sender.peers.prove(2, 16, wanted=True)


def test_what_a_peer_lacked_before_it_was_out_of_range_is_urgent_when_it_is_back() -> None:
    sender = RepairWindow("thrifty", ROOM, shares=True)
    for src_id in (2, 3):
        sender.peers.meet(src_id, 0.0)
    for number in range(1, 21):
        sender.sent(number, b"%d" % number, (Lifetime(in_order=True, left=True),), number / 10)
    sender.peers.report(2, 20, (1 << 20) - 1 ^ 1, settled=True, loss=0.1, now=3.0)  # it lacks 20
    sender.peers.leave(2)
    assert sender.urgent(3.0) is None
    sender.peers.report(2, 20, (1 << 20) - 1 ^ 1, settled=True, loss=0.1, now=30.0)
    assert sender.urgent(30.0) is not None


def test_a_peer_that_lacks_much_keeps_nothing_back_from_one_that_lacks_what_is_newer() -> None:
    sender = RepairWindow("thrifty", ROOM, shares=True)
    for src_id in (2, 3):
        sender.peers.meet(src_id, 0.0)
    for number in range(1, 301):
        sender.sent(number, b"%d" % number, (Lifetime(in_order=True, left=True),), number / 10)
    sender.peers.report(2, 64, 0, settled=False, loss=0.1, now=40.0)  # it was out of range
    sender.peers.report(3, 300, (1 << 64) - 1 ^ 1, settled=True, loss=0.1, now=40.0)
    covered: set[int] = set()
    for _ in range(20):
        sender.sent(sender.packets.newest + 1, b"", (), 40.0)
        repair = sender.urgent(40.0)
        if repair is not None:
            mask = repair.mask if isinstance(repair, Repair) else 1
            covered.update(window_numbers(repair.number, mask))
    assert {1, 300} <= covered


def test_a_peer_is_told_what_is_over_beside_one_that_lacks_much_that_is_older() -> None:
    """Repairs of what is older say nothing about it."""
    sender = RepairWindow("thrifty", ROOM, shares=True)
    for src_id in (2, 3):
        sender.peers.meet(src_id, 0.0)
    for number in range(1, 301):
        expires = 39.0 if number == 280 else inf
        sender.sent(number, b"%d" % number, (Lifetime(expires, in_order=True, left=True),), number / 10)
    everything = (1 << 64) - 1
    covered: set[int] = set()
    for now in range(40, 60):
        sender.peers.report(2, 64, 0, settled=False, loss=0.1, now=now)  # it was out of range
        sender.peers.report(3, 300, everything ^ 1 << 20, settled=True, loss=0.1, now=now)
        sender.sent(sender.packets.newest + 1, b"", (), now + 0.3)
        over = sender.peers.given_up(now + 0.3, 0.2)
        repair = sender.tell(over, now + 0.3) if over >= 0 else sender.urgent(now + 0.3)
        if isinstance(repair, Repair):
            covered.update(range(repair.number - repair.mask.bit_length() + 1, repair.number + 1))
            assert 280 not in window_numbers(repair.number, repair.mask)
    assert {1, 280} <= covered


def test_what_a_peer_takes_for_a_replay_is_combined_with_a_packet_that_is_repaired_itself() -> None:
    """With one that carries nothing of use any more, half of the peers could use none of these combinations."""
    sender = RepairWindow("thrifty", ROOM, shares=True)
    sender.peers.meet(2, 0.0)
    for number in range(1, 7):
        over = Lifetime(expires=-inf, fresh=True)
        sender.sent(number, b"body", (over,) if number == 5 else (Lifetime(in_order=True, left=True),), 0.0)
    sender.peers.prove(2, 4)
    sender.peers.report(2, 6, 0b01_1110, settled=False, loss=0.3, now=1.0)
    repair = sender.urgent(2.0)
    assert isinstance(repair, Repair)
    assert set(window_numbers(repair.number, repair.mask)) >= {1, 6}
    assert 5 not in window_numbers(repair.number, repair.mask)
