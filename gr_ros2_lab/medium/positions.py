"""Levels that follow from where robots are: in the simulator's world, or by what a recording's odometry says.

Invariants: robots are where they are at full steps of ``STEP_S``, and levels change there alone; what is computed for a
packet are the robots within reach of its sender.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import ScenarioChannel
from gr_ros2_lab.medium.base import Hearers, Ints, RadioPath, Surroundings, all_pass, changed_paths
from gr_ros2_lab.medium.propagation import Shadowing, doppler_hz, path_loss_db, snr_over_db
from gr_ros2_lab.sim.world import World

STEP_S = 0.1
"""s between two computations of a level: at 2 m/s and a distance of 5 m it changes by 0.5 dB meanwhile."""
LEAST_DB, MOST_DB = -30.0, 100.0
"""SNRs below the first are not heard and do not disturb; above the second nothing gets better."""
_MAP_CELLS = 100
"""Cells of a map of SNRs along each axis."""
_SIGMAS = 4.0
"""Shadowing that makes up for a longer distance, in standard deviations. One link in 30,000 has more."""


Motion = Callable[[float], tuple[Floats, Floats]]
"""Places in m and velocities in m/s of all robots at a time in s, each of shape (robots, 2)."""


class Positions(Surroundings):
    """Robots whose levels follow from where they are.

    :param channel: how levels follow, and what all channels have in common
    :param bandwidth: of the noise, Hz
    :param tx_power_dbm, noise_figure_db: of each robot
    :param world: None = no obstacles
    :param paths: for every robot those to the robots that may ever hear it, as in :class:`FixedPaths`
    """

    moves = "channel.from = 'positions'"
    alike = True

    def __init__(
        self,
        channel: ScenarioChannel,
        motion: Motion,
        bandwidth: float,
        tx_power_dbm: Sequence[float],
        noise_figure_db: Sequence[float],
        *,
        paths: Sequence[Sequence[RadioPath]],
        world: World | None = None,
    ) -> None:
        self.robots = len(tx_power_dbm)
        self._channel, self._motion, self._world, self._bandwidth = channel, motion, world, bandwidth
        self._power, self._figure = np.array(tx_power_dbm), np.array(noise_figure_db)
        self._paths = [{path.receiver: path for path in heard} for heard in paths]
        self.passes = all_pass(self._paths)
        self._reached = [np.array([path.receiver for path in heard], int) for heard in paths]
        self._shadowing: Shadowing | None = None
        if channel.shadowing_db:
            self._shadowing = Shadowing(channel.shadowing_db, channel.decorrelation_m, channel.seed)
        self.reach_m = self.range_m(LEAST_DB - _SIGMAS * channel.shadowing_db)
        """Distance beyond which nobody hears anything, m."""
        self._begin_s, self._step = 0.0, -1
        self._places = self._velocities = np.zeros((self.robots, 2))
        self._one = self._other = np.zeros((0, 0), np.float32)
        self._known = np.zeros(self.robots, bool)
        self._heard: dict[int, Hearers] = {}
        self._near: dict[int, NDArray[np.bool_]] = {}

    def begin(self, now: float) -> None:
        self._begin_s = now

    def change(self, sender: int, **settings: Any) -> None:
        if "snr_db" in settings:
            raise ConfigError("channel.snr_db: levels follow from positions; set channel.from: settings")
        self._paths[sender] = changed_paths(self._paths[sender], settings)
        self.passes = all_pass(self._paths)

    def path(self, sender: int, receiver: int) -> RadioPath:
        return self._paths[sender][receiver]

    def reached(self, sender: int) -> list[int]:
        return list(self._paths[sender])

    def hearers(self, sender: int, now: float) -> Hearers:
        self._go(now)
        heard = self._heard.get(sender)
        if heard is None:
            heard = self._heard[sender] = self._hearers(sender)
        return heard

    def near(self, sender: int, now: float) -> NDArray[np.bool_]:
        self._go(now)
        near = self._near.get(sender)
        if near is None:
            apart = np.abs(self._places - self._places[sender]).max(1)
            near = self._near[sender] = apart <= 2 * self.reach_m
        return near

    def range_m(self, snr_db: float) -> float:
        """Distance at which the strongest sender has an SNR at the best receiver, without walls and shadowing, m."""
        best = float(snr_over_db(0.0, self._power.max(), self._figure.min(), self._bandwidth))
        distances = np.geomspace(1e-1, 1e7, 4001)
        above = np.flatnonzero(best - path_loss_db(self._channel, distances) >= snr_db)
        return float(distances[above[-1]]) if len(above) else 0.0

    def _go(self, now: float) -> None:
        """Move the robots to where they are at a time."""
        step = max(0, math.floor((now - self._begin_s) / STEP_S + 1e-9))
        if step == self._step:
            return
        self._step = step
        places, self._velocities = self._motion(step * STEP_S)
        if np.array_equal(places, self._places) and self._step:
            return  # all stand
        self._places = places
        self._heard, self._near = {}, {}
        self._known[:] = False

    def _hearers(self, sender: int) -> Hearers:
        ids = self._reached[sender]
        ways = self._places[ids] - self._places[sender]
        within = np.abs(ways).max(1, initial=0.0) <= self.reach_m
        ids, ways = ids[within], ways[within]
        snr_db = self._snr_db(sender, ids, np.hypot(*ways.T))
        heard = snr_db >= LEAST_DB
        shift_hz = doppler_hz(ways, self._velocities[ids] - self._velocities[sender], self._channel.carrier_hz)
        return Hearers(ids[heard], np.minimum(snr_db[heard], MOST_DB), shift_hz[heard], self.robots)

    def _snr_db(self, sender: int, ids: Ints, apart: Floats) -> Floats:
        """The level of a robot at others, dB.

        :param apart: how far they are, m
        """
        loss_db = _loss_db(self._channel, self._world, self._places[sender], self._places[ids])
        if self._shadowing is not None:
            one, other = self._ends(self._shadowing, np.append(ids, sender))
            loss_db = loss_db + self._shadowing.between((one[sender], other[sender]), (one[ids], other[ids]), apart)
        return snr_over_db(-loss_db, self._power[sender], self._figure[ids], self._bandwidth)

    def _ends(self, shadowing: Shadowing, robots: Ints) -> tuple[Any, Any]:
        """What the field of the shadowing has of places, with those of some robots up to date."""
        new = robots[~self._known[robots]]
        if len(new):
            one, other = shadowing.ends(self._places[new])
            if not len(self._one):
                self._one, self._other = (np.zeros((self.robots, one.shape[1]), np.float32) for _ in range(2))
            self._one[new], self._other[new], self._known[new] = one, other, True
        return self._one, self._other


def snr_map(channel: ScenarioChannel, world: World, origin: Floats, bandwidth: float) -> tuple[Floats, Floats]:
    """The SNR at every place of a world for a sender in one.

    :param origin: where the sender is, m, shape (2,)
    :param bandwidth: of the noise, Hz
    :returns: the middles of the cells along both axes, m, and the SNRs in dB, shape (100, 100), rows of growing y
    """
    middles = (np.arange(_MAP_CELLS) + 0.5) * world.size / _MAP_CELLS
    there = np.stack(np.meshgrid(middles, middles), -1).reshape(-1, 2)
    loss_db = _loss_db(channel, world, origin, there)
    if channel.shadowing_db:
        field = Shadowing(channel.shadowing_db, channel.decorrelation_m, channel.seed)
        one, other = field.ends(origin[None])
        loss_db = loss_db + field.between((one[0], other[0]), field.ends(there), np.hypot(*(there - origin).T))
    snr_db = snr_over_db(-loss_db, channel.tx_power_dbm, channel.noise_figure_db, bandwidth)
    return middles, snr_db.reshape(_MAP_CELLS, _MAP_CELLS)


def _loss_db(channel: ScenarioChannel, world: World | None, here: Floats, there: Floats) -> Floats:
    """Loss from one place to others over the distance and through walls."""
    loss_db = path_loss_db(channel, np.hypot(*(there - here).T))
    if world is None or not channel.walls_db:
        return loss_db
    return np.asarray(loss_db + channel.walls_db * world.crossed(here, there))
