"""What a robot's camera sees of its room: a pinhole camera on a robot on the ground, drawn in numpy.

Invariants: a picture is made of the true place and a generator alone; every wall has a texture by which motion is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.arrays import Floats
from gr_ros2_lab.sim.motion import RADIUS, State
from gr_ros2_lab.sim.world import World

WIDTH: Final = 320
HEIGHT: Final = 240
_VIEW: Final = math.radians(70)
"""Width of the view."""
_EYE_M: Final = 0.6
_WALL_M: Final = 2.4
_ROBOT_M: Final = 0.8
_HAZE_M: Final = 15.0
"""m in which light falls to 1/e."""
_NOISE: Final = 4
"""Grey levels of the sensor's noise at most."""


@cache
def _rays(width: int, height: int) -> tuple[Floats, Floats]:
    """The angle of each column, and the slope of each row, shape (height, 1)."""
    focal = width / 2 / math.tan(_VIEW / 2)
    return (
        np.arctan((width / 2 - 0.5 - np.arange(width)) / focal),
        (np.arange(height)[:, None] + 0.5 - height / 2) / focal,
    )


def picture(
    world: World, state: State, others: Sequence[State], rng: np.random.Generator, width: int = WIDTH
) -> NDArray[np.uint8]:
    """The view from a robot.

    :param others: the other robots
    :param width: pixels; the height is three quarters of it
    :returns: rgb8 of shape (height, width, 3)
    """
    columns, slopes = _rays(width, width * HEIGHT // WIDTH)
    angles = columns + state.heading
    walls = world.cast(state.x, state.y, angles)
    view = _surface(state, (columns, slopes), walls, _WALL_M)
    if others:
        rounds = np.array([(other.x, other.y, RADIUS) for other in others], dtype=np.float64)
        near = world.cast(state.x, state.y, angles, rounds)
        depth = near * np.cos(columns)
        z = _EYE_M - slopes * depth
        body = (near < walls - 1e-9) & (z >= 0) & (z <= _ROBOT_M)
        stripes = np.where((z * 10).astype(int) % 4 == 0, 60.0, 200.0) * np.exp(-depth / _HAZE_M)
        view[body] = stripes[body][:, None] * np.array([1.0, 0.35, 0.2])
    noisy = view + rng.integers(-_NOISE, _NOISE + 1, (*view.shape[:2], 1))
    return np.clip(noisy, 0, 255).astype(np.uint8)


def _surface(state: State, rays: tuple[Floats, Floats], walls: Floats, height: float) -> Floats:
    """Walls, floor and ceiling."""
    columns, slopes = rays
    angles = columns + state.heading
    depth = np.maximum(walls * np.cos(columns), 0.05)
    with np.errstate(divide="ignore"):
        floor, ceiling = _EYE_M / slopes, (_EYE_M - height) / slopes
    flat = np.where(slopes > 0, floor, ceiling)
    is_wall = flat > depth
    along = np.where(is_wall, depth, flat)
    reach = along / np.cos(columns)
    x, y = state.x + reach * np.cos(angles), state.y + reach * np.sin(angles)
    z = np.where(is_wall, _EYE_M - slopes * along, np.where(slopes > 0, 0.0, height))
    run = x + y
    bricks = np.where(
        ((z / 0.3).astype(int) + np.floor(run / 0.6 + 0.5 * ((z / 0.3).astype(int) % 2)).astype(int)) % 2, 1.0, 0.7
    )
    grain = 1 + 0.12 * np.sin(23.1 * run + 7 * z) * np.sin(31.7 * z + 11 * (x - y))
    tiles = np.where((np.floor(x / 0.5) + np.floor(y / 0.5)) % 2, 1.0, 0.75)
    light = np.exp(-along / _HAZE_M)
    tint = np.stack(
        [0.9 + 0.1 * np.sin(0.6 * x), 0.75 + 0.2 * np.sin(0.45 * y + 1), 0.6 + 0.25 * np.sin(0.5 * run + 2)], -1
    )
    wall = 190 * bricks * grain * light
    ground = np.where(slopes > 0, 130 * tiles, 215.0) * light
    return np.where(is_wall[:, :, None], wall[:, :, None] * tint, ground[:, :, None] * np.array([0.95, 1.0, 1.05]))
