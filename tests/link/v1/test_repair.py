"""Repair: what is combined, what is recovered from it, and what happens when something in it is wrong."""

from __future__ import annotations

import random
from math import inf

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.link.v1.combining import Repair
from gr_ros2.link.v1.decoder import RepairDecoder, window_numbers
from gr_ros2.link.v1.gf256 import combine
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.link.v1.repair import RepairMode, RepairWindow
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.wire.control import LeftOut
from gr_ros2.wire.v1 import MAX_WINDOW, REPAIR_IDS

ROOM = 24


def body(number: int) -> bytes:
    return random.Random(number).randbytes(1 + number % ROOM)


def decoder(span: int = 4096) -> RepairDecoder:
    return RepairDecoder(ROOM, lambda _: True, span)


def window(mode: RepairMode | Auto = "idle", count: int = 0, **settings: float) -> RepairWindow:
    made = RepairWindow(mode, ROOM, **settings)
    for number in range(1, count + 1):
        made.sent(number, body(number), (Lifetime(),), number / 100)
    return made


def known(found: list[tuple[int, bytes]]) -> set[int]:
    for number, recovered in found:
        assert recovered.rstrip(b"\0") == body(number).rstrip(b"\0")
    return {number for number, _ in found}


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 70_000), st.integers(20, 300), st.sampled_from((0.05, 0.2, 0.4)), st.integers(1, 127), st.randoms()
)
def test_whatever_is_recovered_is_what_was_sent(
    first: int, count: int, loss: float, size: int, rng: random.Random
) -> None:
    receiver = decoder()
    receiver.begin(first)
    here: set[int] = set()
    repair_id = 0
    for number in range(first, first + count):
        if rng.random() >= loss:
            here |= known(receiver.source(number, body(number)))
        if rng.random() < 0.6:
            repair_id += 1
            mask = rng.getrandbits(min(size, number - first + 1)) | 1
            members = window_numbers(number, mask)
            if rng.random() >= loss:
                combined = combine(((member, body(member)) for member in members), repair_id % REPAIR_IDS)
                here |= known(receiver.repair(number, mask, repair_id % REPAIR_IDS, combined))
    assert all((number in receiver) == (number in here) for number in range(first, first + count))


@pytest.mark.parametrize("first", [0, 65_536 - 64, 131_072 - 100])
def test_a_full_window_is_recovered_from_as_many_repairs(first: int) -> None:
    receiver = decoder()
    receiver.begin(first)
    numbers = range(first, first + MAX_WINDOW)
    mask = (1 << MAX_WINDOW) - 1
    found: set[int] = set()
    for repair_id in range(MAX_WINDOW):
        assert not found
        combined = combine(((number, body(number)) for number in numbers), repair_id)
        found |= known(receiver.repair(numbers[-1], mask, repair_id, combined))
    assert found == set(numbers)
    assert receiver.equations == 0


def test_one_wrong_repair_does_not_spread() -> None:
    receiver = RepairDecoder(ROOM, lambda found: found.rstrip(b"\0") in (body(1), body(2), body(3)), 4096)
    right = [combine([(1, body(1)), (2, body(2)), (3, body(3))], repair_id) for repair_id in range(5)]
    receiver.repair(3, 7, 0, bytes(byte ^ 1 for byte in right[0]))
    receiver.repair(3, 7, 1, right[1])
    assert receiver.repair(3, 7, 2, right[2]) == []
    assert receiver.counts["implausible"] == 1
    assert receiver.equations == 0
    receiver.repair(3, 7, 3, right[3])
    receiver.repair(3, 7, 4, right[4])
    assert known(receiver.source(2, body(2))) == {1, 2, 3}


