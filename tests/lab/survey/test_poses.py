"""Where a robot is, from messages of the usual types; and where on the earth."""

from __future__ import annotations

import json
from math import hypot, nan, pi, sin
from typing import Any

import numpy as np
import pytest

from gr_ros2.observe.positions import humble_types
from gr_ros2_lab.survey.geojson import geojson
from gr_ros2_lab.survey.poses import FIX, TRANSFORMS, GeoFrame, GeoOrigin, pose_reader
from tests.lab.survey.test_survey import row

TYPE = humble_types().types


def cdr(message: Any, type_name: str) -> bytes:
    return bytes(humble_types().serialize_cdr(message, type_name))


def header(frame: str = "map") -> Any:
    return TYPE["std_msgs/msg/Header"](stamp=TYPE["builtin_interfaces/msg/Time"](sec=1, nanosec=0), frame_id=frame)


def pose(x: float, y: float) -> Any:
    place = TYPE["geometry_msgs/msg/Point"](x=x, y=y, z=0.0)
    return TYPE["geometry_msgs/msg/Pose"](
        position=place, orientation=TYPE["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    )


def fix(latitude: float, longitude: float, status: int = 0) -> bytes:
    return cdr(
        TYPE[FIX](
            header=header(),
            status=TYPE["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
            latitude=latitude,
            longitude=longitude,
            altitude=0.0,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        ),
        FIX,
    )


def transform(parent: str, child: str, x: float, y: float, yaw: float = 0.0) -> Any:
    turn = TYPE["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=sin(yaw / 2), w=float(np.cos(yaw / 2)))
    moved = TYPE["geometry_msgs/msg/Vector3"](x=x, y=y, z=0.0)
    return TYPE["geometry_msgs/msg/TransformStamped"](
        header=header(parent),
        child_frame_id=child,
        transform=TYPE["geometry_msgs/msg/Transform"](translation=moved, rotation=turn),
    )


def test_poses_of_the_usual_types_are_read() -> None:
    covered = TYPE["geometry_msgs/msg/PoseWithCovariance"](pose=pose(3.0, -4.0), covariance=np.zeros(36))
    still = TYPE["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = TYPE["geometry_msgs/msg/TwistWithCovariance"](
        twist=TYPE["geometry_msgs/msg/Twist"](linear=still, angular=still), covariance=np.zeros(36)
    )
    made = {
        "nav_msgs/msg/Odometry": {"child_frame_id": "", "pose": covered, "twist": twist},
        "geometry_msgs/msg/PoseStamped": {"pose": pose(3.0, -4.0)},
        "geometry_msgs/msg/PoseWithCovarianceStamped": {"pose": covered},
    }
    for type_name, members in made.items():
        read = pose_reader(type_name, "base_link", GeoFrame())
        assert read is not None
        found = read(cdr(TYPE[type_name](header=header(), **members), type_name))
        assert found is not None
        assert found[:2] == (3.0, -4.0)
        assert read(b"\0\1\0\0junk") is None
    assert pose_reader("std_msgs/msg/String", "base_link", GeoFrame()) is None


def test_places_on_the_earth_become_metres_and_go_back() -> None:
    earth = GeoFrame()
    read = pose_reader(FIX, "", earth)
    assert read is not None
    assert read(fix(48.0, 9.0)) == (0.0, 0.0, 48.0, 9.0)
    found = read(fix(48.001, 9.001))
    assert found is not None
    assert found[1] == pytest.approx(111.2, abs=0.3), "a thousandth of a degree to the north"
    assert found[0] == pytest.approx(74.4, abs=0.3)
    assert GeoOrigin(48.0, 9.0).geographic(*found[:2]) == pytest.approx((48.001, 9.001), abs=1e-9)
    for bad in (fix(48, 9, status=-1), fix(nan, 9), b"\0\1\0\0"):
        assert read(bad) is None
    assert hypot(*GeoOrigin(0, 179.999).local(0, -179.999)) < 250, "over the date line"


def test_transforms_are_followed_to_the_frame_without_a_parent() -> None:
    read = pose_reader(TRANSFORMS, "base_link", GeoFrame())
    assert read is not None

    def heard(*transforms: Any) -> Any:
        return read(cdr(TYPE[TRANSFORMS](transforms=list(transforms)), TRANSFORMS))

    assert heard(transform("map", "odom", 10.0, 0.0, pi / 2)) is None, "nothing of the robot yet"
    assert heard(transform("odom", "base_link", 2.0, 1.0))[:2] == pytest.approx((9.0, 2.0))
    assert heard(transform("base_link", "map", 0.0, 0.0)) is None, "frames in a circle"


def test_rows_become_points_on_a_map_of_the_earth() -> None:
    assert geojson([row(1.0)]) is None
    told = geojson([row(1.0, latitude=48.0, longitude=9.0), row(2.0)], GeoOrigin(48.0, 9.0))
    assert told is not None
    first, second = json.loads(told)["features"]
    assert first["geometry"]["coordinates"] == [9.0, 48.0]
    assert second["geometry"]["coordinates"][0] == pytest.approx(9.0000269, abs=1e-6)
    assert first["properties"]["snr_db"] is None
    assert first["properties"]["loss"] == 0
