"""Live links: a map that grows, and robots that come late."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.codecs.grid import updated
from gr_ros2.codecs.messages import GRID, GRID_UPDATE
from gr_ros2.link.events import Delivered, ReceiverEvent, SenderEvent
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.robot_link import RobotLink
from tests.codecs import scenes
from tests.domains import domain
from tests.middleware.support import LATCHED
from tests.radio.test_instances import robot
from tests.waiting import wait_for


def box(value: int) -> bytes:
    """Some cells of a map that have changed."""
    header, cells = scenes.header(value, "map"), np.full(20, value, np.int8)
    return scenes.write(GRID_UPDATE, header=header, x=3, y=2, width=5, height=4, data=cells)


class Maps(list[Delivered]):
    """An observer of the maps that come."""

    def sender_event(self, src_id: int, event: SenderEvent) -> None: ...

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        if isinstance(event, Delivered):
            self.append(event)


@contextmanager
def listened_to(
    folder: Path, observer: Maps | None = None
) -> Iterator[tuple[MemoryMiddleware, RobotLink, dict[int, list[bytes]]]]:
    """The graph and the link of robot 1, and what comes of its map at robot 2, and at robot 3, whose link is not there
    yet."""
    heard: dict[int, list[bytes]] = {2: [], 3: []}
    with (
        MemoryMiddleware(domain_id=domain(1)) as near,
        MemoryMiddleware(domain_id=domain(2)) as second,
        MemoryMiddleware(domain_id=domain(3)) as third,
        robot(1, folder, 2, 3) as one,
        robot(2, folder, 1, observer=observer),
    ):
        second.subscribe("/rx_robot_1/map", GRID, LATCHED, heard[2].append)
        third.subscribe("/rx_robot_1/map", GRID, LATCHED, heard[3].append)
        yield near, one.link, heard


def test_a_growing_map_crosses_as_what_changes_and_whole_to_a_late_robot(tmp_path: Path) -> None:
    maps, came = list(scenes.exploring(5)), Maps()
    with listened_to(tmp_path, came) as (near, one, heard):
        mapper = near.advertise("/robot_1/map", GRID, LATCHED)
        for number, message in enumerate(maps):
            mapper.publish(message)
            wait_for(lambda number=number: len(heard[2]) == number + 1, "a map")
        assert heard[2] == maps
        topic = one.source.stats()["topics"]["/robot_1/map"]
        assert topic["frames"]["frames"] == len(maps)
        with robot(3, tmp_path, 1):
            wait_for(lambda: heard[3], "the late robot")
            assert heard[3] == [maps[-1]]
        wait_for(lambda: len(came) > len(maps), "what the late robot asked for")
        assert heard[2] == maps, "what another robot asked for does not come out here"
        assert [event.again for event in came] == [False] * len(maps) + [True] * (len(came) - len(maps))


def test_maps_of_two_nodes_and_what_changes_of_one_reach_who_is_there_and_who_comes_late(tmp_path: Path) -> None:
    own, others = list(scenes.exploring(4)), list(scenes.exploring(2, 300))
    with listened_to(tmp_path) as (near, one, heard):
        mapper, boxes = (
            near.advertise("/robot_1/map", GRID, LATCHED),
            near.advertise("/robot_1/map_updates", GRID_UPDATE, LATCHED),
        )
        mapper.publish(own[0])
        wait_for(lambda: own[0] in heard[2], "a map")
        boxes.publish(box(7))
        changed = updated(own[0], box(7))
        wait_for(lambda: heard[2][-1] == changed, "the map with a box that has changed")
        other = near.advertise("/robot_1/map", GRID, LATCHED)
        topics = one.source.stats
        for number in (1, 2, 3):
            mapper.publish(own[number])
            wait_for(lambda number=number: own[number] in heard[2], "a map")
            if number < 3:
                other.publish(others[number - 1])
                wait_for(lambda number=number: others[number - 1] in heard[2], "a map of the other")
        with robot(3, tmp_path, 1):
            wait_for(lambda: len(heard[3]) == 2, "the late robot")
            assert set(heard[3]) == {own[3], others[1]}
        assert len(heard[2]) == len(set(heard[2])) == 7, "what another robot asked for does not come out here"
        made = topics()["topics"]
        assert made["/robot_1/map"]["frames"]["frames"] >= 7
        assert made["/robot_1/map_updates"]["frames"]["words"] == "map_updates: 1 messages became part of map"
