"""A medium process and the links around it, each a process: they hear each other, collide, and outlive its end."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.radio.zmq import HEADER, MAGIC, MediumClock
from gr_ros2_lab.medium.process import MediumProcess, load_medium
from tests.middleware.support import message
from tests.programs import ProgramProcess
from tests.radio.robot_process import RobotProcess
from tests.radio.robots import RATE, ROOT, Robot
from tests.waiting import wait_for

Start = Callable[[], "subprocess.Popen[str]"]


def settings(folder: Path, robots: int = 2, **changes: Any) -> dict[str, Any]:
    """Of a medium process."""
    addresses = [
        {"connect": f"ipc://{folder}/robot{number}", "bind": f"ipc://{folder}/medium{number}"}
        for number in range(1, robots + 1)
    ]
    return {
        "phy": {"name": "psk", "sample_rate": RATE},
        "packet_len": 64,
        "channel": {"snr_db": 25.0},
        "robots": addresses,
        **changes,
    }


def front_end(folder: Path, number: int, medium: str = "lockstep") -> dict[str, Any]:
    """Of a link around it."""
    return {
        "name": "zmq",
        "bind": f"ipc://{folder}/robot{number}",
        "connect": [f"ipc://{folder}/medium{number}"],
        "medium_process": medium,
    }


@pytest.fixture
def medium(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Start]:
    """Starts a process with these settings; at the end it is gone."""
    path = tmp_path / "medium.yaml"
    path.write_text(yaml.safe_dump(settings(tmp_path, **getattr(request, "param", {}))))
    begun: list[subprocess.Popen[str]] = []

    def start() -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "gr_ros2.cli", "medium", str(path)]
        begun.append(ProgramProcess(command, cwd=ROOT, stdout=subprocess.PIPE, text=True))
        assert begun[-1].stdout is not None
        assert "2 robots" in begun[-1].stdout.readline()
        return begun[-1]

    yield start
    for process in begun:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


@pytest.mark.parametrize(
    ("medium", "mode"),
    [({}, "lockstep"), pytest.param({"time": "real"}, "real", marks=pytest.mark.real_time)],
    indirect=["medium"],
    ids=["lockstep", "real"],
)
def test_links_of_two_processes_hear_each_other_also_after_the_medium_was_killed(
    medium: Start, mode: str, tmp_path: Path
) -> None:
    """In real time they take turns: each repairs in all idle air while nobody answers, so two that do not wait for each
    other drown each other once the medium was away for long."""
    process, turns = medium(), {"medium": "slots"} if mode == "real" else {}
    robots = [RobotProcess(number, front_end(tmp_path, number, mode), 0, **turns) for number in (1, 2)]
    try:
        wait_for(lambda: all(len(robot.heard) > 5 for robot in robots), "both to hear")
        process.kill()
        process.wait()
        second = medium()
        before = [len(robot.heard) for robot in robots]
        wait_for(lambda: all(len(robot.heard) > n + 5 for robot, n in zip(robots, before, strict=True)), "both again")
        second.send_signal(signal.SIGINT)
        assert second.wait() == 0
        assert second.stdout is not None
        counted = dict(re.findall(r"(\w+) (\d+)", second.stdout.read().splitlines()[-1]))
        assert int(counted["bursts"]) > 20
        assert {"malformed", "wrong_rate"}.isdisjoint(counted)
        assert all(robot.alive for robot in robots)
    finally:
        for robot in robots:
            robot.kill()


def test_who_sends_alone_is_heard_and_who_send_together_collide(medium: Start, tmp_path: Path) -> None:
    """Without repair, as who repairs in all idle air hears nobody meanwhile, where they do not take turns."""
    process = medium()
    with (
        Robot(1, front_end(tmp_path, 1), hears=(2,), repair="off") as one,
        Robot(2, front_end(tmp_path, 2), hears=(1,), repair="off") as two,
    ):
        two.link.transmit(on=False)  # what it reports of the packets that it hears would collide with others
        said = set(one.say(*range(10)))
        wait_for(
            lambda: said <= set(two.heard) or (one.silent and not one.say(*range(10))), "all of one that sends alone"
        )
        two.link.transmit(on=True)

        def collide() -> bool:
            """Both say 20 messages; whether many packets do not come, though nothing but the other's is in their way. A
            busy computer may let one speak first."""
            before, taken = packets(), one.taken() + two.taken()
            for number in range(20):
                one._chat.publish(message(number, 400))
                two._chat.publish(message(number, 400))
            wait_for(lambda: one.taken() + two.taken() == taken + 40, "the links to take all")

            def lost() -> int:
                sent, came = (now - then for now, then in zip(packets(), before, strict=True))
                return sent - came

            links = one.link.source, two.link.source
            wait_for(lambda: lost() > 40 or all(link.idle for link in links), "packets to be lost, or all to be sent")
            return lost() > 40

        def packets() -> tuple[int, int]:
            """Sent and received by both."""
            counts = [robot.link.stats()["packets"] for robot in (one, two)]
            return sum(each["out"] for each in counts), sum(each["in"] for each in counts)

        wait_for(collide, "packets to collide")
    process.send_signal(signal.SIGINT)
    assert process.wait() == 0
    assert process.stdout is not None
    (overlapping,) = re.findall(r"overlapping (\d+)", process.stdout.read())
    assert int(overlapping) > 10


def test_in_lock_step_a_robot_that_stands_still_stops_the_time(medium: Start, tmp_path: Path) -> None:
    medium()
    with Robot(1, front_end(tmp_path, 1), hears=(2,)) as one:
        other = RobotProcess(2, front_end(tmp_path, 2), 0)
        try:
            wait_for(lambda: len(one.heard) > 2, "robot 1 to hear")
            pid = other._process.pid
            assert pid is not None
            clock = one.link.front_end.clock
            before, passed = clock(), 0.0
            os.kill(pid, signal.SIGSTOP)
            try:
                wait_for(lambda: clock() > before, "a step")
                passed = clock()
                wait_for(lambda: clock() > passed + 0.05, "the medium to go on without it")
            finally:
                os.kill(pid, signal.SIGCONT)
            heard = len(one.heard)
            wait_for(lambda: len(one.heard) > heard + 2, "robot 1 to hear it again")
        finally:
            other.kill()


@pytest.fixture
def process(tmp_path: Path) -> Iterator[MediumProcess]:
    """A medium process that runs in a thread of this one, with a clock that can jump."""
    path, over = tmp_path / "medium.yaml", threading.Event()
    path.write_text(yaml.safe_dump(settings(tmp_path)))
    made = MediumProcess(load_medium(path))
    running = threading.Thread(target=made.run, kwargs={"over": over})
    running.start()
    yield made
    over.set()
    running.join()
    made.close()


def test_a_medium_that_stands_still_sets_no_clock(process: MediumProcess, tmp_path: Path) -> None:
    with (
        Robot(1, front_end(tmp_path, 1), hears=(2,)) as one,
        Robot(2, front_end(tmp_path, 2), hears=(1,)) as two,
    ):
        wait_for(lambda: two.say(1) and bool(one.heard), "robot 1 to hear")

        def answers(count: int) -> bool:
            one.link.check()
            two.link.check()
            return bool(one.link.ping(2)["answered"] >= count)

        wait_for(lambda: answers(1), "an answer")
        goes_on, looks, before = threading.Event(), [0], process._take

        def stands_still(_: float) -> None:
            while not goes_on.wait(0.01):
                looks[0] += 1

        vars(process).update(_take=stands_still)
        wait_for(lambda: looks[0] > 50, "half a second in which nothing goes on")
        vars(process).update(_take=before)
        goes_on.set()
        wait_for(lambda: answers(3), "further answers")
        for robot, other in ((one, 2), (two, 1)):
            assert robot.link.stats()["clocks"]["set"] == []
            assert robot.link.ping(other)["clock_s"] is None, "nothing tells how long the medium stood still"


def test_nobody_waits_for_a_robot_that_sends_and_never_answers_the_time(
    process: MediumProcess, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with (
        Robot(1, front_end(tmp_path, 1), hears=(2,)) as one,
        Robot(2, {**front_end(tmp_path, 2), "medium_process": "none"}, hears=(1,)) as two,
    ):
        clock = one.link.front_end.clock
        wait_for(lambda: two.say(1) and process.counted["bursts"] > 2, "bursts of robot 2")
        before = clock()
        wait_for(lambda: two.say(1) and clock() > before + 2.0, "the time to go on, whatever robot 2 sends")
        wait_for(lambda: two.say(1) and "robot 2: it sends and does not answer" in caplog.text, "robot 2 to be named")
    assert process.counted["unanswered"]
    named = [record.message for record in caplog.records if "does not answer the time" in record.message]
    assert any(message.startswith("medium: robot 2: ") for message in named), "robot 1 too, on a slow computer"


def test_a_medium_that_was_frozen_itself_goes_on_waiting_for_its_robots(process: MediumProcess, tmp_path: Path) -> None:
    """Its clock does not go back at the end, as it would if it was patched for the test alone."""
    left, slept = [5], [0.0]
    clock, take = process._clock, process._take

    def freeze(timeout_s: float) -> None:
        left[0], slept[0] = max(0, left[0] - 1), slept[0] + 12.0 * bool(left[0])
        take(timeout_s)

    with Robot(1, front_end(tmp_path, 1), hears=(2,)), Robot(2, front_end(tmp_path, 2), hears=(1,)):
        wait_for(lambda: process.robots == 2, "both robots")
        vars(process).update(_clock=lambda: clock() + slept[0], _take=freeze)
        wait_for(lambda: not left[0], "the jumps")
        after = process.now
        wait_for(lambda: process.now > after + 0.2, "the time to go on")
        assert process.counted["waited"] == 0


def test_the_clock_of_a_link_follows_the_medium_and_never_goes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MediumClock, "_OFFSETS", {})
    times = [50.0]
    clock = MediumClock(lambda: times[0])
    clock.tick(1, 100.0)
    assert clock() == 50.0
    clock.tick(1, 100.25)
    assert clock() == pytest.approx(50.25)
    assert clock.there(clock.here(100.1)) == pytest.approx(100.1)
    times[0] = 50.5  # another link of this process comes later, and has the same clock
    other = MediumClock(lambda: times[0])
    clock.tick(1, 101.0)
    other.tick(1, 101.0)
    assert clock() == other() == pytest.approx(51.0)
    clock.tick(2, 0.0)  # another process, whose time begins anew
    assert clock() == pytest.approx(51.0)
    clock.tick(2, 1.0)
    assert clock() == pytest.approx(51.5)
    clock.tick(2, 1e12)
    assert clock() <= 52.5


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"robots": []}, "robots"),
        ({"gains_db": [[None, -60.0]]}, "gains_db: 2 robots need 2 rows of 2 numbers"),
        ({"phy": {"name": "psk"}}, "phy.sample_rate = auto: a medium needs one"),
        ({"phy": {"name": "pks", "sample_rate": 1e6}}, "phy.name = 'pks': no such phy"),
        ({"channel": {"from": "positions"}}, "position is for all robots together with channel.from"),
        ({"channel": {"packet_loss": 0.1}}, "a medium of samples loses no whole packets"),
        ({"medium": "slots"}, "medium"),
        ({"robots": [{"connect": "ipc://a", "bind": "ipc://a"}] * 2}, "address ipc://a stands there twice"),
    ],
)
def test_bad_settings_are_said_in_a_line(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    path = tmp_path / "medium.yaml"
    path.write_text(yaml.safe_dump(settings(tmp_path) | changes))
    with pytest.raises(ConfigError, match=re.escape(said)) as error:
        load_medium(path)
    assert "\n" not in str(error.value)


def test_an_address_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    path = tmp_path / "medium.yaml"
    robots = [{"connect": f"ipc://{tmp_path}/{n}", "bind": f"ipc:///nowhere/{n}"} for n in (1, 2)]
    path.write_text(yaml.safe_dump(settings(tmp_path) | {"robots": robots}))
    with pytest.raises(RadioError, match="medium: bind = 'ipc:///nowhere/1'"):
        MediumProcess(load_medium(path))


def test_what_is_no_burst_is_refused_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "medium.yaml"
    path.write_text(yaml.safe_dump(settings(tmp_path)))
    process = MediumProcess(load_medium(path))
    try:
        samples = np.ones(10, "<c8").tobytes()
        for message in (
            b"",
            b"x" * 40,
            HEADER.pack(MAGIC, 1, 0, RATE, 0.0) + b"odd",
            HEADER.pack(MAGIC, 1, 0, RATE, 0.0) + np.full(3, np.nan, "<c8").tobytes(),
            HEADER.pack(MAGIC, 1, 0, RATE, 0.0) + np.full(3, 1e38, "<c8").tobytes(),
            HEADER.pack(MAGIC, 1, 0, 2 * RATE, 0.0) + samples,
            HEADER.pack(MAGIC, 1, 0, RATE, nan) + samples,
            HEADER.pack(MAGIC, 1, 0, RATE, 1e300) + samples,
            HEADER.pack(MAGIC, 1, 0, RATE, -1e300) + samples,
            HEADER.pack(MAGIC, 1, 0, RATE, nan),
        ):
            process._arrived(0, message)
        assert process.counted == {"malformed": 5, "wrong_rate": 1, "bursts": 3, "overlapping": 0}
        assert process.robots == 1
    finally:
        process.close()


def test_a_burst_that_says_no_time_begins_at_the_time_its_robot_was_told(tmp_path: Path) -> None:
    """It had been composed at that time, and was received 2 ms before its airtime was over."""
    path = tmp_path / "medium.yaml"
    path.write_text(yaml.safe_dump(settings(tmp_path)))

    def heard_at(at: Callable[[MediumProcess], float]) -> float:
        process = MediumProcess(load_medium(path))
        try:
            process._step()
            process._hand_over()
            process._step()
            samples = np.ones(int(0.003 * RATE), "<c8").tobytes()
            process._arrived(0, HEADER.pack(MAGIC, 1, 0, RATE, at(process)) + samples)
            while True:
                process._step()
                for start, _ in process.medium.received(1, process.now):
                    return start
        finally:
            process.close()

    assert heard_at(lambda _: nan) == heard_at(lambda process: process.now) > heard_at(lambda _: 0.0)


def test_positions_and_gains_decide_who_hears_whom(tmp_path: Path) -> None:
    path = tmp_path / "medium.yaml"
    gains = {"gains_db": [[None, -90.0, None], [-90.0, None, -90.0], [None, -90.0, None]], "channel": {}}
    places = [{**robot, "position": [100.0 * n, 0.0]} for n, robot in enumerate(settings(tmp_path, 3)["robots"])]
    at = {"robots": places, "channel": {"from": "positions", "exponent": 4.0}}
    for changes, reached in ((gains, [[1], [0, 2], [1]]), (at, [[1, 2], [0, 2], [0, 1]])):
        path.write_text(yaml.safe_dump(settings(tmp_path, 3) | changes))
        around = load_medium(path).around()
        assert [around.reached(number) for number in range(3)] == reached
    heard = around.hearers(0, 0.0)
    assert heard.snr_db[0] - heard.snr_db[1] == pytest.approx(40 * np.log10(2), abs=1e-6)
