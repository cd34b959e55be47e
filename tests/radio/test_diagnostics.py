"""What a link says of itself, heard by another participant of a real DDS."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.middleware.type_definitions import typestore
from gr_ros2.radio.config import link_from
from gr_ros2.radio.diagnostics import DIAGNOSTICS_TYPE, STATISTICS_TYPE, Diagnostics
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.config import DiagnosticsConfig
from tests.domains import domain, free_domains
from tests.waiting import wait_for


def test_a_running_link_is_diagnosed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages stamped 2 s ago come with a warning, as the limit says."""
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    (number,) = free_domains(1)
    registry = tmp_path / "topics.csv"
    registry.write_text("point,geometry_msgs/PointStamped\n")
    config = link_from(
        {
            "registry": str(registry),
            "phy": {"name": "psk", "sample_rate": 1e6},
            "front_end": {"name": "sim"},
            "channel": {"snr_db": 20.0},
            "robot": "/robot_1",
            "graph": {"domain_id": number},
            "diagnostics": {"period_s": 0.1, "latency_s": [1.0, 5.0]},
        }
    )
    began = int(time.time())
    arrays: list[Any] = []
    counters: list[Any] = []

    def warned() -> bool:
        topic = "gr_ros2_link_1: /rx_robot_1/point"
        return any(status.name == topic and status.level == 1 for array in arrays for status in array.status)

    with RobotLink(config), DdsMiddleware(domain_id=number) as listener:
        store = typestore()
        listener.subscribe(
            "/diagnostics", DIAGNOSTICS_TYPE, Qos(), lambda p: arrays.append(store.deserialize_cdr(p, DIAGNOSTICS_TYPE))
        )
        listener.subscribe(
            "/gr_ros2_link_1/statistics",
            STATISTICS_TYPE,
            Qos(),
            lambda p: counters.append(json.loads(store.deserialize_cdr(p, STATISTICS_TYPE).data)),
        )
        publisher = listener.advertise("/robot_1/point", "geometry_msgs/PointStamped", Qos("reliable"))
        wait_for(publisher.matched, "match")
        payload = b"\0\1\0\0" + struct.pack("<iIIx7x3d", int(time.time()) - 2, 0, 1, 1.0, 2.0, 3.0)
        wait_for(lambda: publisher.publish(payload) or warned(), "a warning")
        wait_for(lambda: counters and counters[-1]["sink"]["topics"], "statistics")
    receiver, transmitter, topic = arrays[-1].status
    assert (receiver.name, transmitter.name) == ("gr_ros2_link_1: receiver", "gr_ros2_link_1: transmitter")
    assert {status.hardware_id for status in arrays[-1].status} == {"gr_ros2_link_1"}
    word, seconds, _ = topic.message.split()
    assert word == "latency"
    assert float(seconds) >= 2.0
    values = {item.key: item.value for item in topic.values}
    assert 2 <= float(values["latency (s)"]) <= float(values["age (s)"]) + 0.01
    assert began <= arrays[-1].header.stamp.sec <= time.time()
    assert counters[-1]["sink"]["topics"]["/rx_robot_1/point"]["delivered"] > 0
    assert counters[-1]["phy"]["name"] == "psk"
    snr_db = {item.key: item.value for item in receiver.values}["SNR (dB)"]
    assert float(snr_db) == pytest.approx(20, abs=1.5)


def test_no_period_no_diagnostics(tmp_path: Path) -> None:
    registry = tmp_path / "topics.csv"
    registry.write_text("point,geometry_msgs/PointStamped\n")
    graph = {"middleware": "memory", "domain_id": domain()}
    config = link_from(
        {
            "registry": str(registry),
            "phy": {"name": "direct"},
            "robot": 1,
            "graph": {**graph, "namespace": ""},
            "diagnostics": {"period_s": 0},
        }
    )
    with RobotLink(config), MemoryMiddleware(domain_id=domain()) as listener:
        assert {info.topic for info in listener.discover()} == {"/point"}


