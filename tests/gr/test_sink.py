"""RosSink: packets in, ROS messages out; garbage is counted and nothing else is lost."""

from __future__ import annotations

import logging
import random
import re
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import pmt
import pytest
from gnuradio import gr

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.gr.latency import LatencySummary, LatencyWindow
from gr_ros2.link import AirPacket, Delivered, Lost, Received
from gr_ros2.middleware import Publisher, Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.paper import RosSink
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.registry import Registry
from tests.gr.probe import Hears, Probe
from tests.packets import data_of
from tests.waiting import PATIENCE_S, wait_for

REGISTRY = Registry.from_rows(
    {"odom": "nav_msgs/Odometry", "map": "nav_msgs/OccupancyGrid", "cmd_vel": "geometry_msgs/Twist"}
)
DOMAIN = 62
PACKET_LEN = 64


def packets(*messages: tuple[int, bytes], src_id: int = 1) -> list[bytes]:
    """What a sender makes of messages given as (topic id, payload)."""
    sender = Sender(REGISTRY, *paper_from(robot=src_id, packet_len=PACKET_LEN, repeat_s=0), rng=random.Random(1))
    for topic_id, payload in messages:
        sender.submit(topic_id, payload, 0.0)
    made = []
    while (data := data_of(sender.next_packet(0.0))) is not None:
        made.append(data)
    return made


def stamped(seconds: float) -> bytes:
    """An Odometry, as far as the stamp goes."""
    return b"\0\1\0\0" + struct.pack("<iI", int(seconds), int(seconds % 1 * 1e9)) + bytes(60)


class Rig:
    """A probe, a sink behind it, and someone who listens to what comes out."""

    def __init__(self) -> None:
        self.top = gr.top_block()
        self.probe = Probe()
        self.listener = MemoryMiddleware(domain_id=DOMAIN)
        self.heard: list[bytes] = []
        self.sink: RosSink | None = None

    def make(self, **settings: Any) -> RosSink:
        values = {"graph_middleware": "memory", "graph_domain_id": DOMAIN, "packet_len": PACKET_LEN, **settings}
        self.sink = RosSink(REGISTRY, **values)
        return self.sink

    def start(self, topic: str = "/rx_robot_1/odom", kind: str = "nav_msgs/Odometry") -> None:
        self.listener.subscribe(topic, kind, Qos(depth=0), self.heard.append)
        self.top.msg_connect((self.probe, "pdus"), (self.sink, "pdus"))
        self.top.start()

    def close(self) -> None:
        self.top.stop()
        self.top.wait()
        if self.sink is not None:
            self.sink.close()
        self.listener.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()


def test_messages_come_out_unaltered_and_in_order(rig: Rig) -> None:
    sink = rig.make(publish_depth=0)
    rig.start()
    sent = [stamped(number) + bytes([number]) * 600 for number in range(1, 40)]
    for data in packets(*((0, payload) for payload in sent)):
        rig.probe.post(data)
    wait_for(lambda: len(rig.heard) == len(sent))
    assert rig.heard == sent
    wait_for(lambda: sink.stats()["topics"]["/rx_robot_1/odom"]["delivered"] == len(sent), "the count")


def test_messages_that_two_threads_bring_come_out_in_the_order_of_their_packets(rig: Rig) -> None:
    held = threading.Event()
    published: list[bytes] = []
    with MemoryMiddleware(domain_id=DOMAIN) as middleware:
        advertise = middleware.advertise

        def slow(topic: str, type_name: str, qos: Qos) -> Publisher:
            publisher = advertise(topic, type_name, qos)
            publisher.publish = lambda payload: (payload == sent[0] and held.wait(), published.append(payload))[1]
            return publisher

        middleware.advertise = slow
        sent = [stamped(number)[:40] for number in (1, 2)]
        sink, takers = rig.make(middleware=middleware), []
        for count, data in enumerate(packets(*((0, payload) for payload in sent)), 1):
            takers.append(threading.Thread(target=sink.take, args=([AirPacket(data)],)))
            takers[-1].start()
            wait_for(lambda: sink.stats()["packets"] == count, "the packet to be taken")  # noqa: B023 - called at once
        held.set()
        for taker in takers:
            taker.join()
        rig.sink.close()
    assert published == sent


