"""The paper's two experiments on real DDS and real GNU Radio, at a rate the link carries."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2_lab.record.result import read_result
from gr_ros2_lab.run.runner import DELIVERED_BAG, run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.domains import free_domains
from tests.e2e.support import check_books, check_complete, check_identical, delivered_bag, scenario
from tests.middleware.support import RELIABLE
from tests.waiting import wait_for

ODOM_TYPE = "nav_msgs/msg/Odometry"
ODOM_BYTES = 724


def run_witnessed(name: str, out: Path, overrides: Sequence[str] = (), duration_s: float = 2.0) -> list[bytes]:
    """Run a scenario; what a witness on the sending graph heard of the robot's odometry."""
    sending, receiving = free_domains()
    heard: list[bytes] = []
    settings = [f"robots.0.graph.domain_id={sending}", f"robots.1.graph.domain_id={receiving}", *overrides]
    with DdsMiddleware(domain_id=sending, node_name="witness", localhost_only=True) as graph:
        subscription = graph.subscribe("/robot_1/odom", ODOM_TYPE, RELIABLE, heard.append)
        outcome = run_scenario(load_scenario(name, settings, duration_s=duration_s), out)
        wait_for(lambda: len(heard) >= outcome.result.topics[0].sent or not subscription.matched(), "the witness")
    check_complete(outcome.result)
    return heard


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("paper-direct", []),
        ("paper-ofdm", ["phy.sample_rate=auto", "packet_rate=auto", "drain_s=60"]),
        (
            "paper-ofdm",
            ["phy.sample_rate=2e6", "phy.options.payload_modulation=qpsk", "packet_rate=auto", "drain_s=60"],
        ),
    ],
)
@pytest.mark.slow
def test_every_message_arrives_unaltered(tmp_path: Path, name: str, overrides: list[str]) -> None:
    sent = run_witnessed(name, tmp_path, overrides)
    received = delivered_bag(tmp_path, "/rx_robot_1/odom")
    result = read_result(tmp_path)
    assert result.topics[0].delivered == len(received)
    assert {len(payload) for payload in sent} == {ODOM_BYTES}
    assert result.packets["sent"] == result.packets["received"] == 15 * len(received)
    # The witness may match after the first messages: what it heard is the end of what was sent.
    check_identical(received[-len(sent) :], sent)
    assert len(sent) > len(received) / 2


def test_the_delivered_bag_is_a_ros_2_bag(tmp_path: Path) -> None:
    outcome = run_scenario(scenario("paper-direct", duration_s=1.0), tmp_path)
    with AnyReader([tmp_path / DELIVERED_BAG]) as reader:
        messages = [
            reader.deserialize(raw, connection.msgtype) for connection, _, raw in reader.messages(reader.connections)
        ]
        assert {(each.topic, each.msgtype) for each in reader.connections} == {("/rx_robot_1/odom", ODOM_TYPE)}
    assert len(messages) == outcome.result.topics[0].delivered > 0
    stamps = [message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 for message in messages]  # type: ignore[attr-defined]
    assert stamps == sorted(stamps)
    assert {message.header.frame_id for message in messages} == {"odom"}  # type: ignore[attr-defined]


def test_an_overdriven_link_loses_messages_but_none_from_its_books(tmp_path: Path) -> None:
    result = run_scenario(scenario("paper-ofdm", duration_s=2.0), tmp_path).result
    check_books(result)
    odom = result.topics[0]
    assert odom.delivered < odom.sent
    assert len(delivered_bag(tmp_path, "/rx_robot_1/odom")) == odom.delivered
    assert set(odom.ledger) - {"delivered"}


def test_a_lossy_channel_delivers_whole_messages_only(tmp_path: Path) -> None:
    lossy = scenario("paper-direct", "channel.packet_loss=0.05", duration_s=2.0, seed=3)
    result = run_scenario(lossy, tmp_path).result
    check_books(result)
    odom = result.topics[0]
    assert 0 < odom.delivered < odom.sent
    assert {"lost_fragments", "expired"} & set(odom.ledger)
    assert {len(payload) for payload in delivered_bag(tmp_path, "/rx_robot_1/odom")} == {ODOM_BYTES}