def test_equations_that_contradict_each_other_are_dropped() -> None:
    receiver = decoder()
    combined = combine([(1, body(1)), (2, body(2))], 5)
    receiver.repair(2, 3, 5, combined)
    assert receiver.equations == 1
    assert receiver.repair(2, 3, 5, bytes(byte ^ 9 for byte in combined)) == []
    assert (receiver.equations, receiver.counts["implausible"]) == (0, 1)


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 60), st.data())
def test_packets_that_are_still_worth_it_are_recovered_without_the_others(count: int, data: st.DataObject) -> None:
    """Repairs that name all packets, fewer than these; then repairs that name some: as many as these need, and one."""
    receiver = decoder()
    some = sorted(data.draw(st.sets(st.integers(1, count), min_size=1, max_size=count - 1)))
    before = data.draw(st.integers(0, count - 1))
    found: set[int] = set()
    for repair_id in range(before + len(some) + 1):
        named = list(range(1, count + 1)) if repair_id < before else some
        mask = sum(1 << named[-1] - number for number in named)
        combined = combine([(number, body(number)) for number in named], repair_id)
        found |= known(receiver.repair(named[-1], mask, repair_id, combined))
    assert found >= set(some)


@pytest.mark.parametrize("seed", [41, 61, 140, 146, 258])
def test_as_many_repairs_as_packets_bring_them_whatever_wider_ones_came_between(seed: int) -> None:
    """Wider repairs, which together reach further than one equation may, tell too little for any packet."""
    rng, receiver = random.Random(seed), decoder()
    some = range(1, rng.randint(5, 50))
    wide = [range(first, first + MAX_WINDOW) for first in (1, rng.randint(20, 80), rng.randint(80, 140))]
    repairs = [some] * (len(some) + rng.randint(0, 20))
    for numbers in wide:
        repairs += [numbers] * rng.randint(1, 60)
    rng.shuffle(repairs)
    used = dict.fromkeys((numbers[-1] for numbers in repairs), -1)
    found: set[int] = set()
    for numbers in repairs:
        used[numbers[-1]] += 1
        combined = combine([(number, body(number)) for number in numbers], used[numbers[-1]])
        found |= known(receiver.repair(numbers[-1], (1 << len(numbers)) - 1, used[numbers[-1]], combined))
    assert found >= set(some)


def test_memory_is_bounded() -> None:
    receiver = decoder(span=100)
    for number in range(0, 5000, 2):
        receiver.source(number, body(number))
        receiver.repair(number, 0b1011, number % REPAIR_IDS, b"x" * ROOM)
    assert receiver.floor == 4998 - 99
    assert sum(number in receiver for number in range(5000)) <= 100
    assert receiver.equations <= 100
    assert receiver.source(3, body(3)) == []
    receiver.source(10**9, body(10**9))
    assert sum(number in receiver for number in range(5000)) == 0


def test_the_newest_live_packets_are_combined() -> None:
    repair = window(count=10).next(0.2)
    assert isinstance(repair, Repair)
    assert (repair.number, repair.mask, repair.oldest) == (10, (1 << 10) - 1, True)
    assert repair.combined == combine(((number, body(number)) for number in range(1, 11)), repair.repair_id)


def test_one_live_packet_is_repeated_in_effect() -> None:
    sender = window()
    old, new = Lifetime(), Lifetime(expires=5.0)
    sender.sent(1, b"old", (old,), 0.0)
    sender.sent(2, b"new", (new,), 0.0)
    old.end()
    repair = sender.next(1.0)
    assert isinstance(repair, Repair)
    assert (repair.number, repair.mask) == (2, 1)
    assert known_text(decoder(), repair) == b"new"
    assert sender.next(5.0) is None  # too late for it


def known_text(receiver: RepairDecoder, repair: Repair) -> bytes:
    ((_, found),) = receiver.repair(repair.number, repair.mask, repair.repair_id, repair.combined)
    return found.rstrip(b"\0")


