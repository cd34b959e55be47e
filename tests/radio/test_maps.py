"""Live links: a map that grows, and robots that come late."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.codecs.messages import GRID
from gr_ros2.middleware.memory import MemoryMiddleware
from tests.codecs import scenes
from tests.domains import domain
from tests.middleware.support import LATCHED
from tests.radio.test_instances import robot
from tests.waiting import wait_for


def test_a_growing_map_crosses_as_what_changes_and_whole_to_a_late_robot(tmp_path: Path) -> None:
    maps = list(scenes.exploring(5))
    heard: dict[int, list[bytes]] = {2: [], 3: []}
    with (
        MemoryMiddleware(domain_id=domain(1)) as near,
        MemoryMiddleware(domain_id=domain(2)) as second,
        MemoryMiddleware(domain_id=domain(3)) as third,
        robot(1, tmp_path, 2, 3) as one,
        robot(2, tmp_path, 1),
    ):
        second.subscribe("/rx_robot_1/map", GRID, LATCHED, heard[2].append)
        third.subscribe("/rx_robot_1/map", GRID, LATCHED, heard[3].append)
        mapper = near.advertise("/robot_1/map", GRID, LATCHED)
        for number, message in enumerate(maps):
            mapper.publish(message)
            wait_for(lambda number=number: len(heard[2]) == number + 1, "a map")
        assert heard[2] == maps
        topic = one.link.source.stats()["topics"]["/robot_1/map"]
        assert topic["frames"]["frames"] == len(maps)
        with robot(3, tmp_path, 1):
            wait_for(lambda: heard[3], "the late robot")
            assert heard[3] == [maps[-1]]
        assert heard[2] == maps, "what another robot asked for does not come out here"
