"""Two links whose computers' clocks differ: ages, stamps, what is said, and what chrony gets."""

from __future__ import annotations

import json
import re
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.observe.positions import humble_types
from gr_ros2.radio.clocks import MAGIC, SAMPLE
from tests.e2e.links import LinkProcess, Links
from tests.programs import ANEW
from tests.waiting import wait_for

POINT = "geometry_msgs/msg/PointStamped"
PEER = (*ANEW, "tests.e2e.clock_peer")
"""Its clock is wrong before anything is loaded that reads it."""
ADJUSTED_S = 1e-3
"""s by which the clock of the machine that runs the tests may be adjusted meanwhile, or read at another moment."""


def got(link: LinkProcess) -> list[tuple[float, float]]:
    """Of each message that came out: the true time when it was stamped, and its stamp."""
    lines = [line.split() for line in list(link.said)]
    return [(float(line[1]), float(line[2])) for line in lines if line[0] == "got"]


def clock(link: LinkProcess) -> Any:
    """What the link knows of the clock of the only other robot."""
    return next(iter(link.heard().values()))["clock"]


def close_to(found: Any, ahead_s: float) -> bool:
    return found is not None and abs(found["ahead_s"] - ahead_s) <= found["error_s"] + ADJUSTED_S


@pytest.mark.slow
def test_a_computer_whose_clock_is_wrong_is_taken_into_account(tmp_path: Path) -> None:
    ahead_s, address = 3600.5, tmp_path / "chrony.sock"
    settings = {"topics": {"place": {}}}
    mine = {"clock": {"every_s": 0.5, "chrony": str(address), "robot": 2}, "publish": {"stamps": "mine"}}
    with (
        Links(tmp_path, {**settings, **mine}, settings) as links,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as chrony,
    ):
        chrony.bind(str(address))
        one = links.start(1, "1", "0", command=PEER)
        two = links.start(2, "2", str(ahead_s), command=PEER)
        links.meet()

        seconds, us, offset_s, pulse, leap, _, magic = SAMPLE.unpack(chrony.recv(SAMPLE.size + 1))
        assert (pulse, leap, magic) == (0, 0, MAGIC)
        assert seconds + us * 1e-6 <= time.time()

        wait_for(lambda: clock(one), "its clock to be known")
        found = clock(one)
        assert close_to(found, ahead_s)
        assert close_to({**found, "ahead_s": offset_s, "error_s": 0.5}, ahead_s)
        assert "3,600," in one.ask("peers")[1]

        wait_for(lambda: topic(one)["recent_latency_s"] and topic(one)["recent_latency_s"]["p50"] < 100, "latency")
        before = len(got(one))
        wait_for(lambda: len(got(one)) > before + 5, "messages with stamps that were moved")
        for true, stamp in got(one)[before:]:
            assert abs(stamp - true) <= found["error_s"] + ADJUSTED_S
        latency = topic(one)["recent_latency_s"]
        assert -found["error_s"] - ADJUSTED_S <= latency["p50"] <= latency["max"] < ahead_s / 100
        assert topic(one)["age_s"] < ahead_s / 100

        two.tell(str(ahead_s - 60))
        wait_for(lambda: one.status()["clocks"]["set"], "the jump to be said")
        jump = re.match(r"the clock of robot 2 was set ([\d.]+) s back", one.status()["clocks"]["set"][0])
        assert jump is not None
        assert float(jump[1]) == pytest.approx(60, abs=0.5)
        assert close_to(clock(one), ahead_s - 60)
        one.tell("30")
        wait_for(lambda: len(one.status()["clocks"]["set"]) == 2, "the jump of its own clock")
        assert any(line.startswith("this computer's clock was set 30 s forward") for line in one.status()["findings"])
        assert close_to(clock(one), ahead_s - 90)

        assert got(two), "robot 2 publishes stamps as they are"
        assert all(abs(stamp - true) <= ADJUSTED_S for true, stamp in got(two) if stamp < true + 10)
        assert one.end() == 0
        assert "clock of robot 2 3,510," in one.said[-1]


def topic(link: LinkProcess) -> Any:
    return link.status()["sink"]["topics"].get("/rx_robot_2/place", {"recent_latency_s": None})


def test_ping_tells_a_clock_that_nobody_watches(tmp_path: Path) -> None:
    settings = {"topics": {"place": {}}}
    with Links(tmp_path, settings, settings) as links:
        one, _ = links.start(1, "1", "0", command=PEER), links.start(2, "2", "-7", command=PEER)
        links.meet()
        assert clock(one) is None

        answers: list[Any] = []

        def answered() -> bool:
            """A busy computer may be late for all questions."""
            status, said = one.ask("ping", "2", "--count", "5", "--interval", "0.2", "--json")
            answers.append(json.loads(said))
            return status == 0 and answers[-1]["clock_s"] is not None

        wait_for(answered, "answers")
        answer = answers[-1]
        assert answer["clock_s"] == pytest.approx(-7, abs=answer["clock_error_s"] + ADJUSTED_S)
        assert close_to(clock(one), -7)


@pytest.mark.real_time
def test_a_bag_of_what_came_out_has_the_times_of_this_computers_clock(tmp_path: Path) -> None:
    settings = {"topics": {"place": {}}}
    bag = tmp_path / "recorded"
    with Links(tmp_path, {**settings, "clock": {"every_s": 0.5}}, settings) as links:
        one = links.start(1, "1", "0", "--bag", str(bag), command=PEER)
        links.start(2, "2", "-500", command=PEER)
        links.meet()
        wait_for(lambda: clock(one), "its clock to be known")
        before, found = len(got(one)), clock(one)
        wait_for(lambda: len(got(one)) > before + 10, "messages")
        assert one.end() == 0
    recorded = list(read_bag(bag))
    assert [each.stamp_ns for each in recorded] == sorted(each.stamp_ns for each in recorded)
    assert len(recorded) >= before + 10
    store = humble_types()
    for each in recorded[before + 1 :]:
        true = store.deserialize_cdr(each.payload, POINT).point.x
        assert abs(each.stamp_ns / 1e9 - true) <= found["error_s"] + ADJUSTED_S
