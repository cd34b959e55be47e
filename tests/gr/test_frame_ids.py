"""Frame prefixes and merged transforms: only frame names change, whatever the message."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.frame_ids import MAX_STATIC, TF_TYPE, FramePrefix, MergedTransforms, StaticTransforms, prefixed_frame
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Accepted
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.middleware.type_definitions import typestore
from gr_ros2.paper import RosSink, RosSource
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.config import SendOptions, build
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import PublishConfig, robot_from
from tests.domains import free_domains
from tests.gr.ends import link
from tests.gr.probe import Hears
from tests.packets import data_of
from tests.waiting import wait_for

STORE = typestore()
ROOT = {"robot": 1, "graph_namespace": "", "direction": "send"}
PREFIX = "robot_{robot}/"
FRAMES = st.one_of(st.just(""), st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12))
ORDERS = st.booleans()
FRAMED = [
    "std_msgs/msg/Header",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path",
    "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Image",
    "geometry_msgs/msg/PolygonStamped",
    "visualization_msgs/msg/MarkerArray",
    "tf2_msgs/msg/TFMessage",
]
NUMBERS = {"float32": np.float32, "float64": np.float64}


def some(kind: Any, frame: str, rng: random.Random, store: Typestore = STORE) -> Any:
    """A message of a type with arbitrary values, and one frame name in every frame field."""
    node, detail = kind
    if node.name == "BASE":
        name = detail[0]
        if name == "string":
            return "".join(rng.choices("abc é", k=rng.randrange(6)))
        if name in NUMBERS:
            return float(NUMBERS[name](rng.uniform(-9, 9)))
        return rng.randrange(2) if name == "bool" else rng.randrange(100)
    if node.name == "NAME":
        _, members = store.fielddefs[detail]
        values = {
            name: frame if name.endswith("frame_id") else some(member, frame, rng, store) for name, member in members
        }
        return store.types[detail](**values)
    element, length = detail
    count = length if node.name == "ARRAY" else rng.randrange(4)
    items = [some(element, frame, rng, store) for _ in range(count)]
    if element[0].name == "BASE" and element[1][0] != "string":
        name = element[1][0]
        return np.array(items, dtype={"bool": "bool", "byte": "uint8", "char": "uint8"}.get(name, name))
    return items


def message(type_name: str, frame: str, seed: int, store: Typestore = STORE) -> Any:
    return some((next(iter(_kinds())), type_name), frame, random.Random(seed), store)


def _kinds() -> Iterator[Any]:
    yield STORE.fielddefs["nav_msgs/msg/Odometry"][1][0][1][0]  # a member that is a message: its kind


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Every number and string of a message with the name of its member."""
    if is_dataclass(value):
        for field in fields(value):
            if field.name != "__msgtype__":
                yield from leaves(getattr(value, field.name), field.name)
    elif isinstance(value, list):
        for item in value:
            yield from leaves(item, name)
    else:
        yield name, value.tobytes() if isinstance(value, np.ndarray) else value


def encode(type_name: str, value: Any, *, little: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(value, type_name, little_endian=little))


@pytest.mark.parametrize("type_name", FRAMED)
@given(frame=FRAMES, seed=st.integers(0, 1000), src_id=st.integers(0, 254), little=ORDERS)
def test_frame_names_change_and_nothing_else(type_name: str, frame: str, seed: int, src_id: int, little: bool) -> None:
    counters: Counter[str] = Counter()
    before = message(type_name, frame, seed)
    payload = encode(type_name, before, little=little)
    altered = FramePrefix(PREFIX, counters).apply(type_name, src_id, payload)
    after = STORE.deserialize_cdr(altered, type_name)
    assert altered[:2] == payload[:2]
    for (name, old), (same, new) in zip(leaves(before), leaves(after), strict=True):
        assert name == same
        assert new == (prefixed_frame(f"robot_{src_id}/", old) if name.endswith("frame_id") else old), name
    assert not counters


@pytest.mark.parametrize(
    ("type_name", "distribution", "frames"),
    [
        ("sensor_msgs/msg/Range", Stores.ROS2_HUMBLE, 1),
        ("sensor_msgs/msg/Range", Stores.ROS2_JAZZY, 1),
        ("visualization_msgs/msg/Marker", Stores.ROS2_FOXY, 1),
        ("geometry_msgs/msg/VelocityStamped", Stores.ROS2_JAZZY, 3),
        ("nav_msgs/msg/Trajectory", Stores.ROS2_LYRICAL, None),
    ],
)
def test_the_definition_that_fits_the_bytes_counts(type_name: str, distribution: Stores, frames: int | None) -> None:
    """Whatever distribution is sourced here: robots of all of them may send."""
    counters: Counter[str] = Counter()
    prefix, store = FramePrefix(PREFIX, counters), get_typestore(distribution)
    for seed in range(20):
        before = message(type_name, "sonar", seed, store)
        altered = prefix.apply(type_name, 3, bytes(store.serialize_cdr(before, type_name)))
        changed = [
            (old, new)
            for (_, old), (_, new) in zip(
                leaves(before), leaves(store.deserialize_cdr(altered, type_name)), strict=True
            )
            if old != new
        ]
        assert set(changed) == {("sonar", "robot_3/sonar")}
        assert frames in (None, len(changed))
    assert not counters


