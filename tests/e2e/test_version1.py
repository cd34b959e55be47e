"""Scenarios that speak version 1 in real time: reports over a channel of their own, and several receivers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gr_ros2.link.events import Received, ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.observe.observers import LiveRun
from gr_ros2.settings.files import find_registry
from gr_ros2.wire.control import Report
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import Scenario, scenario_from
from tests.domains import free_domains
from tests.e2e.support import check_books, delivered_bag
from tests.waiting import wait_for

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

RECEIVER = 254
"""Source id of a receiver that reports and has none of its own."""


class Reports:
    """Counts the reports that leave each robot and those that arrive, and remembers what the run let it see."""

    name = "reports"
    instruments = False

    def __init__(self) -> None:
        self.sent: list[int] = []
        self.heard: list[int] = []
        self.run: LiveRun | None = None

    def run_started(self, run: LiveRun) -> None:
        self.run = run

    def run_ended(self, result: Result | None) -> None:
        pass

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        if isinstance(event, SentPacket):
            self.sent += [src_id for entry in event.packet.body if isinstance(entry, Report)]

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        if isinstance(event, Received):
            self.heard += [event.packet.src_id for entry in event.packet.body if isinstance(entry, Report)]


REPORTING = [{}, {"topics": []}]


def lossy(**settings: Any) -> Scenario:
    """Odometry over a link that loses a fifth of its packets, and waits for a busy computer."""
    return scenario_from(
        {
            "name": "lossy",
            "registry": find_registry("odom", Path()),
            "sim": {"odom_rate": 35, "robots": 2},
            "packet_len": 64,
            "robots": REPORTING,
            "graph": {"depth": 1000},
            "publish": {"depth": 1000},
            "queue_depth": 0,
            "hold_s": 60,
            "phy": {"name": "ofdm", "sample_rate": 100000, "options": {"detection_threshold": "stock"}},
            "channel": {"packet_loss": 0.2},
            "duration_s": 2.0,
            "drain_s": 60.0,
            **settings,
        }
    )


def run(scenario: Scenario, out: Path) -> tuple[Result, Reports]:
    reports = Reports()
    result = run_scenario(scenario, out, observers=[reports]).result
    check_books(result)
    return result, reports


def test_reports_cross_a_channel_of_their_own_and_losses_are_repaired(tmp_path: Path) -> None:
    result, reports = run(lossy(paths=[{"from": 2, "delay_s": 0.03}]), tmp_path)
    (odom,) = result.topics
    assert "lost_fragments" not in odom.ledger
    assert odom.ledger["repaired"] > 0
    assert len(delivered_bag(tmp_path, "/rx_robot_1/odom")) == odom.delivered
    assert set(reports.sent) == set(reports.heard) == {2}
    assert len(reports.heard) < len(reports.sent), "reports are lost too"
    assert result.packets["air_report"] > 0
    assert sum(result.packets[f"air_{kind}"] for kind in ("new", "repair", "report", "hello")) == result.packets["sent"]
    assert reports.run is not None
    assert [link.channel.seed for link in reports.run.links] == [0, 100_003]


def test_every_receiver_hears_and_reports_for_itself(tmp_path: Path) -> None:
    settings = lossy(robots=[{}, *[{"topics": []}] * 3], paths=[{"from": 1, "to": 4, "packet_loss": 0.4}])
    result, reports = run(settings, tmp_path)
    assert [receiver.number for receiver in result.receivers] == [2, 3]
    every = [result.topics[0], *(topic for receiver in result.receivers for topic in receiver.topics)]
    assert [topic.sent for topic in every] == [result.topics[0].sent] * 3
    assert all(sum(topic.ledger.values()) == topic.sent and not topic.corrupt for topic in every)
    assert all(topic.ledger["repaired"] > 0 and "lost_fragments" not in topic.ledger for topic in every)
    assert set(reports.sent) == set(reports.heard) == {2, 3, 4}
    assert len(delivered_bag(tmp_path, "/rx_robot_1/odom")) == every[0].delivered
    assert reports.run is not None
    assert [link.channel.seed for link in reports.run.links] == [0, 100_003, 100_004, 100_005]


def test_receivers_of_the_paper_have_a_graph_each() -> None:
    domains = free_domains(3)
    graphs = [MemoryMiddleware(domain_id=domain) for domain in domains[1:]]
    heard: list[list[bytes]] = [[], []]
    for graph, payloads in zip(graphs, heard, strict=True):
        graph.subscribe("/rx_robot_1/odom", "nav_msgs/msg/Odometry", Qos(), payloads.append)
    robots = [
        {"direction": way, "graph": {"domain_id": domain, "middleware": "memory", "depth": 1000}}
        for way, domain in zip(("send", "receive", "receive"), domains, strict=True)
    ]
    result = run_scenario(lossy(paper={"compression": True}, robots=robots, drain_s=1.0, hold_s=1.0)).result
    topics = [result.topics[0], *(receiver.topics[0] for receiver in result.receivers)]
    assert all(topic.delivered > 0 for topic in topics)
    wait_for(lambda: [len(got) for got in heard] == [topic.delivered for topic in topics], "every message")
    for graph in graphs:
        graph.close()
