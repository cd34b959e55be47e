"""Watches the clocks of the robots that a link hears, says what was set, and gives one to chrony.

Invariants: each robot that is heard itself is asked once in ``every_s``. Each answer is one sample for chrony, of the
offset that this answer tells alone, at the time at which it came, so that chrony itself sees how they scatter. One that
tells nothing beside those before it is none: an end was frozen, or the air full, while it was under way.
"""

from __future__ import annotations

import logging
import socket
import struct
from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import Any

from gr_ros2.core.clocks import wall_ahead
from gr_ros2.core.errors import shortened
from gr_ros2.settings.config import ClockConfig
from gr_ros2.settings.fields import AUTO

MINE_S, CHRONY_S = 10.0, 1.0
"""s between two questions where none are set: for stamps, and for chrony."""
SET_S = 0.1
"""s by which this computer's clock has moved at least that is said."""
WIDE = 10.0
"""Bounds of an answer, beside the best ones known, at which it tells nothing."""
SAID_S = 60.0
"""s for which it is said that a clock was set."""
SAMPLE = struct.Struct("@lldiiii")
"""struct sock_sample of chrony: time of the sample (s, us), offset in s, pulse, leap, padding, magic."""
MAGIC = 0x534F434B
_log = logging.getLogger(__name__)


class ClockWatch:
    """See the module.

    :param mine: stamps are moved to this robot's clock
    :param heard: returns the robots that are heard now, each with its ``clock``
    :param ask: asks a robot
    :param set_wall: told the clock of the wall minus ``now``, s, at each look
    :param ahead: s by which the clock of the wall is ahead of ``now``; None where the clock of the link is not this
        computer's (a simulation in lock step), so that nobody is asked and nothing is said of clocks
    :ivar given: samples that chrony has taken
    """

    def __init__(
        self,
        config: ClockConfig,
        *,
        mine: bool,
        heard: Callable[[float], Sequence[Mapping[str, Any]]],
        ask: Callable[[int], object],
        set_wall: Callable[[float], None],
        ahead: Callable[[], float] | None = wall_ahead,
    ) -> None:
        every = config.every_s
        self.every_s = (CHRONY_S if config.chrony else MINE_S if mine else 0.0) if every == AUTO else every
        self._config, self._heard, self._ask, self._set_wall, self._ahead = config, heard, ask, set_wall, ahead
        self._asked: dict[int, float] = {}
        self._wall_s: float | None = None
        self._jumps: dict[int, int] = {}
        self._set: dict[int | None, tuple[float, float]] = {}
        """When each clock was set last while it was watched, and by how much, s; None is this computer's."""
        self._answers = 0
        self._socket: socket.socket | None = None
        self._said = False
        self.given = 0

    def look(self, now: float) -> None:
        """Ask the robots that are due, hand on what they have answered, and note what was set.

        :param now: s, monotonic
        """
        if self._ahead is None:
            return
        wall_s = self._ahead()
        if self._wall_s is not None and abs(wall_s - self._wall_s) >= SET_S:
            self._set[None] = now, wall_s - self._wall_s
        self._wall_s = wall_s
        self._set_wall(wall_s)
        for peer in self._heard(now):
            robot, clock = peer["robot"], peer["clock"]
            if clock is not None:
                self._take(robot, clock, now, wall_s + now)
            itself = not peer["hops"] and not peer["silent"]
            if self.every_s and itself and now >= self._asked.get(robot, -inf) + self.every_s:
                self._asked[robot] = now
                self._ask(robot)

    def lines(self, now: float) -> list[str]:
        """One line for each clock that was set in the last minute."""
        return [
            f"{_whose(robot)} was set {_by(jumped_s)}: ages of messages under way then are wrong"
            for robot, (at, jumped_s) in list(self._set.items())
            if now < at + SAID_S
        ]

    def close(self) -> None:
        """Give chrony nothing any more. Idempotent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _take(self, robot: int, clock: Mapping[str, Any], now: float, wall: float) -> None:
        if clock["jumps"] != self._jumps.get(robot, 0):
            self._jumps[robot], self._set[robot] = clock["jumps"], (now, clock["jumped_s"])
        if robot == self._config.robot and clock["answers"] != self._answers:
            self._answers = clock["answers"]
            if clock["newest_error_s"] <= WIDE * clock["error_s"]:
                self._give(wall - clock["newest_age_s"], clock["newest_s"])

    def _give(self, at: float, ahead_s: float) -> None:
        """Give chrony a sample, if it is there.

        :param at: this computer's clock when the answer came, s since 1970
        :param ahead_s: s by which the other one was ahead of it
        """
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
                self._socket.setblocking(False)
                self._socket.connect(self._config.chrony)
            seconds, rest = divmod(at, 1.0)
            self._socket.send(SAMPLE.pack(int(seconds), int(rest * 1e6), ahead_s, 0, 0, 0, MAGIC))
            self.given += 1
            self._said = False
        except OSError as error:  # chrony is not there, or starts again
            self.close()
            if not self._said:
                self._said = True
                _log.warning("clock.chrony = %r: %s", self._config.chrony, shortened(str(error)))


def _whose(robot: int | None) -> str:
    return "this computer's clock" if robot is None else f"the clock of robot {robot}"


def _by(jumped_s: float) -> str:
    return f"{abs(jumped_s):.3g} s {'forward' if jumped_s > 0 else 'back'}"