@given(frame=FRAMES, seed=st.integers(0, 1000))
def test_a_second_prefix_alters_nothing(frame: str, seed: int) -> None:
    prefix = FramePrefix(PREFIX, Counter())
    once = prefix.apply(TF_TYPE, 3, encode(TF_TYPE, message(TF_TYPE, frame, seed)))
    assert prefix.apply(TF_TYPE, 3, once) == once


@pytest.mark.parametrize(
    ("frame", "expected"),
    [("odom", "r/odom"), ("/odom", "r/odom"), ("", ""), ("r/odom", "r/odom"), ("r", "r/r")],
)
def test_prefixed_frame(frame: str, expected: str) -> None:
    assert prefixed_frame("r/", frame) == expected


@given(st.binary(max_size=200), st.sampled_from(FRAMED))
def test_arbitrary_bytes_never_raise(data: bytes, type_name: str) -> None:
    counters: Counter[str] = Counter()
    for payload in (data, b"\0\1\0\0" + data):
        if FramePrefix(PREFIX, counters).apply(type_name, 1, payload) is payload:
            assert counters["frame_damaged"]


def test_what_has_no_frames_or_no_definition_passes() -> None:
    counters: Counter[str] = Counter()
    prefix = FramePrefix(PREFIX, counters)
    payload = b"\0\1\0\0" + bytes(48)
    assert prefix.apply("geometry_msgs/msg/Twist", 1, payload) is payload
    assert not counters
    assert prefix.apply("robot_msgs/msg/WheelState", 1, payload) is payload
    assert counters == {"frame_unknown_type": 1}
    assert FramePrefix("", counters).apply("nav_msgs/msg/Odometry", 1, payload) is payload


