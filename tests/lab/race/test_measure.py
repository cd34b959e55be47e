from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.race.links import LinkLog, LinkReport
from gr_ros2_lab.race.measure import Identity, Observed, RaceStream, by_condition, columns, measure, shown, winners
from gr_ros2_lab.race.race_settings import RaceRecording
from tests.lab.race.support import cell
from tests.lab.race.test_race_settings import text

KIND = "std_msgs/msg/String"


def recording(*payloads: bytes, kind: str = KIND) -> RaceRecording:
    return RaceRecording(Path("bag"), "/talk", kind, payloads, tuple(0.1 * number for number in range(len(payloads))))


def feedback(number: int, gap: bytes) -> bytes:
    return b"\0\1\0\0\1" + bytes([number]) + gap + struct.pack("<f", 0.5)


IDENTITY = Identity(recording(*(text(number) for number in range(4))))


def log(*frames: tuple[float, int, float]) -> LinkLog:
    made = LinkLog()
    for frame in frames:
        made.note(*frame)
    return made


def observed(heard: list[tuple[float, bytes]], there: LinkLog | None = None, back: LinkLog | None = None) -> Observed:
    stream = RaceStream(IDENTITY, [10.0, 11.0, 12.0, 13.0], heard)
    return Observed(9.0, True, [stream], LinkReport(there or log(), back or log(), {"on_air": 2, "queue_full": 0}), 0.3)


def measured(seen: Observed, robots: int | None = None) -> object:
    return measure(seen, contender="gr-ros2", load=2.0, loss=0.05, sample_rate=1e5, robots=robots)


def test_every_number_of_a_cell() -> None:
    there = log((9.5, 100, 0.01), (10.5, 500, 0.05), (12.5, 500, 0.05))
    back = log((9.6, 40, 0.004), (13.5, 50, 0.005))
    seen = observed([(10.25, text(0)), (12.75, text(2))], there, back)
    found = measured(seen)
    assert found.sent == 4  # type: ignore[attr-defined]
    expected = {
        "delivered": 2,
        "pdr": 0.5,
        "latency_p50": pytest.approx(0.5),
        "latency_p99": pytest.approx(0.25 + 0.99 * 0.5),
        # From 10.25 on the newest is that of 10, from 12.75 on that of 12, until the last was sent at 13.
        "latency_p99_of_sent": None,
        "age_mean": pytest.approx((2.5 * (0.25 + 2.75) / 2 + 0.25 * (0.75 + 1.0) / 2) / 2.75),
        "age_p95": pytest.approx(0.95 * 2.75),
        "age_peak": pytest.approx(2.75),
        "airtime_per_message": pytest.approx(0.105 / 2),
        "air_bytes_per_message": pytest.approx(1050 / 2),
        "air_bytes_reverse": pytest.approx(50 / 1050),
        "discovery_bytes": 140,
        "first_message": pytest.approx(1.25),
        "drops": {"on_air": 2},
    }
    assert {name: getattr(found, name) for name in expected} == expected


def test_a_message_that_is_lost_is_later_than_all_others() -> None:
    heard = [(10.25, text(0)), (11.5, text(1)), (12.125, text(2)), (13.75, text(3))]
    assert measured(observed(heard)).latency_p99_of_sent == pytest.approx(0.75)  # type: ignore[attr-defined]
    assert measured(observed(heard[:3])).latency_p99_of_sent is None  # type: ignore[attr-defined]


def test_a_team_has_the_numbers_of_all_its_pairs() -> None:
    one, other = observed([(10.25, text(0)), (12.75, text(2))]), observed([(11.5, text(1)), (13.5, text(3))])
    streams = [*one.streams, *other.streams]
    found = measured(replace(one, streams=streams), robots=2)
    expected = {
        "sent": 8,
        "delivered": 4,
        "pdr": 0.5,
        "age_mean": pytest.approx(((2.5 * 1.5 + 0.25 * 0.875) / 2.75 + 1.25) / 2),
        "age_p95": pytest.approx((0.95 * 2.75 + 0.5 + 0.95 * 1.5) / 2),
        "age_peak": pytest.approx(2.75),
        "first_message": pytest.approx(1.25),
        "all_heard": pytest.approx(2.5),
    }
    assert {name: getattr(found, name) for name in expected} == expected
    silent = RaceStream(IDENTITY, [10.0], [])
    assert measured(replace(one, streams=[*streams, silent]), robots=2).all_heard is None  # type: ignore[attr-defined]


def test_what_came_twice_or_altered_is_not_delivered_again() -> None:
    strange = text(2)[:-3] + b"!!\0"
    found = measured(observed([(10.1, text(0)), (10.2, text(0)), (12.1, strange)]))
    assert (found.delivered, found.duplicates, found.altered) == (1, 1, 1)  # type: ignore[attr-defined]


def test_of_nothing_delivered_no_number_is_made_up() -> None:
    found = measured(observed([]))
    none = ("latency_p50", "latency_p99", "age_mean", "airtime_per_message", "air_bytes_per_message", "first_message")
    assert [getattr(found, name) for name in none] == [None] * len(none)
    assert found.pdr == 0  # type: ignore[attr-defined]
    assert shown(found, "age_mean") == "–"  # type: ignore[arg-type]


def test_padding_of_dds_and_alignment_gaps_are_not_the_message() -> None:
    identity = Identity(recording(text(7), text(8)))
    assert identity.number(text(8) + b"\0\0\0") == 1
    assert identity.number(text(9)) is None
    # Two bytes of nobody's stand between the two numbers of a JoyFeedback and its intensity.
    gaps = Identity(recording(*(feedback(number, b"\0\0") for number in (1, 2)), kind="sensor_msgs/msg/JoyFeedback"))
    assert gaps.number(feedback(2, b"?!")) == 1


def test_messages_that_cannot_be_told_apart_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"/talk holds the same message twice.*choose a topic with a stamp"):
        Identity(recording(text(1), text(2), text(1)))


def test_the_best_of_each_column_wins_whoever_it_is() -> None:
    best = winners(
        [
            cell("gr-ros2", pdr=0.943, latency_p99=0.0151, first_message=0.3),
            cell("zenoh-tcp", pdr=0.9996, latency_p99=0.2, first_message=0.1, age_mean=0.5),
            cell("cyclone-reliable", pdr=0.9999, latency_p99=0.0149, age_mean=None, first_message=None),
        ]
    )
    assert best["pdr"] == ["zenoh-tcp", "cyclone-reliable"]  # both show 1.000
    assert best["latency_p99"] == ["cyclone-reliable"]
    assert best["age_mean"] == ["gr-ros2"]
    assert best["first_message"] == ["zenoh-tcp"]
    assert set(best) == set(columns([cell("gr-ros2")])) != set(columns([cell("gr-ros2", robots=4)]))


def test_nobody_wins_a_column_without_numbers() -> None:
    assert winners([cell("gr-ros2", age_mean=None), cell("zenoh-udp", age_mean=None)])["age_mean"] == []


def test_cells_are_compared_under_the_same_condition_only() -> None:
    cells = [cell("gr-ros2"), cell("zenoh-udp"), cell("gr-ros2", loss=0.2)]
    assert {key: len(group) for key, group in by_condition(cells).items()} == {(2.0, 0.05): 2, (2.0, 0.2): 1}
