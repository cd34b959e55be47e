"""The room the robots drive in: four walls, boxes at any angle, round pillars.

Invariants: lengths are in m, angles in rad. The room's lower left corner is the origin of the map frame. Between any
two obstacles, and between an obstacle and a wall, there is a gap of ``GAP`` or more, so every free place can be
reached. Nothing here changes after construction.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.arrays import Floats

GAP = 1.7
"""Smallest gap between obstacles, m. A robot of 0.7 m passes with half a metre on each side."""
BORDER = 0.4
"""Width of the wall that the map shows around the room, m."""
_TRIES = 200
_STEP_M = 0.15


class World:
    """A room with obstacles, drawn from a generator.

    :param size: side of the square room, m
    :param count: requested number of obstacles. Places that leave no ``GAP`` are not used, so there may be fewer
    :param rng: generator of the places
    """

    def __init__(self, size: float, count: int, rng: np.random.Generator) -> None:
        self.size = size
        boxes: list[tuple[float, float, float, float, float]] = []
        circles: list[tuple[float, float, float]] = []
        taken: list[tuple[float, float, float]] = []
        for number in range(count):
            half_x, half_y = rng.uniform(0.3, 1.2), rng.uniform(0.3, 0.9)
            reach = math.hypot(half_x, half_y) if number % 2 == 0 else half_y
            for _ in range(_TRIES):
                x, y = rng.uniform(reach + GAP, size - reach - GAP, 2)
                if all(math.hypot(x - cx, y - cy) >= reach + other + GAP for cx, cy, other in taken):
                    taken.append((x, y, reach))
                    if number % 2 == 0:
                        boxes.append((x, y, half_x, half_y, rng.uniform(-math.pi, math.pi)))
                    else:
                        circles.append((x, y, reach))
                    break
        self.boxes: Floats = np.array(boxes, dtype=np.float64).reshape(-1, 5)
        """Rows x, y, half length, half width, angle."""
        self.circles: Floats = np.array(circles, dtype=np.float64).reshape(-1, 3)
        """Rows x, y, radius."""
        self._cos, self._sin = np.cos(self.boxes[:, 4]), np.sin(self.boxes[:, 4])
        around = np.column_stack([self.boxes[:, :2], np.hypot(self.boxes[:, 2], self.boxes[:, 3])])
        self._bounds = self.circles, around
        """Circles around all pillars, and around all boxes."""

    def clearance(self, points: Floats, reach: float = math.inf) -> Floats:
        """Distance from each point to the nearest wall or obstacle, negative inside one.

        :param points: array of shape (..., 2)
        :param reach: m, beyond which no distance matters: obstacles that are farther from all points may be left out
        :returns: array of shape (...)
        """
        x, y = points[..., 0].ravel(), points[..., 1].ravel()
        nearest = np.minimum(np.minimum(x, self.size - x), np.minimum(y, self.size - y))
        near_circles: Any = slice(None)
        near_boxes: Any = slice(None)
        if reach < math.inf:
            box = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
            near_circles, near_boxes = (_within(box, centres, reach) for centres in self._bounds)
        circles, boxes = self.circles[near_circles], self.boxes[near_boxes]
        if len(circles):
            centre_x, centre_y, radius = circles.T[:, :, None]
            dx, dy = x - centre_x, y - centre_y
            nearest = np.minimum(nearest, (np.sqrt(dx * dx + dy * dy) - radius).min(axis=0))
        if len(boxes):
            centre_x, centre_y, half_x, half_y, _ = boxes.T[:, :, None]
            cos, sin = self._cos[near_boxes, None], self._sin[near_boxes, None]
            dx, dy = x - centre_x, y - centre_y
            out_x = np.abs(dx * cos + dy * sin) - half_x
            out_y = np.abs(dy * cos - dx * sin) - half_y
            far_x, far_y = np.maximum(out_x, 0), np.maximum(out_y, 0)
            outside = np.sqrt(far_x * far_x + far_y * far_y)
            nearest = np.minimum(nearest, (outside + np.minimum(np.maximum(out_x, out_y), 0)).min(axis=0))
        return np.asarray(nearest.reshape(points.shape[:-1]))

    def clear_line(self, start: Floats, end: Floats, clearance: float) -> bool:
        """Whether a straight line keeps ``clearance`` from everything, checked every 15 cm."""
        count = max(2, math.ceil(math.hypot(*(end - start)) / _STEP_M) + 1)
        line = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
        return bool(self.clearance(line).min() >= clearance)

    def clear_lines(self, starts: Floats, ends: Floats, clearance: float) -> NDArray[np.bool_]:
        """The same of many lines, by their ends of shape (n, 2); those of one length are checked at once."""
        way = ends - starts
        counts = np.maximum(2, np.ceil(np.hypot(*way.T) / _STEP_M).astype(int) + 1)
        clear = np.empty(len(way), bool)
        for count in set(counts.tolist()):
            some = counts == count
            lines = starts[some, None] + np.linspace(0.0, 1.0, count)[:, None] * way[some, None]
            clear[some] = self.clearance(lines).min(axis=1) >= clearance
        return clear

    def cast(self, x: float, y: float, angles: Floats, others: Floats | None = None) -> Floats:
        """Distance along each ray to the first wall, obstacle or other robot.

        :param angles: directions of the rays, in the map frame
        :param others: rows x, y, radius of moving round objects
        """
        dir_x, dir_y = np.cos(angles)[:, None], np.sin(angles)[:, None]
        with np.errstate(divide="ignore"):  # a ray along a wall gives +-inf, as the slab method needs
            room = np.maximum((0.0 - x) / dir_x, (self.size - x) / dir_x)
            room = np.minimum(room, np.maximum((0.0 - y) / dir_y, (self.size - y) / dir_y))
            hits = [room]
            if len(self.boxes):
                hits.append(self._cast_boxes(x, y, dir_x, dir_y))
        circles = self.circles if others is None else np.concatenate([self.circles, others])
        if len(circles):
            off_x, off_y = circles[:, 0] - x, circles[:, 1] - y
            along = dir_x * off_x + dir_y * off_y
            across = dir_x * off_y - dir_y * off_x
            depth = circles[:, 2] ** 2 - across**2
            near = along - np.sqrt(np.maximum(depth, 0.0))
            hits.append(np.where((depth >= 0) & (near >= 0), near, np.inf))
        return np.asarray(np.concatenate(hits, axis=1).min(axis=1))

    def crossed(self, start: Floats, ends: Floats) -> NDArray[np.int_]:
        """Number of obstacles that the straight lines from one point to others pass through.

        :param start: x, y
        :param ends: shape (n, 2)
        """
        way = ends - start
        count = np.zeros(len(ends), int)
        if len(self.circles):
            off = self.circles[:, :2] - start
            along = np.clip((way @ off.T) / np.maximum((way * way).sum(1), 1e-12)[:, None], 0.0, 1.0)
            gap = along[:, :, None] * way[:, None] - off
            count += ((gap * gap).sum(-1) < self.circles[:, 2] ** 2).sum(1)
        if len(self.boxes):
            with np.errstate(divide="ignore", invalid="ignore"):
                enter, leave = self._slabs(float(start[0]), float(start[1]), way[:, :1], way[:, 1:])
            count += ((leave > np.maximum(enter, 0.0)) & (enter < 1.0)).sum(1)
        return count

    def _cast_boxes(self, x: float, y: float, dir_x: Floats, dir_y: Floats) -> Floats:
        enter, leave = self._slabs(x, y, dir_x, dir_y)
        return np.where((leave >= enter) & (enter >= 0), enter, np.inf)

    def _slabs(self, x: float, y: float, dir_x: Floats, dir_y: Floats) -> tuple[Floats, Floats]:
        """Where lines enter and leave each box, in lengths of their direction: the slab method in the box's own frame.

        :param dir_x, dir_y: shape (n, 1)
        :returns: of shape (n, boxes); a line that misses a box leaves it before it enters it
        """
        off_x, off_y = x - self.boxes[:, 0], y - self.boxes[:, 1]
        enter = np.full((len(dir_x), len(self.boxes)), -np.inf)
        leave = np.full_like(enter, np.inf)
        for offset, direction, half in (
            (off_x * self._cos + off_y * self._sin, dir_x * self._cos + dir_y * self._sin, self.boxes[:, 2]),
            (off_y * self._cos - off_x * self._sin, dir_y * self._cos - dir_x * self._sin, self.boxes[:, 3]),
        ):
            one, two = (-half - offset) / direction, (half - offset) / direction
            enter = np.maximum(enter, np.minimum(one, two))
            leave = np.minimum(leave, np.maximum(one, two))
        return enter, leave

    def map_origin_resolution(self, cells: int) -> tuple[float, float]:
        """Map frame coordinate (the same for x and y) of the first cell's corner, and the cell's side, m."""
        return -BORDER, (self.size + 2 * BORDER) / cells

    def occupancy(self, cells: int) -> NDArray[np.int8]:
        """The map of nav_msgs/OccupancyGrid: rows of growing y. A cell is 100 if its centre is in a wall or an
        obstacle, or within half a cell of its edge, else 0."""
        origin, resolution = self.map_origin_resolution(cells)
        centres = origin + (np.arange(cells) + 0.5) * resolution
        grid = np.stack(np.meshgrid(centres, centres), axis=-1)
        clearance = np.stack([self.clearance(row) for row in grid])  # row by row, to save memory
        return np.where(clearance < resolution / 2, 100, 0).astype(np.int8)


def _within(box: tuple[Floats, Floats], circles: Floats, reach: float) -> NDArray[np.bool_]:
    """Which circles are not farther than ``reach`` from a rectangle with its least and its greatest corner."""
    low, high = box
    away = circles[:, :2] - np.clip(circles[:, :2], low, high)
    return np.asarray(np.hypot(*away.T) <= circles[:, 2] + reach)
