"""Topics that a source finds on its graph, and how a sink beside it publishes them: version 1, no loss."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pytest
from gnuradio import gr

from gr_ros2.cli.link import status_line
from gr_ros2.gr.early import MESSAGES
from gr_ros2.middleware import Middleware, Publisher, Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.middleware.memory import MemoryMiddleware
from tests.domains import free_domains
from tests.gr.ends import link
from tests.middleware.support import STRING, Peer
from tests.waiting import wait_for

INT32 = "std_msgs/msg/Int32"


class Pair:
    """A source that finds its topics, a sink that receives its packets, and a participant on the graph of each."""

    def __init__(self, make: Callable[..., Middleware], *, sinks: Callable[..., Middleware] | None = None) -> None:
        domains = free_domains()
        self.near, self.far = (make(domain_id=domain) for domain in domains)
        self.graph = None if sinks is None else sinks(domain_id=domains[1])
        source: dict[str, Any] = {"robot": 1, "graph_domain_id": domains[0], "queue_depth": 0, "graph_depth": 0}
        source |= {"graph_namespace": "", "direction": "send", "graph_middleware": self.near.name}
        sink: dict[str, Any] = {"robot": 2, "graph_domain_id": domains[1], "publish_depth": 0, "direction": "receive"}
        sink |= {"graph_middleware": self.near.name, "middleware": self.graph}
        self.ends = link(**source), link(**sink)
        self.source, self.sink = self.ends[0].source, self.ends[1].sink
        self.top = gr.top_block()
        self.top.msg_connect((self.source, "pdus"), (self.sink, "pdus"))

    def __enter__(self) -> Pair:
        self.top.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.top.stop()
        self.top.wait()
        for end in (*self.ends, self.near, self.far):
            end.close()
        if self.graph is not None:
            self.graph.close()

    def sends(self, topic: str, type_name: str) -> bool:
        found = self.source.subscriptions.subscribed.get(topic)
        return found is not None and found.type_name == type_name


def numbered(number: int) -> bytes:
    return b"\0\1\0\0" + number.to_bytes(4, "little")


def text(number: int) -> bytes:
    words = f"{number:03d}\0".encode()
    return b"\0\1\0\0" + len(words).to_bytes(4, "little") + words


@pytest.mark.parametrize("make", [MemoryMiddleware, DdsMiddleware])
def test_a_publisher_that_comes_back_with_another_type_is_carried_again(make: Callable[..., Middleware]) -> None:
    with Pair(make) as pair:
        heard: dict[str, list[bytes]] = {STRING: [], INT32: []}
        for type_name, payloads in heard.items():
            pair.far.subscribe("/rx_robot_1/count", type_name, Qos("reliable", "volatile", 0), payloads.append)
        said: dict[str, list[bytes]] = {STRING: [], INT32: []}
        for start, type_name, payload in ((0, STRING, text), (0, INT32, numbered), (40, STRING, text)):
            publisher = pair.near.advertise("/count", type_name, Qos("reliable", "volatile", 0))
            wait_for(lambda kind=type_name: pair.sends("/count", kind), f"{type_name} to be taken up")  # type: ignore[misc]
            wait_for(publisher.matched, "the source's subscription")
            for number in range(start, start + 40):
                said[type_name].append(payload(number))
                publisher.publish(said[type_name][-1])
            wait_for(lambda kind=type_name: heard[kind] == said[kind], f"40 of {type_name}")  # type: ignore[misc]
            publisher.close()
        counted = lambda: pair.sink.stats()["topics"]["/rx_robot_1/count"]["delivered"]  # noqa: E731
        wait_for(lambda: counted() == 120, "the count of what was heard")
        stats = {"source": pair.source.stats(), "sink": pair.sink.stats()}
        assert stats["source"]["topics"]["/count"]["submitted"] == 120
        assert len(pair.source.subscriptions.registry) == 2
        rest = {"packets": {"in": 1, "out": 1, "refused": 0, "damaged": 0}, "airtime": {"transmits": True}}
        rest |= {"uptime_s": 1.0, "peers": []}
        line = status_line({**stats, **rest, "phy": {"snr_db": None}, "front_end": {"lost": {}}})
        assert f"/count is {STRING} now" in line
        published = [info.type_name for info in pair.far.discover() if info.publishers]
        assert published == [STRING]


SUBSCRIBERS = """
import sys
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
with DdsMiddleware(domain_id=int(sys.argv[1])) as graph:
    for topic in sys.argv[3:]:
        say = lambda _, topic=topic: print("heard", topic, flush=True)
        graph.subscribe(topic, sys.argv[2], Qos("best_effort", "volatile"), say)
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.mark.slow
def test_the_first_message_of_a_topic_reaches_best_effort_subscribers() -> None:
    topics = [f"topic_{number}" for number in range(30)]
    wanted = {f"/rx_robot_1/{name}" for name in topics}
    with Pair(DdsMiddleware) as pair:
        listener = Peer([sys.executable, "-c", SUBSCRIBERS, str(pair.far.domain_id), INT32, *sorted(wanted)])
        try:
            wait_for(lambda: wanted <= {info.topic for info in pair.far.discover()}, "the subscribers")
            for number, name in enumerate(topics):
                publisher = pair.near.advertise(f"/{name}", INT32, Qos("reliable", "volatile"))
                wait_for(publisher.matched, "the source's subscription")
                publisher.publish(numbered(number))
            wait_for(lambda: listener.heard == wanted, "every subscriber")
        finally:
            listener.close()
        delivered = lambda: [topic["delivered"] for topic in pair.sink.stats()["topics"].values()]  # noqa: E731
        wait_for(lambda: delivered() == [1] * len(topics), "the counts of what was heard")


class Slow(MemoryMiddleware):
    """A graph whose subscribers are found when the test says so."""

    settling_s = 0.001

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.blind = True

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Publisher:
        publisher = super().advertise(topic, type_name, qos)
        found = publisher.matched
        publisher.matched = lambda: 0 if self.blind else found()  # type: ignore[method-assign]
        return publisher


def test_what_waits_for_subscribers_leaves_in_order_and_never_grows() -> None:
    with Pair(MemoryMiddleware, sinks=Slow) as pair:
        heard: list[bytes] = []
        pair.far.subscribe("/rx_robot_1/count", INT32, Qos("reliable", "volatile", 0), heard.append)
        publisher = pair.near.advertise("/count", INT32, Qos("reliable", "volatile", 0))
        wait_for(publisher.matched, "the source's subscription")
        sent = [numbered(number) for number in range(3 * MESSAGES)]
        for payload in sent:
            publisher.publish(payload)
        wait_for(lambda: heard == sent, "all messages, although no subscriber is found")
