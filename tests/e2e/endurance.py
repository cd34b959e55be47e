"""30,000 messages through source and sink; prints how many more bytes are in use in the end. Run by test_endurance.py.

A process of its own, in which Python too takes its memory from the C library (``PYTHONMALLOC=malloc``), which counts
what is in use. The size of the process is no measure: on a busy machine more messages wait at once, and what they took
is not given back in whole. Nor is what is in use at any moment: packets are kept for hold_s, and how many have left in
that time depends on the machine. So it is read when they are over.
"""

from __future__ import annotations

import ctypes
import gc
import time
from contextlib import ExitStack
from functools import partial

from gnuradio import gr

from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.settings.registry import Registry
from tests.domains import free_domains
from tests.gr.ends import link
from tests.middleware.support import STRING, message
from tests.waiting import wait_for

MESSAGES, WARM_UP, BATCH, READ = 30_000, 12_000, 500, 3
"""Messages in all, before the first reading, and at once; and batches from one reading to the next."""
KEPT = 10
"""Packets of the newest message of each topic: they are kept until the next one."""
WINDOW_BYTES = 100_000
"""For packets that are remembered: their number no longer grows after the first messages."""
LEAST = 0.999
"""Of the messages are delivered."""


class _Mallinfo2(ctypes.Structure):
    """``struct mallinfo2`` of <malloc.h>."""

    _names = ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    _fields_ = tuple((name, ctypes.c_size_t) for name in _names)


def bytes_in_use() -> int:
    """Bytes that the process has allocated and not freed."""
    gc.collect()
    look = ctypes.CDLL(None).mallinfo2
    look.restype = _Mallinfo2
    info = look()
    return int(info.uordblks + info.hblkhd)


def growth() -> int:
    """By how many bytes more are in use in the second half of the messages after the first ones than in the first half:
    at least in each, since what threads have in hand comes and goes."""
    sending, receiving = free_domains()
    registry = Registry.from_rows({"a": STRING, "b": STRING})
    heard = [0, 0]

    def hear(which: int, _payload: bytes) -> None:
        heard[which] += 1

    with ExitStack() as stack:
        robot, listener = (stack.enter_context(MemoryMiddleware(domain_id=domain)) for domain in (sending, receiving))
        common = {"registry": registry, "packet_len": 64}
        sends = link(
            middleware=robot,
            robot=1,
            direction="send",
            graph_namespace="",
            graph_depth=0,
            queue_depth=0,
            repeat_s=0.0,
            **common,
        )
        takes = link(
            middleware=listener,
            robot=2,
            direction="receive",
            publish_depth=0,
            max_source_bytes=WINDOW_BYTES,
            **common,
        )
        stack.callback(sends.close)
        stack.callback(takes.close)
        source, sink = sends.source, takes.sink
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

        def over() -> bool:
            """Whether the packets that left earlier are over."""
            assert isinstance(source.live.endpoint, EndpointV1)
            packets = source.live.endpoint.window.packets
            with source.live.lock:
                packets.retire(time.monotonic())
                return len(packets.records) <= KEPT

        said = 0

        def say(messages: int) -> None:
            nonlocal said
            for number in range(said, said + messages):
                # One in ten takes several packets, so that reassembly is in it.
                publishers[number % 2].publish(message(number, 120 if number % 10 == 0 else 24))
            said += messages
            wait_for(partial(through, said), f"message {said}")

        used = []
        while said < MESSAGES:
            say(BATCH)
            if said > WARM_UP and said // BATCH % READ == 0:
                say(2)  # the newest of each topic, next to each other: all between them would be kept
                wait_for(over, "the end of all packets but the newest")
                used.append(bytes_in_use())
        stats = sink.stats()
    assert stats["held_bytes"] == 0
    delivered = sum(topic["delivered"] for topic in stats["topics"].values())
    # At this rate a busy machine's pause looks like an outage, beyond which fragments are not joined.
    assert delivered > LEAST * said, stats
    assert sum(heard) == delivered
    half = len(used) // 2
    return min(used[half:]) - min(used[:half])


if __name__ == "__main__":
    print(growth())
