"""One channel for all robots, in real time: each has a link of its own, and a medium process at samples carries what
they send (:class:`gr_ros2_lab.medium.process.MediumProcess`). Nothing is lost because the computer is slow.

Invariants: all links follow the clock of the medium, which never goes faster than real time; where robots are counts
from the begin of the run; what a robot keeps of its starts is forgotten with the run.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gr_ros2.core.errors import GrRos2Error, RunError
from gr_ros2.core.watch import wait_until
from gr_ros2.link.lateness import Lateness
from gr_ros2.phy import Phy
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.radio import Radio
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.config import AirConfig, DiagnosticsConfig, PhyConfig, replaced
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2_lab.medium.base import Surroundings
from gr_ros2_lab.medium.process import MediumConfig, MediumProcess, MediumRobot
from gr_ros2_lab.run.recorders import RunRecords
from gr_ros2_lab.run.robot_settings import RobotSettings
from gr_ros2_lab.run.scenario import Scenario

_FOUND_S = 20.0
"""s within which all links have to answer the medium."""
_POLL_S = 0.02
_QUIET_S = 0.3
"""s on the clock of the links, after which a packet that has left a robot has arrived."""


class SharedChannel:
    """See :class:`gr_ros2_lab.run.live.LiveMedium`, and :class:`gr_ros2_lab.run.live.LiveRobots` for the parameters."""

    channels = 1

    def __init__(
        self,
        scenario: Scenario,
        robots: Sequence[RobotSettings],
        registry: Registry,  # noqa: ARG002 - each link reads its own
        phy: Phy,
        around: Surroundings,
        *,
        records: RunRecords,
        stack: ExitStack,
    ) -> None:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="gr-ros2-")))
        settings = replaced(scenario.phy, sample_rate=phy.sample_rate, headroom=PhyConfig.headroom)
        ends = [
            tuple(f"ipc://{folder}/{number}-{what}" for what in ("sends", "hears")) for number in range(len(robots))
        ]
        self._around = around
        self._medium = MediumProcess(
            MediumConfig(
                name=scenario.name,
                phy=settings,
                packet_len=scenario.packet_len,
                robots=tuple(MediumRobot(connect=sends, bind=hears) for sends, hears in ends),
                seed=scenario.seed,
            ),
            around=around,
        )
        stack.callback(self._medium.close)
        self._robots: list[RobotLink] = []
        for number, (robot, (sends, hears)) in enumerate(zip(robots, ends, strict=True)):
            front_end = {"name": "zmq", "bind": sends, "connect": [hears], "medium_process": "lockstep"}
            config = _link_of(scenario, robot, settings, front_end, folder / f"robot-{number}")
            self._robots.append(RobotLink(config, observer=records.of(number)))
            stack.callback(self._robots[-1].stop)
        self.blocks = [(link.source, link.sink) for link in self._robots]
        self.clock = self._robots[0].front_end.clock
        self._thread = threading.Thread(target=self._carry, name="gr-ros2-medium", daemon=True)
        self._over = threading.Event()
        self._error: Exception | None = None
        self._slow_s = 0.0
        stack.callback(self._end)

    @property
    def links(self) -> list[Radio]:
        """The radio of each robot."""
        return [link.radio for link in self._robots]

    def start(self) -> None:
        """Start the links and the medium, and wait until all are there.

        :raises RunError: when a link does not answer
        """
        for link in self._robots:
            link.start()
        self._thread.start()
        if not wait_until(self._found, _FOUND_S, lambda _: time.sleep(_POLL_S)):
            raise RunError(
                f"{self._medium.robots} of {len(self._robots)} robots have answered the medium within "
                f"{_FOUND_S:g} s; this computer is too slow for them: take fewer, or simulated time"
            )

    def _found(self) -> bool:
        self.check()
        return self._medium.robots == len(self._robots)

    def run_began(self, now: float) -> None:  # noqa: ARG002 - the medium has a clock of its own
        """Count from now on where the robots are, and how long the medium waits for the computer."""
        self._around.begin(self._medium.now)
        self._slow_s = self._medium.lost_s

    def check(self) -> None:
        """:raises GrRos2Error: when the medium or a link cannot go on"""
        if self._error is not None:
            raise self._error
        for link in self._robots:
            link.check()

    def stop(self) -> None:
        """Stop the links, and then the medium, for which they may wait."""
        for link in self._robots:
            link.stop()
        self._end()

    def lateness(self, records: RunRecords) -> dict[str, list[Lateness]] | None:  # noqa: ARG002
        """None: the links wait for the computer."""
        return None

    def empty(self, unresolved: bool) -> bool:
        """Whether nothing is left on the air; see :class:`gr_ros2_lab.run.live.LiveMedium`."""
        if any(link.radio.counts().backlog for link in self._robots):
            return False
        until = self.clock() + _QUIET_S
        while unresolved and self.clock() < until:
            time.sleep(_POLL_S)
        return True

    def counted(self, robot: int) -> dict[str, Any]:
        """``packets``: to and from the air."""
        return {"packets": self._robots[robot].stats()["packets"]}

    def counters(self) -> dict[str, Any]:
        """``medium``; its ``slow_s``: s for which the robots waited for the computer."""
        return {"medium": {**self._medium.counted, "slow_s": self._medium.lost_s - self._slow_s}}

    def _carry(self) -> None:
        try:
            self._medium.run(over=self._over)
        except (GrRos2Error, OSError, ValueError) as error:
            self._error = error

    def _end(self) -> None:
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join()


def _link_of(
    scenario: Scenario, robot: RobotSettings, phy: PhyConfig, front_end: dict[str, Any], state: Path
) -> LinkConfig:
    """The link of a robot, by the settings of its scenario."""
    own = {item.name: getattr(robot.config, item.name) for item in fields(RobotConfig)}
    air = {item.name: getattr(scenario, item.name) for item in fields(AirConfig)}
    quiet = DiagnosticsConfig(period_s=0)
    return LinkConfig(**own | air | {"phy": phy, "state": str(state), "front_end": front_end, "diagnostics": quiet})
