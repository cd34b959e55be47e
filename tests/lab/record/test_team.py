"""Robots on one channel as all of them saw it: overlaps, who heard what, beliefs, and the file of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import Accepted, Delivered, Received, SentPacket
from gr_ros2_lab.record.team import TEAM_FILE, TeamRecord, read_team
from tests.dashboard.feed import at

AIRTIME_S = 0.01


class Reader:
    def __call__(self, payload: bytes) -> tuple[float, float] | None:
        return float(payload[0]), 0.0


def record() -> TeamRecord:
    return TeamRecord((1, 2, 3), lambda *_: AIRTIME_S, {(1, 0): Reader()})


def sent(robot: int, number: int, begin: float, kind: str = "new") -> SentPacket:
    return SentPacket(b"x", None, robot, 1, number, 0, (), begin - 0.005, kind, 0, begin)  # type: ignore[arg-type]


def received(robot: int, number: int, snr_db: float = 20.0) -> Received:
    return Received(b"x", None, robot, 1, number, 0, None, snr_db)  # type: ignore[arg-type]


def test_packets_that_overlap_are_marked_at_both_and_others_by_who_heard_them() -> None:
    team = record()
    for robot, number, begin in ((1, 0, 1.0), (2, 0, 1.02), (3, 0, 1.025), (1, 1, 1.04)):
        team.sender_event(robot, sent(robot, number, begin))
    team.sender_event(1, sent(1, 2, 1.06, "relay"))
    for robot in (2, 3):
        team.receiver_event(robot, received(1, 0), 1.01)
    team.receiver_event(2, received(1, 1), 1.05)
    view = team.view()
    outcomes = [send.outcome(3) for send in view.sends]
    assert outcomes == ["heard by all", "overlapped", "overlapped", "not by all", "relayed"]
    assert view.pairs[2, 1].share == pytest.approx(2 / 3)
    assert view.pairs[2, 1].snr_db == 20.0
    assert view.pairs[1, 2].share == 0.0
    assert view.pairs[1, 2].snr_db is None


def test_a_belief_is_as_wrong_as_the_robot_has_driven_since() -> None:
    team = record()
    for now, x in ((1.0, 1), (2.0, 2), (4.0, 9)):
        team.sender_event(1, Accepted(0, 0, bytes([x]), now))
    team.receiver_event(2, Delivered(1, 0, bytes([2]), 0), 4.1)
    team.receiver_event(2, Delivered(1, 0, bytes([9]), 0), 4.2)
    view = team.view()
    assert view.places == {1: (9.0, 0.0)}
    assert view.beliefs == {(2, 1): (9.0, 0.0)}


def test_what_is_written_is_read_again_and_a_damaged_file_is_named(tmp_path: Path) -> None:
    assert read_team(tmp_path) is None
    team = record()
    team.sender_event(1, sent(1, 0, 1.0))
    team.sender_event(1, Accepted(0, 0, bytes([1]), 1.0))
    team.receiver_event(2, received(1, 0), 1.01)
    for x in (1, 4):
        team.receiver_event(2, Delivered(1, 0, bytes([x]), 0), 1.5)
    team.write(tmp_path)
    read = read_team(tmp_path)
    assert read is not None
    assert read.robots == (1, 2, 3)
    assert [(send.t, send.heard) for send in read.sends] == [(1.0, 1)]
    assert read.beliefs[2, 1][1] == [1.5, 4.0, 0.0, 0.0]
    assert read.snr_db[2, 1] == [[1.0, 20.0]]
    (tmp_path / TEAM_FILE).write_text('{"robots": [1]}')
    with pytest.raises(ConfigError, match=r"team\.json: is damaged") as refused:
        read_team(tmp_path)
    assert "\n" not in str(refused.value)


def test_positions_are_those_of_real_messages() -> None:
    from gr_ros2.observe.positions import position_reader

    reader = position_reader("geometry_msgs/msg/PointStamped")
    assert reader is not None
    team = TeamRecord((1, 2), lambda *_: AIRTIME_S, {(1, 0): reader})
    team.sender_event(1, Accepted(0, 0, at(1.5, 2.5), 1.0))
    team.sender_event(1, Accepted(1, 0, b"no message", 1.1))
    assert team.view().places == {1: (1.5, 2.5)}
