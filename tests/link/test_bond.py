"""Over which radios packets leave, and which copies count."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.link.airtime import OUTSTANDING, AirtimeClock
from gr_ros2.link.bond import Bond
from gr_ros2.link.events import Gone, Received

LIKE = (0.01, 0.01)
SLOW = (0.01, 0.4)
SOME = 40
"""Packets after which what has become of a radio is known."""


def control(data: bytes, src_id: int = 2) -> Received:
    packet: Any = SimpleNamespace(repair=SimpleNamespace(mask=0))
    return Received(data, packet, src_id, 1, 0, 0)


def hear(bond: Bond, radios: tuple[int, ...], numbers: range, src_id: int = 2) -> None:
    """Packets of a robot that come over some radios, each as its sender's endpoint makes it for all of them."""
    for number in numbers:
        data = src_id.to_bytes(1, "big") + number.to_bytes(4, "big")
        for radio in radios:
            if bond.arrive(radio, data):
                bond.note([control(data, src_id)])


def ask(bond: Bond) -> None:
    """Each radio asks for as many packets as a gate grants."""
    for radio in range(len(bond.carries)):
        bond.ask(radio, OUTSTANDING)


def test_radios_of_one_speed_carry_packets_in_the_order_in_which_they_asked() -> None:
    bond = Bond(LIKE)
    assert [bond.ask(radio, 1) for radio in (0, 1, 1, 0)] == [1, 1, 1, 1]
    assert [bond.leave(everywhere=False) for _ in range(4)] == [[0], [1], [1], [0]]


def test_a_much_slower_radio_stands_by_and_carries_copies() -> None:
    bond = Bond(SLOW)
    assert bond.carries == [True, False]
    assert [bond.ask(0, 2), bond.ask(1, 2)] == [2, 0]
    assert [bond.leave(everywhere=True) for _ in range(3)] == [[0, 1], [0, 1], [0]]
    assert bond.skipped == [0, 1]


def test_a_copy_is_paid_with_the_next_packet_that_its_radio_asks_for() -> None:
    bond = Bond(LIKE)
    ask(bond)
    assert bond.leave(everywhere=True) == [0, 1]
    assert bond.ask(1, 1) == 0
    assert bond.ask(1, 1) == 1


def test_what_comes_over_two_radios_counts_once_and_what_is_sent_again_comes_through() -> None:
    bond = Bond(LIKE)
    assert [bond.arrive(radio, b"one") for radio in (0, 1, 1, 0)] == [True, False, True, True]
    assert (bond.came, bond.copies) == ([2, 1], [0, 1])


def test_a_radio_over_which_nothing_comes_carries_nothing_until_it_does() -> None:
    bond = Bond(LIKE)
    ask(bond)
    hear(bond, (0, 1), range(SOME))
    assert bond.carries == [True, True]
    hear(bond, (0,), range(SOME, 2 * SOME))
    assert bond.carries == [True, False]
    assert {bond.leave(everywhere=False)[0] for _ in range(8)} == {0}
    hear(bond, (0, 1), range(2 * SOME, 3 * SOME))
    assert bond.carries == [True, True]
    assert bond.asks() == OUTSTANDING
    assert 0.9 < bond.heard(1)[2] < 1


def test_a_robot_with_one_radio_is_served_over_that_one_as_long_as_it_is_heard() -> None:
    bond = Bond(LIKE)
    hear(bond, (0, 1), range(SOME))
    hear(bond, (1,), range(SOME), src_id=3)
    assert bond.carries == [False, True]
    bond.note([Gone(3, 1)])
    assert bond.carries == [True, True]


def test_packets_that_the_endpoint_refuses_say_nothing() -> None:
    bond = Bond(LIKE)
    hear(bond, (0, 1), range(SOME))
    for number in range(1000):
        bond.arrive(0, b"junk %d" % number)
    assert bond.carries == [True, True]


@pytest.mark.parametrize("airtimes", [LIKE, SLOW])
def test_what_a_lost_device_had_asked_for_leaves_over_the_other(airtimes: tuple[float, float]) -> None:
    bond = Bond(airtimes)
    ask(bond)
    bond.vanish(0)
    assert bond.carries == [False, True]
    bond.asks()
    assert [bond.leave(everywhere=True) for _ in range(4)] == [[1]] * 4
    bond.come_back(0)
    assert bond.carries[0]


