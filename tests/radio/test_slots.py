"""Links that share one channel through a medium process: slots against sending at once, and who may not have slots."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.ros_link import make_link
from gr_ros2.link.access import Access
from gr_ros2.mac import Aloha, Slots
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.config import build
from gr_ros2_lab.medium.process import MediumConfig, MediumProcess
from tests.domains import free_ports
from tests.middleware.support import message
from tests.radio.robots import Robot, config
from tests.waiting import wait_for

PHY = {"name": "psk", "sample_rate": 2e5}
PACKET_LEN = 96
SAID = 40


def front_end(folder: Path, number: int) -> dict[str, Any]:
    addresses = {"bind": f"ipc://{folder}/robot{number}", "connect": [f"ipc://{folder}/medium{number}"]}
    return {"name": "zmq", "medium_process": "lockstep", **addresses}


class Still:
    """A clock that stands still within its block: what a test does there, it does at one time, however slow it is."""

    def __init__(self) -> None:
        self._lock, self._stood_s = threading.Lock(), 0.0

    def now(self) -> float:
        """s; waits for the end of a block."""
        with self._lock:
            return time.monotonic() - self._stood_s

    def __enter__(self) -> None:
        self._lock.acquire()
        self._began = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._stood_s += time.monotonic() - self._began
        self._lock.release()


@contextmanager
def air(
    folder: Path, robots: int, clock: Callable[[], float] = time.monotonic, **settings: Any
) -> Iterator[MediumProcess]:
    """A medium in lock step, in a thread."""
    addresses = [
        {"connect": f"ipc://{folder}/robot{n}", "bind": f"ipc://{folder}/medium{n}"} for n in range(1, robots + 1)
    ]
    values = {"phy": PHY, "packet_len": PACKET_LEN, "robots": addresses, "channel": {"snr_db": 20.0}, **settings}
    process = MediumProcess(build(MediumConfig, values), clock)
    over = threading.Event()
    thread = threading.Thread(target=process.run, kwargs={"over": over}, daemon=True)
    thread.start()
    try:
        yield process
    finally:
        over.set()
        thread.join()
        process.close()


def heard(folder: Path, medium: str, robots: int = 2) -> tuple[list[int], MediumProcess]:
    """How many of ``SAID`` messages of each robot came out at each other one; all say theirs at the same time, and
    nothing is repaired."""
    still = Still()
    with air(folder, robots, still.now) as process, ExitStack() as stack:
        numbers = range(1, robots + 1)
        graphs = [
            stack.enter_context(
                Robot(
                    number,
                    front_end(folder, number),
                    hears=tuple(n for n in numbers if n != number),
                    medium=medium,
                    phy=PHY,
                    packet_len=PACKET_LEN,
                    repair="off",
                )
            )
            for number in numbers
        ]
        clock = graphs[0].link.front_end.clock
        begin = clock()
        for number in range(SAID):  # 10 Hz on the clock of the medium
            wait_for(lambda: clock() >= begin + number / 10, "the next message")  # noqa: B023 - called at once
            with still:
                for robot in graphs:
                    robot.publish(message(number, 40))
        over = clock() + 3.0
        whole = (robots - 1) * SAID
        wait_for(lambda: clock() > over or all(len(robot.heard) == whole for robot in graphs), "what is on its way")
        return [len(robot.heard) for robot in graphs], process


@pytest.mark.slow
def test_in_slots_two_links_lose_nothing_both_ways_and_at_once_most(tmp_path: Path) -> None:
    whole, process = heard(tmp_path, "slots")
    assert whole == [SAID, SAID]
    assert process.counted["overlapping"] <= 0.05 * process.counted["bursts"]  # of about 100: those of the entry
    (tmp_path / "again").mkdir()
    at_once, process = heard(tmp_path / "again", "exclusive")
    assert sum(at_once) < 0.25 * sum(whole)
    assert process.counted["overlapping"] > 0.3 * process.counted["bursts"]


def test_a_message_reaches_a_robot_that_does_not_hear_its_sender(tmp_path: Path) -> None:
    line = [[None, -80.0, None], [-80.0, None, -80.0], [None, -80.0, None]]
    with air(tmp_path, 3, gains_db=line, channel={}), ExitStack() as stack:
        first, _, last = (
            stack.enter_context(
                Robot(
                    number,
                    front_end(tmp_path, number),
                    hears=(4 - number,) if number != 2 else (),
                    medium="slots",
                    relay="gain",
                    phy=PHY,
                    packet_len=PACKET_LEN,
                )
            )
            for number in (1, 2, 3)
        )
        clock = first.link.front_end.clock
        at = [clock()]

        def tell() -> bool:
            if clock() >= at[0]:
                at[0] += 0.3
                first.publish(message(7, 40))
            return bool(last.heard)

        wait_for(tell, "a message of robot 1 at robot 3")


@pytest.fixture
def accesses(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Access, float]]:
    """Medium access of the links that are made, and s between two packets."""
    made: list[tuple[Access, float]] = []
    for cls in (Slots, Aloha):
        before: Callable[..., None] = cls.__init__

        def init(self: Any, src_id: int, slot_s: float, *rest: Any, before: Any = before, **more: Any) -> None:
            before(self, src_id, slot_s, *rest, **more)
            made.append((self, slot_s))

        monkeypatch.setattr(cls, "__init__", init)
    return made


def test_the_guard_is_what_the_front_end_may_be_late_by(accesses: list[tuple[Access, float]]) -> None:
    (port,) = free_ports(1)
    options = {"name": "udp", "listen": f"127.0.0.1:{port}", "send_to": ["127.0.0.1:9"]}
    link = RobotLink(config(1, options, medium="slots", phy={"name": "modem", "options": {"bit_rate": 9600}}))
    try:
        ((access, slot_s),) = accesses
        assert isinstance(access, Slots)
        assert slot_s == pytest.approx(link.front_end.airtime() + link.front_end.timing_error_s)
    finally:
        link.stop()


def test_the_block_of_grc_has_slots_too(accesses: list[tuple[Access, float]]) -> None:
    values = {"robot": "/robot_1", "graph_middleware": "memory"}
    link = make_link(medium="slots", airtime_s=0.02, slot_guard_s=0.003, **values)
    link.close()
    ((_, slot_s),) = accesses
    assert slot_s == pytest.approx(0.023)
    with pytest.raises(ConfigError, match="medium = 'slots': needs airtime_s above 0"):
        make_link(medium="slots", **values)


def test_a_front_end_that_hears_itself_alone_shares_nothing() -> None:
    with pytest.raises(ConfigError, match="medium = 'slots': front_end sim reaches no other robot") as refused:
        RobotLink(config(1, {"name": "sim"}, medium="slots"))
    assert "\n" not in str(refused.value)


def test_two_robots_with_one_id_are_told_so_both(tmp_path: Path) -> None:
    with air(tmp_path, 3), ExitStack() as stack:
        links = []
        for place, number in ((1, 1), (2, 2), (3, 1)):
            values = {"medium": "slots", "phy": PHY, "packet_len": PACKET_LEN}
            state = str(tmp_path / f"state{place}.json")
            links.append(RobotLink(config(number, front_end(tmp_path, place), state=state, **values)))
            stack.callback(links[-1].stop)
        for link in links:
            link.start()
        for link in links[::2]:
            said = "another robot sends as robot 1, which is this one"
            wait_for(lambda: any(said in line for line in link.findings.lines()), "to be told")  # noqa: B023 - called at once
        assert not any("another robot" in line for line in links[1].findings.lines())


def test_a_channel_that_is_too_full_names_the_topics_that_grow_old(tmp_path: Path) -> None:
    with air(tmp_path, 2), ExitStack() as stack:
        values: dict[str, Any] = {"medium": "slots", "phy": PHY, "packet_len": PACKET_LEN}
        options = {"topics": {"chat": {"queue": "latest"}}}
        robots = [
            stack.enter_context(Robot(number, front_end(tmp_path, number), **options, **values)) for number in (1, 2)
        ]
        wait_for(lambda: bool(robots[0].link.stats()["peers"]), "the other robot to be heard")
        robots[0].link.findings.lines()
        told = "the channel is fuller than it can carry: /robot_1/chat grow old"
        wait_for(
            lambda: robots[0].publish(message(1, 40)) or any(told in line for line in robots[0].link.findings.lines()),
            "the topic to be named",
        )
        assert not any("fuller" in line for line in robots[1].link.findings.lines())