def test_a_second_link_of_the_same_robot_on_one_graph_is_told(caplog: pytest.LogCaptureFixture) -> None:
    arrays: list[Any] = []
    number, store = domain(1), typestore()
    with (
        MemoryMiddleware(domain_id=number) as one,
        MemoryMiddleware(domain_id=number) as two,
        MemoryMiddleware(domain_id=number) as listener,
    ):
        listener.subscribe(
            "/diagnostics", DIAGNOSTICS_TYPE, Qos(), lambda p: arrays.append(store.deserialize_cdr(p, DIAGNOSTICS_TYPE))
        )

        def told() -> bool:
            return any(status.name == "link_1: robot id" for status in arrays[-1].status)

        first = Diagnostics(QUICK, one, "link_1", lambda: STATS)
        first.start()
        wait_for(lambda: arrays, "diagnostics")
        assert not told()
        second = Diagnostics(QUICK, two, "link_1", lambda: STATS)
        wait_for(told, "a warning of the second link")
        assert "a second link_1 is on this ROS graph" in caplog.text
        second.stop()
        wait_for(lambda: not told(), "the end of the warning")
        first.stop()


def test_two_robots_of_one_number_are_named_on_diagnostics() -> None:
    arrays: list[Any] = []
    doubled = {"robot": 7, "heard_s": 0.5, "hops": 0, "over": None, "doubled": True, "clock": None}
    store = typestore()
    with MemoryMiddleware(domain_id=domain()) as graph:
        graph.subscribe(
            "/diagnostics", DIAGNOSTICS_TYPE, Qos(), lambda p: arrays.append(store.deserialize_cdr(p, DIAGNOSTICS_TYPE))
        )
        diagnostics = Diagnostics(QUICK, graph, "link", lambda: {**STATS, "peers": [doubled]})
        diagnostics.start()
        wait_for(lambda: arrays, "diagnostics")
        diagnostics.stop()
    (status,) = (one for one in arrays[0].status if one.name == "link: numbers")
    assert status.message.startswith("two robots send as robot 7")


STATS = {
    "source": {"topics": {}},
    "sink": {
        "packets": 0,
        "packet_loss_est": 0,
        "rejected": {},
        "dropped": {},
        "silence_s": {},
        "held_bytes": 0,
        "publish_failed": 0,
        "topics": {},
    },
    "peers": [],
    "clocks": {"set": []},
    "packets": {"out": 0, "backlog": 0, "damaged": 0, "foreign": 0},
    "phy": {"airtime_s": 0.0},
    "front_end": {"name": "sim", "passed": {}, "lost": {}},
    "airtime": {"transmits": True, "sent_s": 0.0, "refused": {}},
}
QUICK = DiagnosticsConfig(period_s=0.01)


def test_a_snapshot_that_fails_is_counted_and_survived(caplog: pytest.LogCaptureFixture) -> None:
    snapshots = iter([{}, {**STATS, "uptime_s": object()}])

    def stats() -> Mapping[str, Any]:
        if diagnostics.failed < 2:
            return next(snapshots)
        if diagnostics.failed < 3:
            raise ValueError("no figures")
        return STATS

    heard: list[bytes] = []
    with MemoryMiddleware(domain_id=domain()) as graph:
        graph.subscribe("/link/statistics", STATISTICS_TYPE, Qos(), heard.append)
        diagnostics = Diagnostics(QUICK, graph, "link", stats)
        diagnostics.start()
        wait_for(lambda: heard, "statistics")
        diagnostics.stop()
    assert diagnostics.failed == 3
    assert caplog.text.count("diagnostics were not published") == 1


def test_nothing_is_published_after_the_end_however_long_a_snapshot_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2.radio.diagnostics._JOIN_S", 0.0)
    asked, answer = threading.Event(), threading.Event()

    def stats() -> Mapping[str, Any]:
        asked.set()
        answer.wait()
        return STATS

    heard: list[bytes] = []
    with MemoryMiddleware(domain_id=domain()) as graph, MemoryMiddleware(domain_id=domain()) as listener:
        for topic, kind in (("/diagnostics", DIAGNOSTICS_TYPE), ("/link/statistics", STATISTICS_TYPE)):
            listener.subscribe(topic, kind, Qos(), heard.append)
        diagnostics = Diagnostics(QUICK, graph, "link", stats)
        diagnostics.start()
        asked.wait()
        diagnostics.stop()
        answer.set()
        wait_for(lambda: not any(info.publishers for info in listener.discover()), "the thread to leave the graph")
        assert heard == []
        assert diagnostics.failed == 0


def test_a_graph_that_fails_is_counted_and_survived() -> None:
    def closed() -> Mapping[str, Any]:
        raise MiddlewareError("the graph is closed")

    graph = MemoryMiddleware(domain_id=domain())
    diagnostics = Diagnostics(QUICK, graph, "link", closed)
    graph.close()
    diagnostics.start()
    wait_for(lambda: diagnostics.failed >= 2, "two failures")
    diagnostics.stop()
    diagnostics.stop()