def test_what_is_over_is_left_out_where_its_mask_fits() -> None:
    sender = window()
    lifetimes = [Lifetime() for _ in range(5)]
    for number, lifetime in enumerate(lifetimes, 1):
        sender.sent(number, b"short" if number < 5 else b"x" * number, (lifetime,), 0.0)
    lifetimes[2].end()
    repair = sender.next(0.0)
    assert isinstance(repair, Repair)
    assert (repair.number, repair.mask) == (5, 0b11011)
    sender.sent(6, b"x" * ROOM, (Lifetime(),), 0.0)  # no byte is left for a mask: the window goes without holes
    repair = sender.next(0.0)
    assert isinstance(repair, Repair)
    assert (repair.number, repair.mask) == (6, 0b111111)


def test_who_comes_back_need_not_be_brought_what_was_over_meanwhile() -> None:
    """Where no mask fits, a combination of all would have to bring that too."""
    sender, alive = window(), {1, 2, 3, 99, 100}
    sender.peers.meet(8, 0.0)
    sender.peers.meet(9, 0.0)
    for number in range(1, 101):
        sender.sent(number, b"x" * ROOM, (lifetime := Lifetime(),), 0.0)
        if number not in alive:
            lifetime.end()

    def spans() -> list[set[int]]:
        repairs = [sender.next(1.0) for _ in range(9)]
        return [set(window_numbers(repair.number, repair.mask)) for repair in repairs if repair is not None]

    assert len(spans()) == 9
    assert all(span in ({1, 2, 3}, {99, 100}) for span in spans())
    assert set.union(*spans()) == alive
    for number, record in sender.packets.records.items():
        record.confirmed = 0 if number in alive else sender.packets.everybody
    assert all(span == set(range(1, 101)) for span in spans()), "what all have costs nothing"


def test_more_than_a_group_is_repaired_in_windows_that_move_over_it() -> None:
    sender = window()
    long = Lifetime()
    for number in range(1, 301):
        sender.sent(number, body(number), (long,), 0.0)
    seen = set()
    for _ in range(9):
        repair = sender.next(9.0)
        assert isinstance(repair, Repair)
        numbers = window_numbers(repair.number, repair.mask)
        assert len(numbers) <= MAX_WINDOW
        assert repair.oldest == (numbers[-1] == 1)
        seen |= set(numbers)
    assert seen == set(range(1, 301))


def test_a_repair_id_is_used_once_per_number() -> None:
    sender = window(count=1)
    repair_ids = [sender.packets.take_repair_id(1) for _ in range(REPAIR_IDS)]
    assert sorted(repair_id for repair_id in repair_ids if repair_id is not None) == list(range(REPAIR_IDS))
    assert sender.packets.take_repair_id(1) is None
    assert sender.next(0.0) is None  # no repair can stand there any more
    assert sender.packets.take_repair_id(2) is not None


def test_a_packet_that_one_receiver_lacks_is_repaired_alone() -> None:
    sender = window(count=5)
    sender.peers.report(9, 5, 0b10110, settled=True, loss=0.2, now=0.1)
    again = [sender.next(0.1), sender.next(0.1)]
    assert [(repair.number, repair.mask) for repair in again if repair is not None] == [(5, 1), (2, 1)]
    both = sender.next(0.1)  # both may have been lost again
    assert both is not None and both.mask == 0b1001
    sender.peers.report(9, 5, 0b11111, settled=True, loss=0.2, now=0.2)
    assert sender.next(0.3) is None


def test_two_receivers_are_served_by_combinations() -> None:
    sender = window(count=4)
    sender.peers.meet(8, 0.0)
    sender.peers.meet(9, 0.0)
    sender.peers.report(8, 4, 0b1110, settled=True, loss=0.1, now=0.1)
    sender.peers.report(9, 4, 0b1011, settled=True, loss=0.1, now=0.1)
    repair = sender.next(0.2)
    assert isinstance(repair, Repair)
    assert {4, 2} <= set(window_numbers(repair.number, repair.mask))
    sender.peers.report(8, 4, 0b1111, settled=True, loss=0.1, now=0.3)
    assert sender.next(0.3) is not None
    sender.peers.forget(9)
    assert sender.next(0.4) is None