def test_each_sender_has_its_topics(rig: Rig) -> None:
    sink = rig.make(publish_as="/from_{robot}/x")
    rig.start("/from_7/x/cmd_vel", "geometry_msgs/Twist")
    for data in packets((2, b"\0\1\0\0" + bytes(48)), src_id=7) + packets((0, stamped(1)), src_id=8):
        rig.probe.post(data)
    wait_for(lambda: rig.heard)
    wait_for(lambda: set(sink.stats()["topics"]) == {"/from_7/x/cmd_vel", "/from_8/x/odom"})


def test_the_newest_message_of_a_latched_topic_reaches_a_late_joiner(rig: Rig) -> None:
    sink = rig.make()
    rig.start()
    maps = [b"\0\1\0\0" + bytes([number]) * 200 for number in range(3)]
    for data in packets(*((1, payload) for payload in maps)):
        rig.probe.post(data)
    wait_for(lambda: sink.stats()["topics"].get("/rx_robot_1/map", {}).get("delivered") == len(maps))
    late: list[bytes] = []
    rig.listener.subscribe("/rx_robot_1/map", "nav_msgs/OccupancyGrid", Qos(), late.append)
    wait_for(lambda: late)
    assert late == maps[-1:]


def test_garbage_is_counted_and_nothing_else_is_lost(rig: Rig) -> None:
    sink = rig.make()
    rig.start()
    good = packets((0, stamped(5)))
    broken = bytes([good[0][0], *good[0][1:-1], good[0][-1] ^ 1])
    garbage = [
        pmt.PMT_NIL,
        pmt.intern("x"),
        pmt.cons(pmt.PMT_NIL, pmt.PMT_NIL),
        pmt.cons(pmt.make_dict(), pmt.init_f32vector(3, [1, 2, 3])),
    ]
    for message in garbage:
        rig.probe.post_message(message)
    for data in (b"", bytes(13), bytes(PACKET_LEN), bytes(70000), broken, *good):
        rig.probe.post(data)
    wait_for(lambda: rig.heard == [stamped(5)] and sink.handled == 9 + len(good))
    stats = sink.stats()
    assert (stats["not_a_pair"], stats["not_u8"], stats["handler_failed"]) == (2, 2, 0)
    assert stats["rejected"]["length"] == 3
    assert sum(stats["rejected"].values()) == 5
    assert stats["handled"] == 9 + len(good)


