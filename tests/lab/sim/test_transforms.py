"""A robot's transforms say where its odometry has it, and join every frame it names to the map."""

from __future__ import annotations

from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.sim.transforms import TF_TYPE, TransformPublisher
from tests.domains import domain
from tests.waiting import wait_for

STORE = get_typestore(Stores.ROS2_HUMBLE)


def heard(topic: str, graph: MemoryMiddleware, durability: Any) -> list[Any]:
    transforms: list[Any] = []
    graph.subscribe(
        topic,
        TF_TYPE,
        Qos("reliable", durability, 0),
        lambda payload: transforms.extend(STORE.deserialize_cdr(payload, TF_TYPE).transforms),  # type: ignore[attr-defined]
    )
    return transforms


@pytest.mark.parametrize("prefixed", [False, True])
def test_every_frame_hangs_on_the_map(prefixed: bool) -> None:
    settings = SimSettings(robots=1, prefix_frames=prefixed, transforms=True)
    sent = list(Fleet(settings).messages(1.0, 100.0))
    odometry = [message for message in sent if message.topic.endswith("/odom")]
    with MemoryMiddleware(domain_id=domain()) as robot, MemoryMiddleware(domain_id=domain()) as tool:
        moving = heard("/tf", tool, "volatile")
        publisher = TransformPublisher(robot, settings.frame_prefix(1))
        publisher.start(100 * 10**9)
        fixed = heard("/tf_static", tool, "transient_local")  # a tool that comes late
        for message in odometry:
            publisher.follow(message.payload)
        wait_for(lambda: len(moving) == len(odometry) and fixed, "the transforms")
        publisher.close()
    parents = {one.child_frame_id: one.header.frame_id for one in (*moving, *fixed)}
    assert len(parents) == len({(one.child_frame_id, one.header.frame_id) for one in (*moving, *fixed)})
    for message in sent:
        said: Any = STORE.deserialize_cdr(message.payload, message.type_name)
        frame = getattr(getattr(said, "header", None), "frame_id", "map")
        while frame != "map":
            frame = parents[frame]
    for one, message in zip(moving, odometry, strict=True):
        said = STORE.deserialize_cdr(message.payload, message.type_name)
        assert (one.header, one.child_frame_id) == (said.header, said.child_frame_id)
        place = said.pose.pose.position
        assert (one.transform.translation.x, one.transform.translation.y) == (place.x, place.y)
        assert one.transform.rotation == said.pose.pose.orientation
