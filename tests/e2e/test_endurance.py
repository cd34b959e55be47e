"""What a long run shows: memory stays flat, and equal seeds give equal packets."""

from __future__ import annotations

import mmap
import os
import random
import subprocess
import sys
import threading

import pytest
from gnuradio import gr

from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.paper import RosSource
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.phy.ofdm import OfdmPhy
from gr_ros2.settings.registry import Registry
from tests.domains import free_domains
from tests.gr.probe import Probe
from tests.middleware.support import STRING
from tests.packets import data_of
from tests.phy.loopback import Loopback
from tests.waiting import wait_for

GROWTH_BYTES = 500_000
"""55 bytes a message: an event or the bytes of each, if kept, would show."""


@pytest.mark.slow
def test_memory_is_flat_over_18_000_messages() -> None:
    command = [sys.executable, "-m", "tests.e2e.endurance"]
    environment = {**os.environ, "PYTHONMALLOC": "malloc"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    grown = int(done.stdout)
    assert grown < GROWTH_BYTES, f"{grown} bytes more for 9,000 messages"


def submissions(seed: int) -> list[tuple[int, bytes, float]]:
    """(topic id, payload, time) of three topics with different sizes and rates."""
    rng = random.Random(seed)
    times = sorted((rng.uniform(0, 5), topic_id) for topic_id in range(3) for _ in range(100))
    return [(topic_id, rng.randbytes(rng.choice((20, 120, 724))), at) for at, topic_id in times]


def engine_packets(seed: int) -> list[bytes]:
    config = paper_from(robot=1, packet_len=64, packet_rate=400.0, queue_depth=0)
    registry = Registry.from_rows({"a": STRING, "b": STRING, "c": STRING})
    sender = Sender(registry, *config, rng=random.Random(seed))
    packets: list[bytes] = []
    for topic_id, payload, at in submissions(5):
        while (due := sender.next_timeout()) is not None and due <= at:
            packets.append(data_of(sender.next_packet(max(due, 0.0))) or b"")
        sender.submit(topic_id, payload, at)
    while (data := data_of(sender.next_packet(1e6))) is not None:
        packets.append(data)
    return packets


def block_packets(seed: int) -> list[bytes]:
    """The same from the GNU Radio block, everything submitted before it starts."""
    registry = Registry.from_rows({"a": STRING, "b": STRING, "c": STRING})
    with MemoryMiddleware(domain_id=free_domains(1)[0]) as graph:
        source = RosSource(
            registry,
            middleware=graph,
            robot=1,
            graph_namespace="",
            packet_len=64,
            graph_depth=0,
            queue_depth=0,
            seed=seed,
        )
        publishers = [graph.advertise(f"/{name}", STRING, Qos(depth=0)) for name in "abc"]
        for topic_id, payload, _ in submissions(5):
            publishers[topic_id].publish(payload)
        wait_for(lambda: sum(t["submitted"] for t in source.stats()["topics"].values()) == 300, "all messages")
        probe = Probe()
        flowgraph = gr.top_block()
        flowgraph.msg_connect(source, "pdus", probe, "pdus")
        flowgraph.start()
        wait_for(lambda: source.idle and source.stats()["packets"] == len(probe.messages), "all packets")
        flowgraph.stop()
        flowgraph.wait()
        source.close()
        return probe.packets


def test_equal_seeds_give_equal_packets() -> None:
    first = engine_packets(1)
    assert b"" not in first
    assert len(first) > 300
    assert engine_packets(1) == first
    other = engine_packets(2)
    assert other != first
    assert len(other) == len(first)


def test_engine_and_block_agree_on_the_order_of_packets() -> None:
    registry = Registry.from_rows({"a": STRING, "b": STRING, "c": STRING})
    sender = Sender(registry, *paper_from(robot=1, packet_len=64, queue_depth=0), rng=random.Random(7))
    for topic_id, payload, _ in submissions(5):
        sender.submit(topic_id, payload, 0.0)
    expected = []
    while (data := data_of(sender.next_packet(0.0))) is not None:
        expected.append(data)
    assert block_packets(7) == expected


def test_a_flowgraph_starts_while_other_threads_map_memory() -> None:
    # GNU Radio's buffers lose that race now and then; without a second attempt a run would die at random.
    over = threading.Event()
    started = 0

    def churn() -> None:
        while not over.is_set():
            maps = [mmap.mmap(-1, 65536 * size) for size in (1, 2, 3, 8)]
            for one in maps:
                one.close()

    threads = [threading.Thread(target=churn) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(5):
            with Loopback(OfdmPhy(64, 1e6), Probe(), Probe()):
                started += 1
    finally:
        over.set()
        for thread in threads:
            thread.join()
    assert started == 5
