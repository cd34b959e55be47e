"""A custom type across a link: what the nodes on either graph say about it is used, and nothing waits for that."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
from gnuradio import gr

from gr_ros2.link.events import Announced
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.settings.registry import Registry
from tests.domains import free_domains
from tests.gr.ends import link
from tests.gr.probe import Hears
from tests.middleware.describing import CUSTOM, message
from tests.middleware.support import Peer
from tests.waiting import wait_for

REGISTRY = Registry.from_rows({"wheels": CUSTOM})
SENT, RECEIVED = "/robot_1/wheels", "/rx_robot_1/wheels"


def node(domain: int, topic: str, role: str, how: str) -> Peer:
    words = [sys.executable, "-m", "tests.middleware.describing_peer", str(domain), topic, role, how]
    return Peer(words, {"ROS_LOCALHOST_ONLY": "1"})


class Link:
    """A source on one graph and a sink on another, connected without losses."""

    def __init__(self, domains: list[int], stack: ExitStack) -> None:
        graphs = [stack.enter_context(DdsMiddleware(domain_id=domain, localhost_only=True)) for domain in domains]
        sends = link(registry=REGISTRY, middleware=graphs[0], robot="/robot_1", direction="send")
        self.told: list[Any] = []
        takes = link(
            middleware=graphs[1],
            robot=2,
            direction="receive",
            publish_frame_prefix="robot_{robot}/",
            observer=Hears(self.told.append),
        )
        self.source, self.sink = sends.source, takes.sink
        top = gr.top_block()
        top.msg_connect((self.source, "pdus"), (self.sink, "pdus"))
        for block in (sends, takes):
            stack.callback(block.close)
        stack.callback(lambda: (top.stop(), top.wait()))
        top.start()

    @property
    def coding(self) -> str:
        """What the source has announced about its topic."""
        return str([event.topics[0].codec for event in list(self.told) if isinstance(event, Announced)][-1])


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.parametrize("how", ["right", "silent"])
def test_a_custom_type_is_coded_and_prefixed_by_what_its_nodes_say(how: str, stack: ExitStack) -> None:
    domains = free_domains(2)
    publisher = stack.enter_context(closing(node(domains[0], SENT, "pub", how)))
    subscriber = stack.enter_context(closing(node(domains[1], RECEIVED, "sub", how)))
    link = Link(domains, stack)
    wait_for(lambda: publisher.ready and subscriber.ready and link.source.matched, "the link to find the publisher")
    count = iter(range(100_000))

    def crosses() -> tuple[int, bytes]:
        """Number and content of a message that has crossed the link."""
        number, before = next(count), len(subscriber.received)
        publisher.publish([message(number)])
        wait_for(lambda: len(subscriber.received) > before, "the message")
        return number, subscriber.received[before]

    def arrived() -> bool:
        """Whether anything has: the first messages leave before the subscriber and the sink have found each other."""
        publisher.publish([message(next(count))])
        return bool(subscriber.received)

    wait_for(arrived, "the first message")
    last = next(count)
    publisher.publish([message(last)])
    ends = (message(last), message(last, frame="robot_1/base"))
    wait_for(lambda: subscriber.received[-1] in ends, "everything that is on its way")
    wait_for(lambda: publisher.asked and subscriber.asked, "both nodes to be asked")
    if how == "silent":
        number, payload = crosses()
        assert payload == message(number)
        assert link.coding == "auto" and link.sink.stats()["frame_unknown_type"]
        return
    wait_for(lambda: link.coding == "auto Ts*s4dRi", "the source to learn the type")

    def prefixed() -> bool:
        number, payload = crosses()
        return payload == message(number, frame="robot_1/base")

    wait_for(prefixed, "the sink to learn the type")
    wait_for(lambda: link.sink.stats()["topics"][RECEIVED]["latency_s"], "its age to be measured, after it came out")
    topic = link.sink.stats()["topics"][RECEIVED]
    assert topic["latency_s"]["measured"] and not topic["lost"]
    assert not link.sink.stats()["rejected"]
