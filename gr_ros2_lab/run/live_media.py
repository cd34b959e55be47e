"""What lies between the links of robots in real time, and what an observer sees of it.

Invariants: what reaches whom is up to the medium of simulated time (:mod:`gr_ros2_lab.medium`), whether robots share a
channel or not; where robots are, and outages, count from the begin of the run.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gr_ros2.core.errors import GrRos2Error, RunError
from gr_ros2.core.watch import wait_until
from gr_ros2.link.lateness import Lateness
from gr_ros2.phy import Phy
from gr_ros2.phy.tap import Samples
from gr_ros2.radio.front_end import FrontEnd
from gr_ros2.radio.radio import LinkCounts
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.radio.zmq import ZmqFrontEnd
from gr_ros2.settings.config import ChannelConfig, PhyConfig, replaced
from gr_ros2_lab.medium import Medium, Surroundings
from gr_ros2_lab.medium.process import MediumConfig, MediumProcess, MediumRobot
from gr_ros2_lab.run.robots import hearer_of
from gr_ros2_lab.run.scenario import Scenario

_LOOK_S, _SLOW = 1.0, 0.1
"""s over which it is said how slow the computer is, and the part of real time that it may lose before that is said."""
_FOUND_S = 20.0
"""s within which all links have to answer the medium."""
POLL_S = 0.02
"""s between two looks at something that changes by itself."""


class LiveMedium(ABC):
    """Carries what the links of robots send.

    :param phy: of all robots
    :param around: who hears whom
    :param stack: closes what is opened here
    :raises ConfigError: for a PHY that the robots cannot have
    :ivar medium: says what reaches whom
    """

    medium: Medium

    @abstractmethod
    def __init__(self, scenario: Scenario, phy: Phy, around: Surroundings, stack: ExitStack) -> None: ...

    @abstractmethod
    def front_end(self, number: int) -> Callable[..., FrontEnd]:
        """Opens that of a robot, by its place."""

    @abstractmethod
    def start(self, robots: int) -> None:
        """Begin to carry, and wait until so many robots are there.

        :raises RunError: when one does not answer
        """

    @property
    @abstractmethod
    def now(self) -> float:
        """s on the clock of the medium."""

    def check(self) -> None:  # noqa: B027 - what passes packets on cannot break
        """:raises GrRos2Error: when it cannot go on"""

    @abstractmethod
    def stop(self) -> None:
        """Nothing is carried any more. Idempotent."""

    waits = False
    """Whether its clock, and with it the robots, waits for the computer."""

    def began(self) -> None:
        """Count from now on."""
        self.medium.begin(self.now)

    def counters(self) -> dict[str, Any]:
        """What it counted for all robots together."""
        return {}

    def alarms(self) -> Sequence[str]:
        """What is wrong with it now, one line each."""
        return ()


class LockedSteps(LiveMedium):
    """A medium process at samples carries bursts of any PHY that has samples, in lock step: all links follow its clock,
    which never goes faster than real time, and waits for them. So nothing is lost because the computer is slow.
    """

    waits = True

    def __init__(self, scenario: Scenario, phy: Phy, around: Surroundings, stack: ExitStack) -> None:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="gr-ros2-")))
        robots = range(around.robots)
        self._ends = [tuple(f"ipc://{folder}/{number}-{what}" for what in ("sends", "hears")) for number in robots]
        self._process = MediumProcess(
            MediumConfig(
                name=scenario.name,
                phy=replaced(scenario.phy, sample_rate=phy.sample_rate, headroom=PhyConfig.headroom),
                packet_len=scenario.packet_len,
                robots=tuple(MediumRobot(connect=sends, bind=hears) for sends, hears in self._ends),
                seed=scenario.seed,
            ),
            around=around,
            shared=scenario.duplex == "half",
        )
        stack.callback(self._process.close)
        self.medium = self._process.medium
        self._thread = threading.Thread(target=self._carry, name="gr-ros2-medium", daemon=True)
        self._over = threading.Event()
        self._error: Exception | None = None
        self._slow_s = self._slow = 0.0
        self._looked = time.monotonic(), 0.0

    def front_end(self, number: int) -> Callable[..., FrontEnd]:
        sends, hears = self._ends[number]
        return partial(ZmqFrontEnd, bind=sends, connect=[hears], medium_process="lockstep")

    def start(self, robots: int) -> None:
        self._thread.start()
        if not wait_until(lambda: self._found(robots), _FOUND_S, look_s=POLL_S):
            raise RunError(
                f"{self._process.robots} of {robots} robots have answered the medium within {_FOUND_S:g} s; this "
                "computer is too slow for them: take fewer, or simulated time"
            )

    def _found(self, robots: int) -> bool:
        self.check()
        return self._process.robots == robots

    @property
    def now(self) -> float:
        return self._process.now

    def began(self) -> None:
        super().began()
        self._slow_s = self._process.lost_s

    def check(self) -> None:
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join()

    def counters(self) -> dict[str, Any]:
        """``medium``; its ``slow_s``: s for which the robots waited for the computer."""
        return {"medium": {**self._process.counted, "slow_s": self._process.lost_s - self._slow_s}}

    def alarms(self) -> Sequence[str]:
        now, lost_s = time.monotonic(), self._process.lost_s
        since, before_s = self._looked
        if now >= since + _LOOK_S:
            self._slow, self._looked = (lost_s - before_s) / (now - since), (now, lost_s)
        if self._slow < _SLOW:
            return ()
        return (f"the computer carries the robots at {1 - self._slow:.0%} of real time; nothing is lost by it",)

    def _carry(self) -> None:
        try:
            self._process.run(over=self._over)
        except (GrRos2Error, OSError, ValueError) as error:
            self._error = error


class LiveChannel:
    """What an observer can read and change of the channel from a robot to all who hear it; what is received is what the
    first of them receives. See :class:`gr_ros2.observe.observers.LiveLink`.

    :param sender: its place among the robots
    :param links: of all robots
    :ivar phy: of the receiver
    :ivar channel: as it is now
    :ivar snr_db: of the newest packets, as the receiver measured it, dB
    :ivar transmits: whether packets go on the air
    """

    changeable = True

    def __init__(self, live: LiveMedium, sender: int, links: Sequence[RobotLink]) -> None:
        self._live, self._medium, self._sender = live, live.medium, sender
        self._receiver = hearer_of(live.medium.around, sender)
        self._sends, self._hears = links[sender].radio, links[self._receiver].radio

    @property
    def phy(self) -> Phy:
        return self._hears.phy

    @property
    def channel(self) -> ChannelConfig:
        return self._medium.around.path(self._sender, self._receiver).channel

    @property
    def snr_db(self) -> float | None:
        return self._hears.snr_db

    @property
    def transmits(self) -> bool:
        return self._sends.transmits

    def gate_lateness(self) -> Lateness | None:
        return None if self._live.waits else self._sends.gate_lateness()

    def counts(self) -> LinkCounts:
        return replace(self._sends.counts(), losses=dict(self._medium.lost.dropped[self._sender, self._receiver]))

    def samples(self) -> Samples | None:
        return self._hears.samples()

    def symbols(self) -> Samples | None:
        return self._hears.symbols()

    def transmit(self, *, on: bool) -> None:
        self._sends.transmit(on=on)

    def set_snr_db(self, snr_db: float | None) -> None:
        self._change(snr_db=snr_db)

    def set_frequency_offset(self, frequency_offset: float) -> None:
        self._change(frequency_offset=frequency_offset)

    def set_packet_loss(self, probability: float) -> None:
        self._change(packet_loss=probability)

    def _change(self, **settings: Any) -> None:
        self.phy.check_channel(replaced(self.channel, **settings))
        self._medium.change(self._sender, **settings)
