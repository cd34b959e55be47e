"""GNU Radio's socket PDUs between a source and a sink: what one end sends comes out at the other."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import pytest
from gnuradio import gr, network

from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.paper import RosSink, RosSource
from gr_ros2.settings.registry import Registry
from tests.domains import free_ports
from tests.gr.ends import link
from tests.waiting import wait_for

REGISTRY = Registry.from_rows({"text": "std_msgs/String"})
PACKET_LEN = 64
MESSAGES = 400


def text(number: int) -> bytes:
    data = f"message number {number} {'x' * 30}".encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


@pytest.fixture
def blocks() -> Iterator[list[Any]]:
    made: list[Any] = []
    yield made
    for block in reversed(made):
        if isinstance(block, gr.top_block):
            block.stop()
            block.wait()
        else:
            block.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mtu", "rate"), [("TCP", 10000, 5000), ("TCP", 100 * PACKET_LEN, 1e5), ("UDP", 10000, 500)]
)
@pytest.mark.parametrize("version", [0, 1])
def test_all_packets_come_through_a_socket(blocks: list[Any], kind: str, mtu: int, rate: float, version: int) -> None:
    here, there = (MemoryMiddleware(domain_id=domain_id) for domain_id in (171, 172))
    shared = {"packet_len": PACKET_LEN, "graph_middleware": "memory"}
    sends = {"graph_domain_id": 171, "robot": "/robot_1", "packet_rate": rate, "queue_depth": 0, "graph_depth": 0}
    if version:
        takes = link(direction="receive", robot=2, graph_domain_id=172, **shared)
        gives = link(direction="send", registry=REGISTRY, **sends, **shared)
        sink, source = takes.sink, gives.source
        blocks += [takes, gives]
    else:
        sink, source = RosSink(REGISTRY, graph_domain_id=172, **shared), RosSource(REGISTRY, **sends, **shared)
    receiver, sender = gr.top_block(), gr.top_block()
    blocks += [here, there, sink, source, receiver, sender]
    port = str(*free_ports(1, socket.SOCK_STREAM if kind == "TCP" else socket.SOCK_DGRAM))
    receiver.msg_connect(network.socket_pdu(f"{kind}_SERVER", "127.0.0.1", port, mtu, False), "pdus", sink, "pdus")
    receiver.start()
    sender.msg_connect(source, "pdus", network.socket_pdu(f"{kind}_CLIENT", "127.0.0.1", port, mtu, False), "pdus")
    heard: list[bytes] = []
    there.subscribe("/rx_robot_1/text", "std_msgs/String", Qos(depth=0), heard.append)
    publisher = here.advertise("/robot_1/text", "std_msgs/String", Qos("reliable", "volatile", 1000))
    sender.start()
    wait_for(publisher.matched)
    sent = [text(number) for number in range(MESSAGES)]
    for message in sent:
        publisher.publish(message)
    wait_for(lambda: len(heard) >= MESSAGES, progress=lambda: len(heard))
    assert heard == sent
    assert sink.stats()["rejected"] == {}