def spent(sender: RepairWindow, count: int) -> list[Repair]:
    """The repairs in idle air without end, after each of so many packets with messages in order."""
    repairs = []
    for number in range(sender.packets.newest + 1, sender.packets.newest + 1 + count):
        sender.sent(number, body(number), (Lifetime(in_order=True),), float(number))
        while (repair := sender.next(float(number))) is not None:
            repairs.append(repair)
    return repairs


def test_repairs_are_bounded_while_all_receivers_are_out_of_range() -> None:
    count = 60
    alone = spent(window(AUTO, expected_loss=0.2), count)
    sender = window(AUTO, expected_loss=0.2)
    sender.peers.meet(9, 0.0)
    sender.peers.leave(9)
    repairs = spent(sender, count)
    assert count < len(repairs) <= 2.1 * count < 3 * count < len(alone)
    # Each packet is in several of them: who hears and is not heard misses none.
    found = [sum(number in window_numbers(one.number, one.mask) for one in repairs) for number in range(1, count + 1)]
    assert min(found[:-5]) > 3
    sender.peers.meet(9, count + 1.0)
    assert sender.mode == "thrifty"


def test_a_report_of_what_was_never_sent_confirms_nothing() -> None:
    sender = window(count=3)
    sender.peers.report(9, 4, (1 << 64) - 1, settled=True, loss=0.0, now=0.1)
    assert sender.packets.unconfirmed(0.1)
    assert not sender.peers


def test_a_thrifty_sender_is_silent_without_losses_and_without_doubt() -> None:
    sender = window("thrifty", 5)
    assert sender.next(0.06) is None
    sender.peers.report(9, 4, 0b1111, settled=True, loss=0.0, now=0.06)
    assert sender.next(0.07) is None
    assert sender.next(9.0) is not None  # no report for long: the last packet may be lost
    assert sender.next(9.0) is None


def prompt(count: int, delay: float = 0.01) -> RepairWindow:
    """A thrifty sender with one receiver, which loses packets and reports each one ``delay`` after it was sent."""
    sender = window("thrifty")
    for number in range(1, count + 1):
        at = number / 10
        sender.sent(number, body(number), (Lifetime(),), at)
        sender.peers.report(9, number, (1 << 64) - 1, settled=True, loss=0.2, now=at + delay)
    return sender


def test_a_report_that_does_not_come_is_noticed_when_it_is_overdue() -> None:
    sender = prompt(4)
    sender.sent(5, body(5), (Lifetime(),), 0.5)
    assert sender.next(0.5) is None
    overdue = sender.thrift.next_doubt(0.5)
    assert overdue == pytest.approx(0.51)
    assert sender.next(0.509) is None
    repair = sender.next(overdue + 1e-6)
    assert isinstance(repair, Repair)
    assert window_numbers(repair.number, repair.mask) == [5]
    assert sender.next(overdue + 2e-6) is None  # until the repair is overdue too
    again = sender.thrift.next_doubt(overdue + 2e-6)
    assert again == pytest.approx(0.52, abs=1e-4)
    assert sender.next(again + 1e-6) is not None
    sender.peers.report(9, 5, (1 << 64) - 1, settled=True, loss=0.2, now=0.53)
    assert sender.next(0.53) is None


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.2])
def test_nothing_is_repaired_before_a_report_that_comes_at_once_is_overdue(loss: float) -> None:
    sender = window("thrifty")
    for number in range(1, 100):
        at = number / 10
        sender.sent(number, body(number), (Lifetime(),), at)
        assert sender.next(at) is None or number < 4  # the first reports tell how long one takes
        sender.peers.report(9, number, (1 << 64) - 1, settled=True, loss=loss, now=at + 0.01)


def test_reports_that_take_long_are_not_waited_for() -> None:
    sender = prompt(4, delay=0.25)
    sender.sent(5, body(5), (Lifetime(),), 0.7)
    assert isinstance(sender.next(0.7), Repair)