def transforms(*children: str, x: float = 0.0) -> bytes:
    """A TFMessage from ``base`` to each child."""
    T = STORE.types
    time = T["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    pose = T["geometry_msgs/msg/Transform"](
        translation=T["geometry_msgs/msg/Vector3"](x=x, y=0.0, z=0.0),
        rotation=T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    stamped = [
        T["geometry_msgs/msg/TransformStamped"](
            header=T["std_msgs/msg/Header"](stamp=time, frame_id="base"), child_frame_id=child, transform=pose
        )
        for child in children
    ]
    return encode(TF_TYPE, T[TF_TYPE](transforms=stamped))


def tree(payload: bytes) -> dict[str, tuple[str, float]]:
    """Child frame -> parent frame and x."""
    found = STORE.deserialize_cdr(payload, TF_TYPE).transforms
    return {t.child_frame_id: (t.header.frame_id, t.transform.translation.x) for t in found}


def test_static_transforms_are_kept_by_child_frame() -> None:
    counters: Counter[str] = Counter()
    with MemoryMiddleware(domain_id=64) as graph, MemoryMiddleware(domain_id=64) as listener:
        merged = MergedTransforms(("/tf", "/tf_static"), graph, counters)
        for payload in (transforms("a"), transforms("b", "c"), transforms("a", x=2.0), b"\0\1\0\0\xff\xff\xff\xff"):
            merged.add(payload, static=True)
        heard: list[bytes] = []
        listener.subscribe("/tf_static", TF_TYPE, Qos(depth=0), heard.append)
        wait_for(lambda: heard)
        assert tree(heard[-1]) == {"a": ("base", 2.0), "b": ("base", 0.0), "c": ("base", 0.0)}
        assert counters == {"tf_damaged": 1}


def test_static_transforms_are_bounded() -> None:
    counters: Counter[str] = Counter()
    with MemoryMiddleware(domain_id=64) as graph:
        merged = MergedTransforms(("/tf", "/tf_static"), graph, counters)
        merged.add(transforms(*(f"f{number}" for number in range(MAX_STATIC + 2))), static=True)
        assert counters["tf_static_full"] == 2


def test_settings() -> None:
    assert PublishConfig(frame_prefix=PREFIX, merge_tf="/tf").merged_topics == ("/tf", "/tf_static")
    with pytest.raises(ConfigError, match=r"set publish\.frame_prefix"):
        robot_from(robot=1, publish_merge_tf="/tf")
    with pytest.raises(ConfigError, match=r"frame_prefix = '\{who\}': only"):
        build(PublishConfig, {"frame_prefix": "{who}"})


def test_one_broadcaster_is_left_as_it_is() -> None:
    static = StaticTransforms(Counter())
    both = transforms("a", "b") + b"\0\0"
    assert static.union(both) is both
    assert tree(static.union(transforms("c")) or b"").keys() == {"a", "b", "c"}


def test_a_source_repeats_the_static_transforms_of_all_its_broadcasters() -> None:
    """What a robot hears that comes late: one message, with the frames of both."""
    events: list[Any] = []
    rows = Registry.from_rows({"/tf_static": TF_TYPE})
    with MemoryMiddleware(domain_id=64) as graph, MemoryMiddleware(domain_id=64) as robot:
        source = link(**ROOT, registry=rows, middleware=graph, observer=Hears(events.append))
        for child in ("imu", "laser"):
            robot.advertise("/tf_static", TF_TYPE, Qos("reliable", "transient_local", 1)).publish(transforms(child))
        wait_for(lambda: len(events) >= 2)
        assert tree(events[1].payload).keys() == {"imu", "laser"}
        source.close()


def test_no_broadcaster_is_lost_to_a_small_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three of them told theirs before the source came."""
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    (domain,) = free_domains(1)
    events: list[Any] = []
    rows = Registry.from_rows({"/tf_static": TF_TYPE}).with_options({"/tf_static": SendOptions(depth=1)})
    with DdsMiddleware(domain_id=domain) as robot:
        for child in ("imu", "laser", "camera"):
            robot.advertise("/tf_static", TF_TYPE, Qos("reliable", "transient_local", 1)).publish(transforms(child))
        source = link(**ROOT, registry=rows, graph_domain_id=domain, observer=Hears(events.append))
        try:

            def told() -> list[set[str]]:
                return [set(tree(event.payload)) for event in list(events) if isinstance(event, Accepted)]

            wait_for(lambda: {"imu", "laser", "camera"} in told(), "all three in one message")
        finally:
            source.close()


REGISTRY = Registry.from_rows({"odom": "nav_msgs/Odometry", "tf": TF_TYPE, "tf_static": TF_TYPE})


def test_merged_transforms_may_not_come_back() -> None:
    rows = Registry.from_rows({"/tf": TF_TYPE})
    with MemoryMiddleware(domain_id=64) as graph:
        source = RosSource(rows, robot=1, graph_namespace="", middleware=graph)
        with pytest.raises(ConfigError, match="merge_tf"):
            RosSink(rows, middleware=graph, publish_frame_prefix=PREFIX, publish_merge_tf="/tf")
        source.close()


def packets(src_id: int, *messages: tuple[int, bytes]) -> list[bytes]:
    sender = Sender(REGISTRY, *paper_from(robot=src_id, repeat_s=0), rng=random.Random(1))
    made = []
    for topic_id, payload in messages:
        sender.submit(topic_id, payload, 0.0)
        while (data := data_of(sender.next_packet(0.0))) is not None:
            made.append(data)
    return made


def test_two_robots_on_one_graph_of_a_real_dds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both robots use the same frame names and two static broadcasters each; a late joiner gets one consistent tree."""
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    (domain,) = free_domains(1)
    odometry = encode("nav_msgs/msg/Odometry", message("nav_msgs/msg/Odometry", "odom", 1))
    sink = RosSink(REGISTRY, graph_domain_id=domain, publish_frame_prefix=PREFIX, publish_merge_tf="/tf")
    sink.outputs.announce(1, [0])
    try:
        with DdsMiddleware(domain_id=domain) as listener:
            moving: list[bytes] = []
            odometries: list[bytes] = []
            listener.subscribe("/tf", TF_TYPE, Qos(depth=0), moving.append)
            listener.subscribe("/rx_robot_1/odom", "nav_msgs/Odometry", Qos(depth=0), odometries.append)
            wait_for(lambda: sink.outputs._transforms._moving_publisher.matched() and sink.matched)
            for robot in (1, 2):
                messages = (0, odometry), (2, transforms("imu")), (2, transforms("laser")), (1, transforms("wheel"))
                for data in packets(robot, *messages):
                    sink.take([AirPacket(data)])
            wait_for(lambda: len(moving) == 2 and odometries)
            assert tree(moving[1]) == {"robot_2/wheel": ("robot_2/base", 0.0)}
            assert STORE.deserialize_cdr(odometries[0], "nav_msgs/msg/Odometry").child_frame_id == "robot_1/odom"
            latched: list[bytes] = []
            listener.subscribe("/tf_static", TF_TYPE, Qos(depth=0), latched.append)
            wait_for(lambda: latched)
            assert tree(latched[0]) == {
                f"robot_{robot}/{child}": (f"robot_{robot}/base", 0.0) for robot in (1, 2) for child in ("imu", "laser")
            }
    finally:
        sink.close()
