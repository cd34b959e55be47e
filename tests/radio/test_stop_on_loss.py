"""The recipe that stops a robot when its link is lost, with two links and a robot that drives."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.middleware import Qos, join_graph
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2_lab.sim.motion import State
from tests.docs.pages import blocks
from tests.domains import domain
from tests.radio.robots import config
from tests.waiting import PATIENCE_S, wait_for

TWIST = "geometry_msgs/msg/Twist"
SPEED = 1.0


class Wheels:
    """A robot that obeys the last command, whatever its age."""

    def __init__(self) -> None:
        self.state, self._at, self._lock = State(0.0, 0.0, 0.0, 0.0, 0.0), time.monotonic(), threading.Lock()

    def obey(self, payload: bytes) -> None:
        (speed,) = struct.unpack_from("<d", payload, 4)
        with self._lock:
            self.state = self._now()._replace(speed=speed)

    def _now(self) -> State:
        now = time.monotonic()
        moved, self._at = self.state.after(now - self._at), now
        return moved

    @property
    def x(self) -> float:
        with self._lock:
            self.state = self._now()
            return self.state.x


def program() -> str:
    (block,) = (block for block in blocks("python") if block.page == "docs/how-to/stop-on-loss.md")
    return block.text


def test_the_program_of_the_page_starts_and_stops_a_robot_that_nobody_commands(tmp_path: Path) -> None:
    pytest.importorskip("cyclonedds", reason="needs Cyclone DDS")
    (tmp_path / "stop_on_loss.py").write_text(program())
    number, stopped = domain(1), threading.Event()
    stop = b"\0\1\0\0" + bytes(48)
    with join_graph("dds", domain_id=number, node_name="robot", localhost_only=True) as graph:
        graph.subscribe("/robot_1/cmd_vel", TWIST, Qos(), lambda payload: stopped.set() if payload == stop else None)
        watching = subprocess.Popen(
            [sys.executable, "stop_on_loss.py", "/robot_1"],
            cwd=tmp_path,
            env={
                **os.environ,
                "PYTHONPATH": str(Path(__file__).resolve().parents[2]),
                "ROS_DOMAIN_ID": str(number),
                "ROS_LOCALHOST_ONLY": "1",
            },
        )
        try:
            wait_for(lambda: stopped.is_set() or watching.poll() is not None, "the program to stop the robot")
            assert stopped.is_set()
        finally:
            watching.kill()
            watching.wait(PATIENCE_S)


@pytest.mark.parametrize("how", ["the operator's link is switched off", "the operator says nothing"])
def test_the_robot_stands_still_when_its_operator_is_gone(tmp_path: Path, how: str) -> None:
    recipe: dict[str, Any] = {"__name__": "recipe"}
    exec(program(), recipe)
    addresses = [f"ipc://{tmp_path}/{number}" for number in (1, 2)]

    def link(number: int, own: str, other: str) -> RobotLink:
        values: dict[str, Any] = {"registry": "", "state": str(tmp_path / f"state-{number}")}
        front_end = {"name": "zmq", "bind": own, "connect": [other]}
        quick = {"period_s": 0.1, "silence_s": [1.0, 2.5]}
        topics = ["cmd_vel"] if number == 2 else []
        return RobotLink(config(number, front_end, **values, topics=topics, diagnostics=quick))

    wheels, over = Wheels(), threading.Event()
    drive = b"\0\1\0\0" + struct.pack("<6d", SPEED, 0, 0, 0, 0, 0)
    with (
        link(1, *addresses),
        link(2, *reversed(addresses)) as operator,
        MemoryMiddleware(domain_id=domain(1)) as robot,
        MemoryMiddleware(domain_id=domain(2)) as desk,
    ):
        robot.subscribe("/robot_1/cmd_vel", TWIST, Qos(), wheels.obey)
        arguments = (robot, 2, "/robot_1", 0.5, over.is_set)
        guard = threading.Thread(target=recipe["watch"], args=arguments, daemon=True)
        guard.start()
        stick = desk.advertise("/robot_2/cmd_vel", TWIST, Qos())
        silent, turns = threading.Event(), 0

        def steer() -> None:
            nonlocal turns
            while not over.wait(0.1):
                if not silent.is_set():
                    stick.publish(drive)
                turns += 1

        pilot = threading.Thread(target=steer, daemon=True)
        pilot.start()
        try:
            wait_for(lambda: wheels.x > SPEED, "the robot to drive")
            if "switched off" in how:
                operator.transmit(on=False)
            else:
                silent.set()
            wait_for(lambda: wheels.state.speed == 0, "the robot to stop")
            stood, until = wheels.x, turns + 10
            wait_for(lambda: turns >= until, "ten turns at the stick")
            assert wheels.x == stood, "no late command moves it"
            operator.transmit(on=True)
            silent.clear()
            wait_for(lambda: wheels.state.speed == SPEED, "the robot to drive again")
        finally:
            over.set()
            guard.join(PATIENCE_S)
            pilot.join(PATIENCE_S)