def test_joined_packets_are_cut_and_what_is_refused_is_logged_once(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    sink = rig.make()
    rig.start()
    first, second, third = (packets((0, stamped(number)))[:] for number in (1, 2, 3))
    broken = bytes([*first[0][:-1], first[0][-1] ^ 1])
    sent = [*first, *second[:1]], [broken], [*second[1:], *third], [broken]
    for joined in sent:
        rig.probe.post(b"".join(joined))
    rig.probe.post(b"".join(third) + b"tail")
    rig.probe.post(b"".join(third) + b"tail")
    wait_for(lambda: rig.heard == [stamped(1), stamped(2), stamped(3)] and sink.handled == 6)
    stats = sink.stats()
    assert stats["rejected"] == {"crc": 2, "length": 2}
    assert stats["joined"] == 4
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == len(set(said)) == 3
    assert [re.search(r"is cut|\((?:crc|length)\)", line)[0] for line in said] == ["is cut", "(crc)", "(length)"]
    assert "a TCP socket joins packets" in said[0]


def test_an_incomplete_message_expires_without_further_packets(rig: Rig) -> None:
    events: list[Any] = []
    rig.make(reassembly_timeout_s=0.05, observer=Hears(events.append))
    rig.start()
    rig.probe.post(packets((0, stamped(5) + bytes(600)))[0])
    wait_for(lambda: len(events) == 2)
    assert [type(event) for event in events] == [Received, Lost]
    assert events[1].reason == "expired"
    assert rig.sink.stats()["topics"]["/rx_robot_1/odom"]["lost"] == {"expired": 1}


def test_delivered_is_observed_after_publication(rig: Rig) -> None:
    published: list[bytes] = []
    seen: list[tuple[Any, int]] = []
    with MemoryMiddleware(domain_id=DOMAIN) as middleware:
        advertise = middleware.advertise

        def watched(topic: str, type_name: str, qos: Qos) -> Publisher:
            publisher = advertise(topic, type_name, qos)
            publish = publisher.publish
            publisher.publish = lambda payload: (publish(payload), published.append(payload))[0]
            return publisher

        middleware.advertise = watched
        rig.make(middleware=middleware, observer=Hears(lambda event: seen.append((event, len(published)))))
        rig.start()
        rig.probe.post(packets((0, stamped(5)[:40]))[0])
        wait_for(lambda: len(seen) == 2)
        assert [(type(event), count) for event, count in seen] == [(Received, 0), (Delivered, 1)]
        rig.sink.close()


def test_a_failed_publication_is_counted_and_observed(rig: Rig) -> None:
    events: list[Any] = []
    middleware = MemoryMiddleware(domain_id=DOMAIN)
    sink = rig.make(middleware=middleware, observer=Hears(events.append))
    rig.start()
    middleware.close()
    with pytest.raises(MiddlewareError):
        middleware.advertise("/x", "nav_msgs/Odometry", Qos())
    rig.probe.post(packets((0, stamped(5)[:40]))[0])
    wait_for(lambda: len(events) == 2)
    assert events[1] == Lost(1, 0, "publish_failed", events[0].packet.entries[0].entry_id)
    stats = sink.stats()
    assert stats["publish_failed"] == 1
    topic = stats["topics"]["/rx_robot_1/odom"]
    assert (topic["delivered"], topic["lost"], topic["age_s"]) == (0, {"publish_failed": 1}, None)


@pytest.mark.parametrize("error", [ConfigError("no such type"), RuntimeError("the back-end's own")])
def test_what_was_not_published_is_not_delivered_whatever_the_reason(rig: Rig, error: Exception) -> None:
    class Refusing(MemoryMiddleware):
        def advertise(self, topic: str, type_name: str, qos: Qos) -> Any:
            if topic.endswith("/cmd_vel"):
                raise error
            return super().advertise(topic, type_name, qos)

    events: list[Any] = []
    with Refusing(domain_id=DOMAIN) as middleware:
        sink = rig.make(middleware=middleware, observer=Hears(events.append))
        rig.start()
        for data in packets((2, stamped(5)[:40]), (0, stamped(6)[:40]), (2, stamped(7)[:40])):
            rig.probe.post(data)
        wait_for(lambda: len(events) == 6)
        stats = sink.stats()
        rig.sink.close()
    told = [event for event in events if not isinstance(event, Received)]
    assert sorted((event.topic_id, type(event)) for event in told) == [(0, Delivered), (2, Lost), (2, Lost)]
    refused, passed = stats["topics"]["/rx_robot_1/cmd_vel"], stats["topics"]["/rx_robot_1/odom"]
    assert (refused["delivered"], refused["lost"]) == (0, {"publish_failed": 2})
    assert (passed["delivered"], passed["lost"]) == (1, {})
    assert (stats["publish_failed"], stats["handler_failed"]) == (2, 0)


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"publish_as": "/rx-{robot}"}, "publish.as = '/rx-{robot}'"),
        ({"publish_as": "/{robot.__class__}"}, "publish.as = '/{robot.__class__}'"),
        ({"publish_topics": {"odom": {"as": "/robot-1/odom"}}}, "publish.topics.odom.as"),
        (
            {"publish_topics": {"odom": {"as": "/x"}, "map": {"as": "/x"}}},
            "'map' would come out as '/x'",
        ),
    ],
)
def test_names_that_ros_refuses_are_refused_before_the_graph_is_joined(
    rig: Rig, settings: dict[str, Any], key: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(key)):
        rig.make(**{**settings, "graph_middleware": "no such"})


