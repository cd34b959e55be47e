"""Either end of a live link is killed and started again, over ZeroMQ between processes.

Both robots publish numbered messages all the time; a start continues the numbers far above those of the one before.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from tests.radio.robot_process import Heard, RobotProcess
from tests.waiting import wait_for

SLOW = 2e5
AIRTIME_S = 0.0041
"""Of a packet, at least."""
ALLOWED = int(2.0 / AIRTIME_S)
"""Packets of 2 s of air."""
APART = 100_000
"""Between the numbers of two starts."""


class Pair:
    """Two robots, and what each heard through all its starts."""

    def __init__(self, folder: Path, **values: Any) -> None:
        addresses = [f"ipc://{folder}/{number}" for number in (1, 2)]
        self._ends = {
            number: {"name": "zmq", "bind": addresses[number - 1], "connect": [addresses[2 - number]]}
            for number in (1, 2)
        }
        self._folder, self._values = folder, values
        self._starts = {1: 0, 2: 0}
        self.robots: dict[int, RobotProcess] = {}
        self.earlier: dict[int, list[Heard]] = {1: [], 2: []}

    def start(self, number: int) -> None:
        values = {
            "phy": {"name": "psk", "sample_rate": SLOW},
            "state": str(self._folder / f"state-{number}"),
            **({} if number == 1 else {"registry": ""}),
            **self._values,
        }
        self._starts[number] += 1
        self.robots[number] = RobotProcess(number, self._ends[number], APART * self._starts[number], **values)

    def kill(self, number: int) -> None:
        self.earlier[number] += self.robots.pop(number).kill()

    def recovers(self) -> int:
        """Wait until each hears the present start of the other; the largest number of packets that this took."""
        took = []
        for number, robot in self.robots.items():
            newest = APART * self._starts[3 - number]
            wait_for(partial(self._hears, number, newest), f"robot {number} to hear")
            at = next(place for place, heard in enumerate(robot.heard) if heard.number >= newest)
            took.append(robot.heard[at].packets - (robot.heard[at - 1].packets if at else 0))
        return max(took)

    def _hears(self, number: int, newest: int) -> bool:
        """Whether a robot has heard a start of the other; both have to be alive."""
        assert [robot for robot, process in self.robots.items() if not process.alive] == []
        return any(heard.number >= newest for heard in self.robots[number].heard)

    def check(self) -> None:
        """Nothing twice, nothing out of order, through all starts."""
        for number in (1, 2):
            numbers = [heard.number for heard in self.earlier[number]]
            assert numbers == sorted(set(numbers)), f"robot {number}"
            assert len({number // APART for number in numbers}) == self._starts[3 - number], "every start was heard"
            assert max(heard.restarts for heard in self.earlier[number]) >= 1

    def close(self) -> None:
        for number in list(self.robots):
            self.kill(number)


@pytest.mark.slow
@pytest.mark.parametrize("first", [1, 2])
def test_ends_start_in_either_order_and_are_killed_8_times(first: int, tmp_path: Path) -> None:
    pair = Pair(tmp_path)
    try:
        pair.start(first)
        pair.start(3 - first)
        pair.recovers()
        for restart in range(8):
            killed = 1 + (restart // 2) % 2 if first == 1 else 1 + restart % 2
            pair.kill(killed)
            pair.start(killed)
            assert pair.recovers() <= ALLOWED, f"restart {restart}"
    finally:
        pair.close()
    pair.check()