def test_the_delay_of_a_report_is_not_measured_on_what_was_repaired() -> None:
    sender = prompt(4)
    sender.sent(5, body(5), (Lifetime(),), 0.5)
    assert sender.next(0.52) is not None
    sender.peers.report(9, 5, (1 << 64) - 1, settled=True, loss=0.2, now=0.7)
    sender.sent(6, body(6), (Lifetime(),), 0.8)
    assert sender.thrift.next_doubt(0.8) < 0.82


def test_a_receiver_that_waits_for_what_is_over_is_told_so_by_a_repair() -> None:
    sender = window("thrifty")
    gone = Lifetime()
    sender.sent(1, b"gone", (gone,), 0.0)
    sender.sent(2, b"here", (Lifetime(),), 0.1)
    gone.end()
    sender.peers.report(9, 2, (1 << 64) - 1 ^ 0b11, settled=False, loss=0.0, now=0.1)
    sender.peers.report(9, 2, (1 << 64) - 1 ^ 0b10, settled=False, loss=0.0, now=0.2)
    assert sender.next(0.2) is None  # all that is alive has arrived: there is nothing to combine
    sender.sent(3, b"new", (Lifetime(),), 0.3)
    assert sender.peers.given_up(0.3) == 1
    repair = sender.tell(1, 0.3)
    assert isinstance(repair, Repair)
    assert sender.peers.given_up(0.3) == -1
    assert (window_numbers(repair.number, repair.mask), repair.oldest) == ([3], True)
    sender.peers.report(9, 3, (1 << 64) - 1, settled=True, loss=0.0, now=0.4)
    assert sender.next(0.4) is None


def test_off_is_off() -> None:
    assert window("off", 5).next(1.0) is None


def test_nothing_lives_longer_than_the_span() -> None:
    sender = RepairWindow("idle", ROOM, span=100)
    for number in range(1, 400):
        sender.sent(number, b"x", (Lifetime(inf),), 0.0)
    repair = sender.next(0.0)
    assert isinstance(repair, Repair)
    assert window_numbers(repair.number, repair.mask)[-1] >= 300


def test_a_repair_that_stands_at_a_later_packet_leaves_out_none_that_is_alive() -> None:
    sender = window("thrifty", 8)
    sender.peers.meet(2, 0.1)
    sender.peers.prove(2, 6)  # the receiver takes combinations from packet 7 on
    for number in (1, 2):
        sender.packets.records[number].lifetimes[0].end()
    repair = sender.tell(1, 0.2)
    assert isinstance(repair, Repair)
    assert (repair.number, repair.oldest) == (7, True)
    assert window_numbers(repair.number, repair.mask) == [7, 6, 5, 4, 3]


def sent_to(peers: dict[int, int], count: int) -> RepairWindow:
    """A sender of so many packets to peers of which each may take those up to a number for replays."""
    sender = window("thrifty", count)
    for src_id, proven in peers.items():
        sender.peers.meet(src_id, 0.0)
        sender.peers.prove(src_id, proven)
    return sender


def test_what_may_be_taken_for_a_replay_comes_back_above_the_proof_also_before_new_messages() -> None:
    sender = sent_to({2: 60}, 70)
    sender.peers.sent(70, (Lifetime(in_order=True),), 0.7)
    sender.peers.report(2, 70, (1 << 64) - 1 ^ 1 << 20, settled=True, loss=0.1, now=9.0)
    repair = sender.urgent(9.0)
    assert isinstance(repair, Repair)
    assert repair.number > 60 and 50 in window_numbers(repair.number, repair.mask)


def test_a_report_tells_that_an_earlier_proof_was_taken_than_the_last_one() -> None:
    sender = sent_to({2: 900}, 1000)
    sender.peers.report(2, 163, 0, settled=True, loss=0.1, now=20.0)  # it waits for packet 100
    again = sender.next(20.0)
    assert isinstance(again, Repair)
    sender.peers.report(2, 363, 0, settled=False, loss=0.1, now=21.0)
    again = sender.next(21.0)
    assert again is not None and (again.number, again.mask) == (363, 1)