def test_what_fails_after_publication_takes_no_delivery_back(rig: Rig) -> None:
    class NoMerging(MemoryMiddleware):
        def advertise(self, topic: str, type_name: str, qos: Qos) -> Any:
            publisher = super().advertise(topic, type_name, qos)
            if topic == "/tf":

                def fail(_payload: bytes) -> None:
                    raise RuntimeError("merged")

                publisher.publish = fail
            return publisher

    rows = Registry.from_rows({"tf": "tf2_msgs/TFMessage"})
    events: list[Any] = []
    with NoMerging(domain_id=DOMAIN) as middleware:
        rig.sink = RosSink(
            rows,
            middleware=middleware,
            packet_len=PACKET_LEN,
            publish_frame_prefix="r{robot}/",
            publish_merge_tf="/tf",
            observer=Hears(events.append),
        )
        rig.start("/rx_robot_1/tf", "tf2_msgs/TFMessage")
        rig.probe.post(packets((0, b"\0\1\0\0" + bytes(4)))[0])
        wait_for(lambda: len(events) == 2)
        stats = rig.sink.stats()
        rig.sink.close()
    assert isinstance(events[1], Delivered)
    assert (stats["tf_failed"], stats["handler_failed"]) == (1, 0)
    assert stats["topics"]["/rx_robot_1/tf"]["delivered"] == 1