def test_radios_without_airtime_never_ask_and_take_every_copy() -> None:
    bond = Bond((0.0, 0.0))
    assert all(bond.leave(everywhere=True) == [0, 1] for _ in range(20))


_STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("ask"), st.integers(0, 2), st.integers(1, 2)),
        st.tuples(st.just("leave"), st.booleans()),
        st.tuples(st.just("vanish"), st.integers(0, 2)),
        st.tuples(st.just("back"), st.integers(0, 2)),
        st.tuples(st.just("hear"), st.sets(st.integers(0, 2), min_size=1), st.integers(1, 3)),
        st.tuples(st.just("gone"), st.integers(1, 3)),
    ),
    max_size=200,
)


@given(_STEPS, st.tuples(*[st.sampled_from((0.0, 0.01, 0.011, 0.5))] * 3))
def test_every_packet_leaves_and_no_radio_gets_more_than_it_has_room_for(
    steps: list[Any], airtimes: tuple[float, float, float]
) -> None:
    """A gate takes what it asked for and at most ``OUTSTANDING`` copies; what cannot wait goes over who is there."""
    bond, number = Bond(airtimes), 0
    present, asked, extra = {0, 1, 2}, [0, 0, 0], [0, 0, 0]
    passed = 0
    for step in steps:
        match step:
            case "ask", radio, packets if radio in present and airtimes[radio]:
                asked[radio] += packets
                passed += bond.ask(radio, packets)
            case "leave", everywhere if passed or not all(airtimes):
                passed = max(0, passed - 1)
                radios = bond.leave(everywhere=everywhere)
                assert len(set(radios)) == len(radios) >= 1
                assert set(radios) <= present or not present
                for radio in radios[1:]:
                    extra[radio] += 1
                assert all(extra[r] <= asked[r] + OUTSTANDING for r in present if airtimes[r])
            case "vanish", radio:
                present.discard(radio)
                bond.vanish(radio)
                passed += bond.asks()
            case "back", radio:
                present.add(radio)
                bond.come_back(radio)
                passed += bond.asks()
            case "hear", radios, src_id:
                number += 1
                hear(bond, tuple(radios), range(number, number + 1), src_id)
                passed += bond.asks()
            case "gone", src_id:
                bond.note([Gone(src_id, 1)])
                passed += bond.asks()
        assert any(bond.carries)
        assert all(0 <= share <= 1 for radio in range(3) for share in bond.heard(radio).values())


@pytest.mark.parametrize("airtimes", [LIKE, SLOW, (0.01, 0.012, 0.3)])
@given(everywhere=st.lists(st.booleans(), min_size=1, max_size=40), waiting=st.integers(1, 6), every=st.integers(1, 60))
@settings(max_examples=20)
def test_with_real_gates_every_radio_goes_on_and_holds_few_packets(
    airtimes: tuple[float, ...], everywhere: list[bool], waiting: int, every: int
) -> None:
    """An endpoint with so many packets at once, every so many ms, of which some leave everywhere. At last only the
    first radio is heard, and packets go on."""
    bond, gates = Bond(airtimes), [AirtimeClock[bytes](takes) for takes in airtimes]
    credits, waits, kinds = 0, 0, itertools.cycle(everywhere)
    passed = [0 for _ in airtimes]

    def run(steps: range) -> int:
        nonlocal credits, waits
        left = 0
        for step in steps:
            now = 0.001 * step
            for radio, gate in enumerate(gates):
                passed[radio] += len(gate.due(now))
                credits += bond.ask(radio, gate.grants(now))
                assert gate.backlog <= OUTSTANDING + 1
            if step % every == 0:
                waits = waiting
            while credits and waits:
                credits, waits, left = credits - 1, waits - 1, left + 1
                for radio in bond.leave(everywhere=next(kinds)):
                    gates[radio].offer(b"", now)
        return left

    asked = waiting * 3000 / every
    left = run(range(3000))
    assert left > 0.8 * min(asked, 3 / airtimes[0])
    if every == 1:
        assert all(passed[r] > 0.8 * 3 / takes for r, takes in enumerate(airtimes) if bond.carries[r])
    hear(bond, (0, 1, 2)[: len(airtimes)], range(SOME))
    hear(bond, (0,), range(SOME, 2 * SOME))
    assert bond.carries[0]
    assert not any(bond.carries[1:])
    assert run(range(3000, 6000)) > 0.8 * min(asked, 3 / airtimes[0])
