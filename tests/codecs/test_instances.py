"""Instances: who a message speaks of, and messages taken apart and joined."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gr_ros2.codecs.instances import FIELDS, Instances
from gr_ros2.codecs.messages import header_of, read, store, write
from gr_ros2.core.errors import ConfigError, DamagedError

TYPES = store().types
TF = "tf2_msgs/msg/TFMessage"


def header(sec: int = 1) -> Any:
    return header_of(TYPES["builtin_interfaces/msg/Time"](sec, 0), "base")


def transform(child: str, sec: int = 1, x: float = 0.0) -> Any:
    return TYPES["geometry_msgs/msg/TransformStamped"](
        header=header(sec),
        child_frame_id=child,
        transform=TYPES["geometry_msgs/msg/Transform"](
            translation=TYPES["geometry_msgs/msg/Vector3"](x=x, y=0.0, z=0.0),
            rotation=TYPES["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        ),
    )


def transforms(*children: str) -> bytes:
    return write(TF, transforms=[transform(child) for child in children])


def diagnostics(*names: str, sec: int = 1) -> bytes:
    status = TYPES["diagnostic_msgs/msg/DiagnosticStatus"]
    return write(
        "diagnostic_msgs/msg/DiagnosticArray",
        header=header(sec),
        status=[status(level=0, name=name, message="", hardware_id="", values=[]) for name in names],
    )


def joints(*names: str) -> bytes:
    zeros = np.zeros(len(names))
    return write(
        "sensor_msgs/msg/JointState", header=header(), name=list(names), position=zeros, velocity=zeros, effort=zeros
    )


def test_each_transform_has_its_child_frame_for_a_key() -> None:
    instances = Instances(TF)
    assert instances.keys(transforms("odom", "base_link")) == ("odom", "base_link")
    assert instances.keys(transforms()) == ()
    parts = instances.parts(transforms("odom", "base_link"))
    assert [part.key for part in parts] == ["odom", "base_link"]
    assert parts[1].message == transforms("base_link")


def test_a_state_of_joints_is_one_instance_whose_key_is_its_joints() -> None:
    instances = Instances("sensor_msgs/msg/JointState")
    arm, wheels = joints("elbow", "wrist"), joints("left", "right")
    assert instances.keys(arm) == (("elbow", "wrist"),)
    assert instances.joined([*instances.parts(arm), *instances.parts(wheels), *instances.parts(arm)]) == [arm, wheels]


def test_diagnostics_join_where_their_headers_are_equal() -> None:
    instances = Instances("diagnostic_msgs/msg/DiagnosticArray")
    one, two, later = diagnostics("motor"), diagnostics("lidar", "gps"), diagnostics("motor", sec=2)
    parts = [part for message in (one, two, later) for part in instances.parts(message)]
    assert [part.key for part in parts] == ["motor", "lidar", "gps", "motor"]
    assert instances.joined(parts) == [diagnostics("motor", "lidar", "gps"), later]


def test_markers_are_told_apart_by_namespace_and_id() -> None:
    types = TYPES

    def marker(ns: str, number: int) -> Any:
        zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        pose = types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0),
            orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        )
        colour = types["std_msgs/msg/ColorRGBA"](r=0.0, g=0.0, b=0.0, a=0.0)
        time = types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        made = types["visualization_msgs/msg/Marker"]
        known = {
            "header": header(), "ns": ns, "id": number, "type": 1, "action": 0, "pose": pose, "scale": zero,
            "color": colour, "lifetime": time, "frame_locked": False, "points": [], "colors": [],
            "texture_resource": "",
            "texture": types["sensor_msgs/msg/CompressedImage"](header(), "", np.zeros(0, "u1")),
            "uv_coordinates": [], "text": "", "mesh_resource": "",
            "mesh_file": types["visualization_msgs/msg/MeshFile"]("", np.zeros(0, "u1")),
            "mesh_use_embedded_materials": False,
        }  # fmt: skip
        return made(**known)

    message = write("visualization_msgs/msg/MarkerArray", markers=[marker("a", 1), marker("a", 2), marker("b", 1)])
    assert Instances("visualization_msgs/msg/MarkerArray").keys(message) == (("a", 1), ("a", 2), ("b", 1))
    alone = write("visualization_msgs/msg/Marker", **{
        name: getattr(marker("c", 7), name) for name in marker("c", 7).__dataclass_fields__ if not name.isupper()
        and name != "__msgtype__"
    })  # fmt: skip
    assert Instances("visualization_msgs/msg/Marker").keys(alone) == (("c", 7),)


def test_every_type_of_the_table_has_its_fields() -> None:
    for type_name in FIELDS:
        assert Instances(type_name)


def test_a_type_of_the_user_names_its_field() -> None:
    own = get_typestore(Stores.ROS2_HUMBLE)
    own.register(get_types_from_msg("uint8 number", "fleet/msg/Robot"))
    own.register(get_types_from_msg("Robot who\nfloat32 charge", "fleet/msg/Battery"))
    robot, battery = own.types["fleet/msg/Robot"], own.types["fleet/msg/Battery"]
    message = bytes(own.serialize_cdr(battery(who=robot(number=3), charge=0.5), "fleet/msg/Battery"))
    instances = Instances("fleet/msg/Battery", "who.number", own)
    assert instances.keys(message) == (3,)
    assert instances.parts(message)[0].message == message


@pytest.mark.parametrize(
    ("type_name", "fields", "text"),
    [
        ("std_msgs/msg/String", "", "std_msgs/msg/String is not known to have instances"),
        ("fleet/msg/Nothing", "name", "fleet/msg/Nothing is not defined here"),
        (TF, "transforms[].child", "there is no 'child'"),
        (TF, "transforms[].header", "is a message, not a number or a text"),
        (TF, "frames[].id", "there is no 'frames'"),
        (TF, "transforms[].child_frame_id, name", "is not one list of the message"),
        (
            "sensor_msgs/msg/JointState",
            "position[].x",
            "position of sensor_msgs/msg/JointState is not a list",
        ),
    ],
)
def test_a_wrong_field_is_named(type_name: str, fields: str, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Instances(type_name, fields)
    assert text in str(caught.value)


def test_what_is_not_a_message_is_damaged() -> None:
    for method in (Instances(TF).keys, Instances(TF).parts):
        with pytest.raises(DamagedError):
            method(transforms("odom")[:20])


@given(st.lists(st.lists(st.sampled_from("abcde"), max_size=4), max_size=5))
def test_the_newest_of_each_key_comes_out_of_what_is_joined(messages: list[list[str]]) -> None:
    instances = Instances(TF)
    newest: dict[str, float] = {}
    parts = []
    for number, children in enumerate(messages):
        message = write(TF, transforms=[transform(child, x=float(number)) for child in children])
        parts += instances.parts(message)
        newest |= dict.fromkeys(children, float(number))
    joined = instances.joined(parts)
    assert len(joined) == bool(newest)
    found = [each for message in joined for each in read(TF, message).transforms]
    assert {each.child_frame_id: each.transform.translation.x for each in found} == newest
    assert len(found) == len(newest)
