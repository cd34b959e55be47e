"""Source -> message port -> sink, against a bare message port between two Python blocks measured in the same run.

The ROS side is a stand-in that feeds one thread into the source and counts what the sink publishes: the blocks are
measured, not a middleware. Compression and repair are off, so that each message leaves in the packets that the row
names; the packets are counted, and another count ends the bench.
"""

from __future__ import annotations

import threading
import time
from statistics import median
from typing import Any

import pmt
from gnuradio import gr

from bench.rows import Row
from gr_ros2.gr import RosLink
from gr_ros2.gr.factory import Start
from gr_ros2.middleware import Middleware, Publisher, Qos, Subscription, TopicInfo
from gr_ros2.middleware.base import MessageCallback
from gr_ros2.phy.threads import shorten_switch_interval
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig

PACKET_LEN, REPEATS = 64, 5
PACKETS = 45_000
ODOMETRY_BYTES, SMALL_BYTES = 724, 48
LEAST_MANY, LEAST_ONE = 0.18, 0.14
"""Packets/s over those of the bare port, with messages of many packets and of one."""
AS_IT_IS: dict[str, Any] = {"compression": False, "repair": "off"}
"""Settings of a source whose messages leave in the packets that their size calls for, and in no others."""
OTHERS = 0.02
"""Share of packets that may be others than those of the messages: hellos, and the table of topics."""
PATIENCE_S = 60.0

_IN, _OUT = pmt.intern("in"), pmt.intern("out")


class _Subscription(Subscription):
    def matched(self) -> int:
        return 1

    def close(self) -> None:
        pass


class _Counter(Publisher):
    def __init__(self) -> None:
        self.published = 0

    def publish(self, payload: bytes) -> None:
        del payload
        self.published += 1

    def matched(self) -> int:
        return 1

    def close(self) -> None:
        pass


class _Graph(Middleware):
    """One topic, either way."""

    name = "memory"

    def __init__(self, domain_id: int) -> None:
        super().__init__()
        self.domain_id = domain_id
        self.counter = _Counter()

    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: MessageCallback) -> Subscription:
        del topic, type_name, qos
        self.callback = callback
        return _Subscription()

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Publisher:
        del topic, type_name, qos
        return self.counter

    def discover(self) -> list[TopicInfo]:
        return []

    def close(self) -> None:
        pass


def one_way(robot: _Graph, base: _Graph, packet_len: int) -> tuple[RosLink, RosLink]:
    """A link that sends odometry as it is from one graph, and one that takes it on the other."""
    common: dict[str, Any] = {"packet_len": packet_len, "graph": {"namespace": ""}}
    sends = RosLink(
        RobotConfig(robot=1, direction="send", **common, **AS_IT_IS),
        registry=Registry.from_rows({"odom": "nav_msgs/Odometry"}),
        middleware=robot,
        backpressure=True,
        start=Start(),
    )
    return sends, RosLink(RobotConfig(robot=2, direction="receive", **common), middleware=base, start=Start())


class _Poster(gr.basic_block):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("poster", None, None)
        self.message_port_register_out(_OUT)


class _Taker(gr.basic_block):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("taker", None, None)
        self.taken = 0
        self.message_port_register_in(_IN)
        self.set_msg_handler(_IN, self._take)

    def _take(self, _pdu: Any) -> None:
        self.taken += 1


def _wait(what: Any, until: int) -> None:
    came, deadline = what(), time.perf_counter() + PATIENCE_S
    while (now := what()) < until:
        if now > came:
            came, deadline = now, time.perf_counter() + PATIENCE_S
        if time.perf_counter() > deadline:
            raise SystemExit(f"bench port: {now} of {until}, and no more for {PATIENCE_S:g} s")
        time.sleep(0.001)


def checked_count(bench: str, packets: int, messages: int, each: int) -> int:
    """The number of packets.

    :raises SystemExit: when the messages did not leave in ``each`` packets
    """
    if not 0 <= packets - messages * each <= OTHERS * messages * each:
        raise SystemExit(f"bench {bench}: {messages} messages of {each} packets arrived in {packets} packets")
    return packets


def bare_rate() -> float:
    """PDUs/s from one Python block to another."""
    shorten_switch_interval()
    poster, taker = _Poster(), _Taker()
    graph = gr.top_block()
    graph.msg_connect(poster, "out", taker, "in")
    graph.start()
    pdu = pmt.cons(pmt.make_dict(), pmt.init_u8vector(PACKET_LEN, [0] * PACKET_LEN))
    begin = time.perf_counter()
    for _ in range(PACKETS):
        poster.message_port_pub(_OUT, pdu)
    _wait(lambda: taker.taken, PACKETS)
    rate = PACKETS / (time.perf_counter() - begin)
    graph.stop()
    graph.wait()
    return rate


def blocks_rate(size: int, each: int) -> float:
    """Packets/s through two ROS Links, one way.

    :param size: bytes of a message
    :param each: packets that a message of this size leaves in
    """
    robot, base = _Graph(1), _Graph(2)
    sends, takes = one_way(robot, base, PACKET_LEN)
    source, sink = sends.source, takes.sink
    graph = gr.top_block()
    graph.msg_connect(source, "pdus", sink, "pdus")
    messages = PACKETS // each
    payloads = [b"\0\1\0\0" + number.to_bytes(4, "little") + bytes(size - 8) for number in range(messages)]
    graph.start()
    try:
        begin = time.perf_counter()
        feeder = threading.Thread(target=lambda: [robot.callback(payload) for payload in payloads], daemon=True)
        feeder.start()
        _wait(lambda: base.counter.published, messages)
        elapsed = time.perf_counter() - begin
        feeder.join()
        packets = checked_count("port", sink.stats()["packets"], messages, each)
    finally:
        graph.stop()
        graph.wait()
        sends.close()
        takes.close()
    return packets / elapsed


def port() -> list[Row]:
    """Bare port and blocks in turn, so that a slow moment of the machine hits both."""
    bare, odometry, small = [], [], []
    for _ in range(REPEATS):
        bare.append(bare_rate())
        odometry.append(blocks_rate(ODOMETRY_BYTES, 15))
        small.append(blocks_rate(SMALL_BYTES, 1))
    reference = median(bare)

    def row(what: str, rates: list[float], least: float) -> Row:
        ratio = median(ours / alone for ours, alone in zip(rates, bare, strict=True))
        note = f"{median(rates):,.0f} packets/s"
        return Row(f"{what}: packets/s over the bare port's", ratio, "", "≥", least, "{:.2f}", note)

    return [
        Row("bare port, Python to Python, 64 B", reference, "PDUs/s"),
        row("source → port → sink, 724 B in 15 packets of 64 B", odometry, LEAST_MANY),
        row("source → port → sink, 48 B in one packet of 64 B", small, LEAST_ONE),
    ]
