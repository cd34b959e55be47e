"""50,000 messages through source and sink; prints by how much the process has grown. Run by test_endurance.py.

A process of its own: what other tests left to be freed, or took for good, would count otherwise.
"""

from __future__ import annotations

import gc
import resource
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from gnuradio import gr

from gr_ros2.gr import RosSink, RosSource
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.settings.registry import Registry
from tests.domains import free_domains
from tests.middleware.support import STRING, message
from tests.waiting import wait_for

MESSAGES, WARM_UP, BATCH = 50_000, 20_000, 1_000
WINDOW_BYTES = 100_000
"""For packets that are remembered. A dictionary of the 30,000 that the default allows is copied every 57,000 packets;
each copy may leave 2.6 MB of the heap unused. So few are over before the first look."""
LEAST = 0.999
"""Of the messages are delivered."""


def resident_bytes() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def growth() -> int:
    """Bytes that the process has grown by after the first messages."""
    sending, receiving = free_domains()
    registry = Registry.from_rows({"a": STRING, "b": STRING})
    heard = [0, 0]

    def hear(which: int, _payload: bytes) -> None:
        heard[which] += 1

    with ExitStack() as stack:
        robot, listener = (stack.enter_context(MemoryMiddleware(domain_id=domain)) for domain in (sending, receiving))
        source = RosSource(
            registry, middleware=robot, robot_id=1, packet_len=64, subscriber_depth=0, queue_depth=0, repeat_s=0.0
        )
        stack.callback(source.close)
        sink = RosSink(registry, middleware=listener, packet_len=64, publisher_depth=0, max_source_bytes=WINDOW_BYTES)
        stack.callback(sink.close)
        for which, name in enumerate("ab"):
            listener.subscribe(f"/rx_robot_1/{name}", STRING, Qos(depth=0), partial(hear, which))
        publishers = [robot.advertise(f"/{name}", STRING, Qos(depth=0)) for name in "ab"]
        flowgraph = gr.top_block()
        flowgraph.msg_connect(source, "pdus", sink, "pdus")
        flowgraph.start()
        stack.callback(flowgraph.wait)
        stack.callback(flowgraph.stop)

        def through(messages: int) -> bool:
            """Whether so many messages have been heard, or are lost."""
            sent = source.stats()
            if sum(topic["submitted"] for topic in sent["topics"].values()) < messages:
                return False
            if not source.idle or sink.handled < sent["packets"]:
                return False
            return sum(heard) == sum(topic["delivered"] for topic in sink.stats()["topics"].values())

        before = 0
        for done in range(0, MESSAGES, BATCH):
            if done == WARM_UP:
                before = resident_bytes()
            for number in range(done, done + BATCH):
                # One in ten takes several packets, so that reassembly is in it.
                publishers[number % 2].publish(message(number, 120 if number % 10 == 0 else 24))
            wait_for(partial(through, done + BATCH), f"message {done + BATCH}")
        grown = resident_bytes() - before
        stats = sink.stats()
    assert stats["held_bytes"] == 0
    delivered = sum(topic["delivered"] for topic in stats["topics"].values())
    # At this rate a busy machine's pause looks like an outage, beyond which fragments are not joined.
    assert delivered > LEAST * MESSAGES, stats
    assert sum(heard) == delivered
    return grown


if __name__ == "__main__":
    print(growth())
