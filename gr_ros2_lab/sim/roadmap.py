"""Ways through the room: places, straight lines between them that a robot can drive, and the shortest routes.

Invariant: every place keeps ``clearance`` from walls and obstacles, and so does every line between neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.arrays import Floats
from gr_ros2_lab.sim.world import World

Places = NDArray[np.int_]
"""Indices of places."""

_NEIGHBOUR_M = 6.0
_SPACING_M = 1.1
_SAMPLES, _SAMPLES_PER_ROBOT = 400, 4


class Roadmap:
    """Random places at least a metre apart, joined if the line between them is clear.

    :param clearance: distance from the centre of a robot to anything, m
    :param robots: number of robots that start on it
    """

    def __init__(self, world: World, clearance: float, rng: np.random.Generator, robots: int = 1) -> None:
        self._world = world
        self.clearance = clearance
        samples = rng.uniform(clearance, world.size - clearance, (max(_SAMPLES, _SAMPLES_PER_ROBOT * robots), 2))
        places: list[Floats] = []
        for sample in samples[world.clearance(samples) >= clearance]:
            if not places or np.hypot(*(np.array(places) - sample).T).min() >= _SPACING_M:
                places.append(sample)
        nodes = np.array(places)
        distance, step = self._routes(nodes)
        # Gaps are so wide that nearly all places are connected. A place that is not connected is left out.
        hub = int(np.isfinite(distance).sum(axis=1).argmax())
        self._distance, self._step = distance, step
        self.nodes = nodes
        """Rows x, y."""
        self.reachable = np.flatnonzero(np.isfinite(distance[hub]))
        """Indices of the places that can reach each other."""

    def _routes(self, nodes: Floats) -> tuple[Floats, Places]:
        """Shortest distances and next steps between all places (Floyd-Warshall algorithm)."""
        count = len(nodes)
        lengths = np.hypot(*(nodes[:, None] - nodes[None]).transpose(2, 0, 1))
        distance = np.full((count, count), np.inf)
        np.fill_diagonal(distance, 0.0)
        ones, twos = np.nonzero(np.triu(lengths <= _NEIGHBOUR_M, 1))
        clear = self._world.clear_lines(nodes[ones], nodes[twos], self.clearance)
        ones, twos = ones[clear], twos[clear]
        distance[ones, twos] = distance[twos, ones] = lengths[ones, twos]
        step = np.where(np.isfinite(distance), np.arange(count)[None], -1)
        through, better = np.empty_like(distance), np.empty(distance.shape, bool)  # anew each time: twice as long
        for middle in range(count):
            np.add(distance[:, middle, None], distance[None, middle], out=through)
            np.less(through, distance, out=better)
            np.copyto(distance, through, where=better)
            np.copyto(step, step[:, middle, None].copy(), where=better)
        return distance, step

    def nearest(self, point: Floats) -> int:
        """The nearest place that can be reached in a straight line, or just the nearest if none can."""
        away = np.hypot(*(self.nodes[self.reachable] - point).T)
        order = self.reachable[np.argsort(away)]
        for node in order[:10]:
            if self._world.clear_line(point, self.nodes[node], self.clearance * 0.8):
                return int(node)
        return int(order[0])

    def far_from(self, node: int, least_m: float) -> Places:
        """Places to which the drive is at least that long, or the farthest place if there are none."""
        distance = self._distance[node, self.reachable]
        far = self.reachable[distance >= least_m]
        return far if len(far) else self.reachable[[int(distance.argmax())]]

    def route(self, start: int, goal: int) -> list[int]:
        """The places from start to goal, both included."""
        route = [start]
        while route[-1] != goal:
            route.append(int(self._step[route[-1], goal]))
        return route
