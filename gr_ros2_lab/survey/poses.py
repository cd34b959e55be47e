"""Reads where a robot is from messages of the usual types.

Invariants: x and y are m in the frame of the message; of a NavSatFix they are m to the east and north of the first one.
Of transforms, the frame of the robot is followed up to the frame that has no parent.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, isfinite, nan, pi, radians
from typing import Any

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.middleware.type_definitions import DAMAGED
from gr_ros2.observe.positions import humble_types, position_reader

FIX, TRANSFORMS = "sensor_msgs/msg/NavSatFix", "tf2_msgs/msg/TFMessage"
_EARTH_M = 6_371_009.0
"""Mean radius."""
_LONGEST_CHAIN = 32

Read = tuple[float, float, float, float]
"""x and y in m, latitude and longitude in degrees."""


class GeoOrigin:
    """A place on the earth, and m to its east and north.

    :param latitude, longitude: degrees
    """

    def __init__(self, latitude: float, longitude: float) -> None:
        self._latitude, self._longitude = latitude, longitude

    def local(self, latitude: float, longitude: float) -> tuple[float, float]:
        """m to the east and north."""
        turned = (longitude - self._longitude + 180) % 360 - 180
        return radians(turned) * _EARTH_M * cos(radians(self._latitude)), radians(latitude - self._latitude) * _EARTH_M

    def geographic(self, x: float, y: float) -> tuple[float, float]:
        """Latitude and longitude in degrees."""
        north, east = y / _EARTH_M, x / (_EARTH_M * cos(radians(self._latitude)))
        return self._latitude + north * 180 / pi, self._longitude + east * 180 / pi


class GeoFrame:
    """m from the first place, for all who read places of the earth.

    :param origin: None: the first place that is read
    """

    def __init__(self, origin: GeoOrigin | None = None) -> None:
        self._origin = origin

    def local(self, latitude: float, longitude: float) -> tuple[float, float]:
        """m to the east and north."""
        if self._origin is None:
            self._origin = GeoOrigin(latitude, longitude)
        return self._origin.local(latitude, longitude)


def pose_reader(type_name: str, frame: str, earth: GeoFrame) -> Callable[[bytes], Read | None] | None:
    """A function from a serialized message to where the robot is; it returns None for a message that does not tell.

    :param type_name: ``package/msg/Type``
    :param frame: of the robot, in transforms
    :param earth: what a NavSatFix is m from
    :return: None for a type that tells no place
    """
    if type_name == FIX:
        return FixReader(earth)
    if type_name == TRANSFORMS:
        return TransformReader(frame)
    read = position_reader(type_name)
    if read is None:
        return None

    def placed(payload: bytes) -> Read | None:
        found = read(payload)
        return None if found is None else (*found, nan, nan)

    return placed


class FixReader:
    """Of NavSatFix; one without a fix does not tell."""

    def __init__(self, earth: GeoFrame) -> None:
        self._earth = earth

    def __call__(self, payload: bytes) -> Read | None:
        try:
            fix: Any = humble_types().deserialize_cdr(payload, FIX)
        except DAMAGED:
            return None
        latitude, longitude = float(fix.latitude), float(fix.longitude)
        if fix.status.status < 0 or not (isfinite(latitude) and abs(latitude) < 90 and isfinite(longitude)):
            return None
        return (*self._earth.local(latitude, longitude), latitude, longitude)


class TransformReader:
    """Of ``/tf`` and ``/tf_static``, which both go in here.

    :param frame: of the robot
    """

    def __init__(self, frame: str) -> None:
        self._frame = frame
        self._known: dict[str, tuple[str, Floats, Floats]] = {}
        """Parent, translation and turn (x, y, z, w) of each frame."""

    def __call__(self, payload: bytes) -> Read | None:
        try:
            message: Any = humble_types().deserialize_cdr(payload, TRANSFORMS)
        except DAMAGED:
            return None
        for one in message.transforms:
            moved, turn = one.transform.translation, one.transform.rotation
            values = np.array([moved.x, moved.y, moved.z, turn.x, turn.y, turn.z, turn.w], float)
            if np.isfinite(values).all():
                self._known[one.child_frame_id] = one.header.frame_id, values[:3], values[3:]
        frame, place = self._frame, np.zeros(3)
        if frame not in self._known:
            return None
        for _ in range(_LONGEST_CHAIN):
            if frame not in self._known:
                return float(place[0]), float(place[1]), nan, nan
            frame, moved_by, turned = self._known[frame]
            place = moved_by + _turned(turned, place)
        return None  # frames that are each other's parents


def _turned(turn: Floats, place: Floats) -> Floats:
    """A place turned by a quaternion (x, y, z, w)."""
    across = 2 * np.cross(turn[:3], place)
    return np.asarray(place + turn[3] * across + np.cross(turn[:3], across))
