"""`gr-ros2 demo` as a user has it, and subscribers in other processes as the only witnesses."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from gnuradio import gr

from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.record.result import read_result
from tests.codecs.scenes import grid
from tests.domains import free_domains
from tests.e2e.support import COMMAND, check_books, delivered_bag, set_options
from tests.gr.ends import link
from tests.middleware.support import LATCHED, Peer, same
from tests.programs import run_program
from tests.waiting import wait_for

ODOM, GRID = "nav_msgs/msg/Odometry", "nav_msgs/msg/OccupancyGrid"


@contextmanager
def subscriber(domain: int, topic: str, type_name: str) -> Iterator[Peer]:
    """Another process on a graph; it adapts to what it finds there."""
    words = [str(domain), topic, type_name, "sub", "adapt", "adapt", "1000"]
    command = [sys.executable, "-m", "tests.middleware.dds_peer", *words]
    peer = Peer(command, {"ROS_LOCALHOST_ONLY": "1"})
    try:
        wait_for(lambda: peer.ready, "the subscriber's start")
        yield peer
    finally:
        peer.close()


@pytest.mark.slow
def test_the_demo_loses_a_tenth_of_its_packets_and_every_message_arrives(tmp_path: Path) -> None:
    """As it is shipped, but in simulated time: a computer that is late repairs too late."""
    out = tmp_path / "out"
    done = run_program(
        [*COMMAND, "demo", "--set", "time=packets", "--no-report", "--out", str(out)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result = read_result(out)
    check_books(result)
    assert len(result.topics) == 6
    assert all(topic.pdr == 1.0 for topic in result.topics), [(topic.topic, topic.ledger) for topic in result.topics]
    assert result.packets["air_repair"] > 0
    heard, sent = result.packets["received"], result.packets["sent"]
    assert 0.85 < heard / sent < 0.95, "a tenth is lost, by the channel of the scenario"


@pytest.mark.slow
@pytest.mark.real_time
def test_the_demo_reaches_an_independent_subscriber_by_radio_only(tmp_path: Path) -> None:
    sending, receiving = free_domains()
    out = tmp_path / "out"
    # A busy computer falls behind the radio's clock: then it has room for what waits, and the time to catch up.
    patient = ["drain_s=60", "queue_depth=0", "hold_s=60"]
    options = set_options([f"robots.0.graph.domain_id={sending}", f"robots.1.graph.domain_id={receiving}", *patient])
    with ExitStack() as stack:
        arrived = stack.enter_context(subscriber(receiving, "/rx_robot_1/odom", ODOM))
        not_sent_there = stack.enter_context(subscriber(sending, "/rx_robot_1/odom", ODOM))
        not_leaked = stack.enter_context(subscriber(receiving, "/robot_1/odom", ODOM))
        sent = stack.enter_context(subscriber(sending, "/robot_1/odom", ODOM))
        done = run_program(
            [*COMMAND, "demo", "--duration", "4", "--pictures", "--out", str(out), *options],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        result = read_result(out)
        odom = next(topic for topic in result.topics if topic.topic == "/robot_1/odom")
        assert len(arrived.received) > 5
        # The subscribers ran all along: what came out is what went in, and nowhere else.
        assert all(any(same(got, one, 3) for one in sent.received) for got in arrived.received[5:])
        assert not_sent_there.received == not_leaked.received == []
    check_books(result)
    assert {topic.topic for topic in result.topics} == {
        f"/robot_1/{name}" for name in ("scan", "odom", "imu", "cmd_vel", "map", "clock")
    }
    assert len(delivered_bag(out, "/rx_robot_1/odom")) == odom.delivered
    assert odom.path_error_m is not None
    assert all((out / name).stat().st_size > 1000 for name in ("path.png", "latency.png"))
    assert "/robot_1/odom" in done.stdout
    assert "samples/s, chosen to carry 120% of the messages uncompressed" in done.stdout
    assert f"Delivered: {sum(topic.delivered for topic in result.topics)} of " in done.stdout
    assert "Air in use: the channel of robot 1" in done.stdout.replace("\n", " ")
    assert result.packets["air_report"] > 0


def test_a_late_joiner_on_the_receiving_graph_gets_the_map() -> None:
    sending, receiving = free_domains()
    registry = Registry.from_rows({"map": GRID})
    map_ = grid(np.zeros((60, 80)), 7)
    with ExitStack() as stack:
        robot = stack.enter_context(DdsMiddleware(domain_id=sending, node_name="robot", localhost_only=True))
        there = stack.enter_context(DdsMiddleware(domain_id=sending, node_name="source", localhost_only=True))
        here = stack.enter_context(DdsMiddleware(domain_id=receiving, node_name="sink", localhost_only=True))
        robot.advertise("/robot_1/map", GRID, LATCHED).publish(map_)
        # The source comes after the map was published, and the subscriber after it crossed the link.
        sends = link(registry=registry, middleware=there, robot="/robot_1", direction="send")
        stack.callback(sends.close)
        takes = link(middleware=here, robot=2, direction="receive")
        stack.callback(takes.close)
        sink = takes.sink
        graph = gr.top_block()
        graph.msg_connect(sends.source, "pdus", sink, "pdus")
        graph.start()
        stack.callback(graph.wait)
        stack.callback(graph.stop)
        wait_for(lambda: sink.stats()["topics"], "the map at the sink")
        with subscriber(receiving, "/rx_robot_1/map", GRID) as late:
            wait_for(lambda: late.received, "the map at the late joiner")
            assert same(late.received[0], map_, 3)