def test_a_failing_observer_does_not_end_reception(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    def fail(_event: Any) -> None:
        raise ValueError("observer")

    sink = rig.make(observer=Hears(fail))
    rig.start()
    for data in packets(*((0, stamped(number)[:40]) for number in (1, 2))):
        rig.probe.post(data)
    wait_for(lambda: len(rig.heard) == 2)
    wait_for(lambda: sink.stats()["observer_missed"] == 4)  # two packets and their messages
    assert [record.message for record in caplog.records if record.levelname == "ERROR"] == [
        "observer of ros2_sink: ended (ValueError: observer); the link goes on without it"
    ]


def test_a_failing_observer_does_not_end_the_watch_over_timeouts(rig: Rig) -> None:
    def fail(event: Any) -> None:
        if isinstance(event, Lost):
            raise ValueError("observer")

    sink = rig.make(reassembly_timeout_s=0.05, observer=Hears(fail))
    rig.start()
    for count in (1, 3):  # the second packet and what it began
        rig.probe.post(packets((0, stamped(count) + bytes(600)))[0])
        wait_for(lambda count=count: sink.stats()["observer_missed"] == count)
    assert [thread for thread in threading.enumerate() if thread.name == "gr-ros2-sink"]


def test_what_an_observer_makes_of_a_loss_does_not_cost_the_next_message(rig: Rig) -> None:
    def fail(event: Any) -> None:
        if isinstance(event, Lost):
            raise ValueError("observer")

    sink = rig.make(observer=Hears(fail))
    rig.start()
    # The same entry id: the second message ends the first, which is not complete.
    for data in packets((0, bytes(600)))[:1] + packets((0, stamped(5)[:40])):
        rig.probe.post(data)
    wait_for(lambda: rig.heard == [stamped(5)[:40]])
    wait_for(lambda: sink.stats()["observer_missed"] == 2)  # the loss, and the message delivered behind it


def test_nothing_waits_while_latencies_are_sorted(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    sink = rig.make()
    rig.start()
    rig.probe.post(packets((0, stamped(5)[:40]))[0])
    wait_for(lambda: rig.heard and sink.handled)
    free: list[bool] = []
    summary = LatencyWindow.summary

    def watched(window: LatencyWindow, *newest: int) -> LatencySummary:
        free.append(sink._lock.acquire(timeout=PATIENCE_S))
        sink._lock.release()
        return summary(window, *newest)

    monkeypatch.setattr(LatencyWindow, "summary", watched)
    topic = sink.stats()["topics"]["/rx_robot_1/odom"]
    assert free == [True, True]
    assert topic["latency_s"]["measured"] == topic["recent_latency_s"]["measured"] == 1


def test_latencies_of_a_sender_that_gave_its_place_to_another_are_freed(rig: Rig) -> None:
    now = [0.0]
    sink = rig.make(max_sources=1, clock=lambda: now[0])
    rig.start()
    for number, robot in enumerate((1, 2), start=1):
        rig.probe.post(packets((0, stamped(5)[:40]), src_id=robot)[0])
        wait_for(lambda number=number: sink.handled == number)
        now[0] += 100
    gone, here = (sink.stats()["topics"][f"/rx_robot_{robot}/odom"] for robot in (1, 2))
    assert (gone["delivered"], gone["latency_s"]) == (1, None)
    assert here["latency_s"]["measured"] == 1
    assert {info.topic for info in rig.listener.discover()} >= {"/rx_robot_1/odom", "/rx_robot_2/odom"}


def test_latency_by_wall_clock(rig: Rig) -> None:
    sink = rig.make()
    rig.start()
    for data in packets((0, stamped(time.time() - 2)), (0, stamped(time.time() + 3600)), (2, bytes(52))):
        rig.probe.post(data)
    wait_for(lambda: sink.handled >= 2 and len(sink.stats()["topics"]) == 2)
    wait_for(lambda: (sink.stats()["topics"]["/rx_robot_1/odom"]["latency_s"] or {}).get("measured") == 2)
    latency = sink.stats()["topics"]["/rx_robot_1/odom"]["latency_s"]
    assert latency["max"] >= 2
    assert latency["negative"] == 1
    assert sink.stats()["topics"]["/rx_robot_1/cmd_vel"]["latency_s"] is None
    assert sink.stats()["latency_clock"] == "stamp_wall"


def test_latency_by_simulated_clock(rig: Rig) -> None:
    sink = rig.make(graph_use_sim_time=True)
    rig.start()
    clock = rig.listener.advertise("/clock", "rosgraph_msgs/Clock", Qos())
    clock.publish(b"\0\1\0\0" + struct.pack("<iI", 100, 500_000_000))
    wait_for(lambda: sink.outputs._latencies.sim_time == 100.5)
    for data in packets((0, stamped(100.0))):
        rig.probe.post(data)
    wait_for(lambda: sink.stats()["topics"])
    wait_for(lambda: sink.stats()["topics"]["/rx_robot_1/odom"]["latency_s"])
    assert sink.stats()["topics"]["/rx_robot_1/odom"]["latency_s"]["p50"] == pytest.approx(0.5)
    assert sink.stats()["latency_clock"] == "stamp_sim"


def test_settings_change_while_running(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    sink = rig.make()
    rig.start()
    with caplog.at_level(logging.DEBUG, "gr_ros2.gr.sink"):
        sink.set_debug(True)
        rig.probe.post(packets((0, stamped(5) + bytes(600)))[0])
        wait_for(lambda: "rx v0 qos=default" in caplog.text, "a line about the packet")
    sink.set_debug(False)


def test_stopped_started_and_closed_twice(rig: Rig) -> None:
    sink = rig.make()
    rig.start()
    rig.top.stop()
    rig.top.wait()
    rig.top.start()
    rig.probe.post(packets((0, stamped(5)[:40]))[0])
    wait_for(lambda: rig.heard)
    rig.top.stop()
    rig.top.wait()
    sink.close()
    sink.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "gr-ros2-sink"]
