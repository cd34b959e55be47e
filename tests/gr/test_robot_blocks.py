"""The blocks of a robot: one endpoint, and a block for reports alone where a half is missing."""

from __future__ import annotations

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.gr.factory import EndpointSetup
from gr_ros2.gr.robot_blocks import RobotBlocks
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.settings.config import SinkConfig, SourceConfig
from gr_ros2.settings.registry import Registry

ODOM = Registry.from_rows([("odom", "nav_msgs/Odometry")])


def test_both_blocks_share_one_endpoint() -> None:
    graph = MemoryMiddleware()
    blocks = RobotBlocks(ODOM, SourceConfig(robot_id=1), SinkConfig(robot_id=1), start=EndpointSetup(reports=True))
    source, sink = blocks.source(graph), blocks.sink(graph)
    assert source.src_id == 1
    assert sink.live is blocks.end
    assert [topic.name for topic in sink.registry] == ["odom"]
    for block in (source, sink, graph):
        block.close()


def test_a_half_that_is_missing_has_a_block_for_reports() -> None:
    common = {"packet_len": 99, "robot_id": 7}
    start = EndpointSetup(reports=True)
    graph = MemoryMiddleware()
    receives = RobotBlocks(ODOM, None, SinkConfig(**common), start=start)
    reports = receives.source(graph)
    assert (reports.src_id, reports.config.packet_len) == (7, 99)
    sends = RobotBlocks(ODOM, SourceConfig(**common), None, start=start)
    hears = sends.sink(graph)
    assert not hears.registry
    assert (hears.config.robot_id, hears.config.packet_len) == (7, 99)
    for block in (reports, hears, graph):
        block.close()