def test_what_nothing_alive_brings_back_above_the_proof_is_sent_without_and_is_over_in_the_end() -> None:
    sender = RepairWindow("thrifty", ROOM)
    sender.peers.meet(2, 0.0)
    for number in range(1, 301):
        lifetime = Lifetime(in_order=True) if number in (50, 300) else Lifetime(expires=number / 100)
        sender.sent(number, body(number), (lifetime,), number / 100)
    sender.peers.prove(2, 170)
    tried, now = 0, 9.0
    while sender.packets.records[50].alive(now):
        now += 1
        sender.peers.report(2, 113, (1 << 63) - 1, settled=True, loss=0.1, now=now)
        repair = sender.urgent(now)
        tried += repair is not None and (repair.number, repair.mask) == (50, 1)
    assert tried == REPAIR_IDS
    sender.peers.report(2, 113, (1 << 63) - 1, settled=True, loss=0.1, now=now)
    assert sender.peers.given_up(now) == 50


def test_a_peer_that_starts_again_keeps_nothing_back_from_another_one() -> None:
    sender = sent_to({2: 0, 3: 900}, 1000)
    seen = set()
    for slot in range(100):
        repair = sender.next(20.0 + 10 * slot)
        assert isinstance(repair, Repair)
        seen |= set(window_numbers(repair.number, repair.mask))
    assert seen == set(range(1, 1001))


@pytest.mark.parametrize("shares", [False, True])
def test_a_receiver_is_told_of_what_is_over_between_packets_that_others_lack(shares: bool) -> None:
    sender = RepairWindow("thrifty", ROOM, shares=shares)
    for number in range(1, 601):
        lifetime = Lifetime(in_order=True)
        sender.sent(number, body(number), (lifetime,), number / 100)
        if number not in {1, 600}:
            lifetime.end()
    sender.peers.meet(2, 7.0)
    sender.peers.meet(3, 7.0)
    told = sender.tell(300, 7.0)
    # No combination that fits spans it; so many of its neighbours are told of with it.
    assert told == LeftOut(363, (1 << 64) - 1, settled=False)


def test_where_turns_are_rare_a_receiver_is_told_of_what_the_next_message_replaces() -> None:
    """Such a packet is alive for long, and no repair names it."""
    sender = RepairWindow("thrifty", ROOM, shares=True)
    sender.peers.meet(2, 0.0)
    for number in range(1, 41):
        fresh = number in {5, 9}
        sender.sent(number, body(number), (Lifetime(in_order=not fresh, fresh=fresh, left=True),), number / 10)
    lacks = 1 << 40 - 5 | 1 << 40 - 9
    sender.peers.report(2, 40, (1 << 64) - 1 ^ lacks, settled=True, loss=0.1, now=5.0)
    assert sender.urgent(5.0) is None
    assert sender.peers.given_up(5.0) == 5
    told = sender.tell(5, 5.0)
    assert isinstance(told, LeftOut)
    assert told.packets >> told.number - 5 & 1 and told.packets >> told.number - 9 & 1


@pytest.mark.parametrize("shares", [False, True])
def test_what_peers_lacked_and_need_no_more_is_forgotten(shares: bool) -> None:
    sender = RepairWindow("thrifty", ROOM, shares=shares)
    before = Lifetime()
    for number in range(1, 3001):
        before.end()
        sender.sent(number, body(number), (before := Lifetime(),), number / 10)
        for src_id in (8, 9):
            sender.peers.report(src_id, number, (1 << 64) - 2, settled=True, loss=0.2, now=number / 10 + 0.05)
        sender.next(number / 10 + 0.06)
    peers = sender.peers
    kept = sum(len(peer.lost) + len(peer.urgent) for peer in peers.all.values())
    assert len(peers._resend) + kept < 200
