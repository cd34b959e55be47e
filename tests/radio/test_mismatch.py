"""Why most of what arrives is of no use, said without being asked."""

from __future__ import annotations

from typing import Any

from gr_ros2.radio.mismatch import LOOK_S, Mismatch

OWN = {"packet_len": 96, "phy": 1, "key": 0, "text": "0.1.0 psk 200000"}


def stats(arrived: int = 0, damaged: int = 0, early: int = 0, energy: int = 0, **refused: int) -> dict[str, Any]:
    return {
        "sink": {"rejected": refused, "dropped": {"early": early}},
        "packets": {"in": arrived, "damaged": damaged, "foreign": 0},
        "front_end": {"passed": {"energy": energy}, "lost": {}},
    }


def asked(about: dict[str, Any] | None) -> tuple[Mismatch, list[int]]:
    robots: list[int] = []

    def ask(robot: int) -> dict[str, Any]:
        robots.append(robot)
        return {"about": about}

    return Mismatch(OWN, ask, {}), robots


def test_a_robot_that_is_set_differently_says_what_it_has() -> None:
    mismatch, robots = asked({**OWN, "packet_len": 220, "phy": 2})
    assert mismatch.lines(stats(arrived=100, entry_kind=80), [2], 0.0) == [
        "robot 2: packet_len is 220 there and 96 here; set the same at both ends",
        "robot 2: phy has other settings there; set the same name, sample_rate and options at both ends",
    ]
    assert len(mismatch.lines(stats(arrived=100, entry_kind=80), [2], LOOK_S / 2)) == 2
    assert robots == [2], "it is asked once in a while"
    assert mismatch.lines(stats(arrived=200, entry_kind=80), [2], 2 * LOOK_S) == []
    assert robots == [2]


def test_where_no_answer_arrives_the_signs_are_named() -> None:
    mismatch, _ = asked(None)
    assert not mismatch.lines(stats(arrived=20, damaged=180), [2], -LOOK_S), "it may still answer"
    [line] = mismatch.lines(stats(arrived=20, damaged=366), [2], 0.0)
    assert line == (
        "of robot 2, much is of no use: bursts found, with errors: too weak, overlapped, or of another phy, options or "
        "packet_len (here packet_len is 96)"
    )
    [line] = mismatch.lines(stats(arrived=20, damaged=500), [], 2 * LOOK_S)
    assert line.startswith("no other robot is understood: bursts found, with errors")


def test_a_link_that_works_asks_nobody() -> None:
    mismatch, robots = asked({**OWN, "packet_len": 220})
    assert mismatch.lines(stats(arrived=300, damaged=120), [2], 0.0) == []
    assert mismatch.lines(stats(arrived=300, damaged=125), [2], LOOK_S) == []
    assert not robots


def test_packets_that_came_whole_and_cannot_be_read_are_enough() -> None:
    mismatch, robots = asked({**OWN, "packet_len": 220})
    assert mismatch.lines(stats(arrived=400, entry_kind=100), [2], 0.0) != []
    assert mismatch.lines(stats(arrived=800, damaged=20, entry_kind=100, crc=20), [2], LOOK_S) == []
    assert robots == [2]


def test_packets_that_wait_for_a_hello_for_ever_are_of_no_use() -> None:
    mismatch, _ = asked(None)
    [line] = mismatch.lines(stats(arrived=250, early=245, wrong_key=5), [], 0.0)
    assert line.startswith("no other robot is understood: packets refused: sealed with a key that is not accepted here")


def test_a_signal_without_packets_is_said_while_nobody_is_heard() -> None:
    mismatch, _ = asked(None)
    assert mismatch.lines(stats(energy=100), [], 0.0) == [
        "no other robot is understood: a signal was there, and no packet in it: the other end has another phy, "
        "sample_rate or options, or it is somebody else (here packet_len is 96)"
    ]
    assert mismatch.lines(stats(arrived=100, energy=200), [2], LOOK_S) == [], "what comes is a packet"


def test_an_end_that_is_asked_compares_itself_while_the_other_asks() -> None:
    about = {**OWN, "packet_len": 64}
    asked_by: dict[int, float] = {}
    mismatch = Mismatch(OWN, lambda _: {"about": about}, asked_by)
    assert mismatch.lines(stats(arrived=100), [2], 0.0) == []
    asked_by[2] = 4.0
    asked_by[3] = 4.0
    line = "robot 2: packet_len is 64 there and 96 here; set the same at both ends"
    assert mismatch.lines(stats(arrived=200), [2], LOOK_S) == [line], "robot 3 is not heard"
    assert mismatch.lines(stats(arrived=300), [2], 4 + 4 * LOOK_S) == []
