"""The newest picture of a camera and the newest map, as the page draws them.

Invariants: one message of each topic is kept; it becomes pixels once, when a snapshot needs it, at most ``MOST`` wide
and high; a message that cannot be shown leaves what was shown before.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.codecs.messages import GRID, IMAGE, read
from gr_ros2.core.errors import DamagedError
from gr_ros2.dashboard.views import PictureView

MOST = 320
"""Pixels along each side at most."""
FROZEN_S = 2.0
"""Age in s from which a picture of a camera is shown in grey, as frozen."""
_ORDERS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "mono8": (0, 0, 0)}
_WALL, _FREE, _UNKNOWN = (58, 68, 80), (236, 240, 244), (178, 188, 198)
Pixels = NDArray[np.uint8]


class NewestPicture:
    """The newest message of a topic of pictures or maps."""

    def __init__(self, type_name: str) -> None:
        self._type = type_name
        self._message: bytes | None = None
        self._made = 0.0
        self._shown: tuple[Pixels, tuple[float, float, float, float], float] | None = None
        """Pixels from below, where they are, m, and when they were made, s."""

    def take(self, message: bytes, made: float) -> None:
        """A message has come out that was made at a time, s."""
        self._message, self._made = message, made

    def view(self, name: str, now: float) -> PictureView | None:
        """What is to be drawn now; None before anything can be."""
        if self._message is not None:
            message, self._message = self._message, None
            with suppress(DamagedError, ValueError, KeyError):  # what cannot be shown is none of the link's business
                self._shown = *(_map if self._type == GRID else _image)(message), self._made
        if self._shown is None:
            return None
        pixels, place, made = self._shown
        age = max(now - made, 0.0)
        frozen = self._type == IMAGE and age > FROZEN_S
        if frozen:
            grey = pixels[..., :3] @ np.array([0.15, 0.3, 0.05]) + 100
            pixels = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
        opaque = np.full((*pixels.shape[:2], 1), 255, np.uint8)
        rgba = np.ascontiguousarray(np.concatenate([pixels, opaque], axis=2)).view(np.uint32)[..., 0]
        return PictureView(name, rgba, age, frozen, place, is_map=self._type == GRID)


def newest_picture(type_name: str) -> NewestPicture | None:
    """What keeps the pictures of a topic; None for a type that is no picture."""
    return NewestPicture(type_name) if type_name in (IMAGE, GRID) else None


def _image(message: bytes) -> tuple[Pixels, tuple[float, float, float, float]]:
    """:raises KeyError: an encoding that is not shown"""
    image = read(IMAGE, message)
    order = _ORDERS[image.encoding]
    channels = {"mono8": 1, "rgba8": 4, "bgra8": 4}.get(image.encoding, 3)
    rows = image.data.reshape(image.height, image.step)[:, : image.width * channels]
    pixels = _thinned(rows.reshape(image.height, image.width, channels))[..., list(order)]
    return pixels[::-1], (0.0, 0.0, image.width / max(image.height, 1), 1.0)


def _map(message: bytes) -> tuple[Pixels, tuple[float, float, float, float]]:
    grid = read(GRID, message)
    info: Any = grid.info
    cells = _thinned(grid.data.astype(np.int16).reshape(info.height, info.width, 1))[..., 0]
    shade = np.clip(cells, 0, 100)[..., None] / 100
    pixels = (np.array(_FREE) * (1 - shade) + np.array(_WALL) * shade).astype(np.uint8)
    pixels[cells < 0] = _UNKNOWN
    corner = info.origin.position
    return pixels, (corner.x, corner.y, info.width * info.resolution, info.height * info.resolution)


def _thinned(pixels: Any) -> Any:
    step = max(-(-max(pixels.shape[:2]) // MOST), 1)
    return pixels[::step, ::step]
