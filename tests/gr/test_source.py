"""RosSource: ROS messages in, packets out, nothing dropped without a name."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from typing import Any

import pmt
import pytest
from gnuradio import gr

from gr_ros2.compression.link_codec import TopicCodec
from gr_ros2.core.errors import ConfigError
from gr_ros2.gr import RosLink
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.link import Accepted, Ended, Missed, Refused, SenderEvent, SentPacket
from gr_ros2.link.v1.slowness import Slowness
from gr_ros2.middleware import MIDDLEWARE, Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.paper import RosSink, RosSource
from gr_ros2.phy.pdus import credit_of
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v0 import V0
from gr_ros2_lab.record.recorder import Recorder
from tests.domains import free_domains
from tests.gr.ends import link
from tests.gr.probe import Hears, Probe
from tests.waiting import PATIENCE_S, wait_for

REGISTRY = Registry.from_rows({"odom": "nav_msgs/Odometry", "/tf": "tf2_msgs/TFMessage"})
DOMAIN = 61


class Rig:
    """A source, a probe behind it, and a robot that publishes."""

    def __init__(self) -> None:
        self.top = gr.top_block()
        self.probe = Probe()
        self.robot = MemoryMiddleware(domain_id=DOMAIN)
        self.source: SendingBlock | None = None
        self.link: RosLink | None = None

    def make(self, *, of_link: bool = False, **settings: Any) -> SendingBlock:
        """A ROS Source, or what sends of a ROS Link."""
        values = {"robot": "/robot_1", "graph_middleware": "memory", "graph_domain_id": DOMAIN, **settings}
        if of_link:
            self.link = link(direction="send", registry=REGISTRY, **values)
        self.source = RosSource(REGISTRY, **values) if self.link is None else self.link.source
        return self.source

    def start(self, credit: bool = False) -> None:
        self.top.msg_connect((self.source, "pdus"), (self.probe, "pdus"))
        if credit:
            self.top.msg_connect((self.probe, "credit"), (self.source, "credit"))
        self.top.start()

    def publish(self, payload: bytes, topic: str = "/robot_1/odom", count: int = 1) -> None:
        publisher = self.robot.advertise(topic, REGISTRY.named(topic.rsplit("/", 1)[-1]).type_name, Qos(depth=0))
        for _ in range(count):
            publisher.publish(payload)

    def close(self) -> None:
        if self.link is not None:
            self.link.close()
        elif self.source is not None:
            self.source.close()
        self.top.stop()
        self.top.wait()
        self.robot.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()


def test_a_message_leaves_as_packets_with_metadata(rig: Rig) -> None:
    before = time.time()
    rig.make(packet_len=64, dst_id=9, hop=3)
    rig.start()
    rig.publish(b"\0\1\0\0" + bytes(720))
    wait_for(lambda: rig.probe.handled == 15)
    packets = [V0.decode(data, 64) for data in rig.probe.packets]
    assert {(packet.src_id, packet.dst_id, packet.hop) for packet in packets} == {(1, 9, 3)}
    metadata = [pmt.to_python(pmt.car(message)) for message in rig.probe.messages]
    assert [item["seq"] for item in metadata] == [packet.seq for packet in packets]
    assert all(item["src_id"] == 1 and item["dst_id"] == 9 and item["qos"] == 0 for item in metadata)
    assert all(before <= item["t_src_wall"] <= time.time() for item in metadata)


@pytest.mark.parametrize("middleware", ["memory", "dds"])
def test_queues_follow_the_qos_of_the_publishers(middleware: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    (domain,) = free_domains(1)
    both = link(
        registry=REGISTRY,
        direction="send",
        robot="/robot_1",
        graph_middleware=middleware,
        graph_domain_id=domain,
        topics={"auto": {}, "/tf": {"queue": "fifo"}},
    )
    source = both.source
    with MIDDLEWARE.load(middleware)(domain_id=domain) as robot:
        for name, topic in source.subscriptions.subscribed.items():
            robot.advertise(name, topic.type_name, Qos(depth=1, lifespan_s=0.05))

        def queues() -> list[str]:
            return [topic["queue"] for topic in source.stats()["topics"].values()]

        wait_for(lambda: queues() == ["latest", "fifo"])
        source.middleware.close()
    both.close()


def test_each_topic_has_its_depth(rig: Rig) -> None:
    source = rig.make(topics={"auto": {}, "/tf": {"queue_depth": 7}})
    source.set_queue_depth(5)
    depths = {name: topic["queue_depth"] for name, topic in source.stats()["topics"].items()}
    assert depths == {"/robot_1/odom": 5, "/tf": 7}


def test_what_outlives_its_lifespan_is_stale(rig: Rig) -> None:
    refused: list[Refused] = []
    rig.make(of_link=True, observer=Hears(lambda event: refused.append(event) if isinstance(event, Refused) else None))
    publisher = rig.robot.advertise("/robot_1/odom", "nav_msgs/Odometry", Qos(depth=5, lifespan_s=0.01))
    rig.source.use_credit()
    rig.start(credit=True)
    publisher.publish(b"\0\1\0\0abcd")
    wait_for(lambda: rig.source.stats()["topics"]["/robot_1/odom"]["submitted"] == 1)
    published = time.monotonic()
    wait_for(lambda: time.monotonic() > published + 0.01)
    for _ in range(5):  # a hello and the table of topics may go first
        rig.probe.message_port_pub(pmt.intern("credit"), pmt.PMT_T)
    wait_for(lambda: bool(refused))
    assert refused[0].reason == "stale"


def test_what_the_graph_loses_before_it_reaches_the_source_is_a_row_that_adds_up(rig: Rig) -> None:
    """Messages published while the source is held up, into a subscription of five."""
    recorder = Recorder(REGISTRY, {1: "/robot_1"}, {1: [0]})
    held, release = threading.Event(), threading.Event()

    def observe(event: SenderEvent) -> None:
        recorder.sender_event(1, event)
        held.set()
        release.wait(PATIENCE_S)

    source = rig.make(topics=["odom"], graph_depth=5, observer=Hears(observe))
    rig.publish(bytes(40))
    wait_for(held.is_set)
    rig.publish(bytes(40), count=29)
    release.set()
    wait_for(lambda: source.stats()["topics"]["/robot_1/odom"]["submitted"] == 6)
    topic = source.stats()["topics"]["/robot_1/odom"]
    assert topic["lost_on_graph"] == 24
    (result,) = recorder.finish(1.0, time.monotonic())
    assert result.sent == sum(result.ledger.values()) == 30
    assert result.ledger == {"in_flight": 6, "lost_on_graph": 24}


def test_what_the_graph_loses_last_is_told_when_the_source_stops(rig: Rig) -> None:
    events: list[SenderEvent] = []
    source = rig.make(observer=Hears(events.append))
    rig.start()
    subscription = source.subscriptions._subscriptions[0]
    source.middleware.count_lost(subscription, "/robot_1/odom", "lost", 3)
    rig.top.stop()
    rig.top.wait()
    assert events == [Missed(0, 3)]
    source.middleware.count_lost(subscription, "/robot_1/odom", "lost")
    source.close()
    assert events == [Missed(0, 3), Missed(0, 1)]


def test_all_topics_or_a_subset(rig: Rig) -> None:
    assert set(rig.make().subscriptions.subscribed) == {"/robot_1/odom", "/tf"}
    rig.source.close()
    assert set(rig.make(topics=["/odom"]).subscriptions.subscribed) == {"/robot_1/odom"}


def test_messages_before_the_start_are_kept(rig: Rig) -> None:
    source = rig.make()
    rig.publish(b"\0\1\0\0abcd")
    wait_for(lambda: source.stats()["topics"]["/robot_1/odom"]["submitted"] == 1)
    rig.start()
    wait_for(lambda: rig.probe.handled == 1)
    wait_for(lambda: source.idle)


def test_credit_paces(rig: Rig) -> None:
    rig.make(packet_len=64).use_credit()
    rig.start(credit=True)
    rig.publish(b"\0\1\0\0" + bytes(720))
    wait_for(lambda: not rig.source.idle)
    for number in range(1, 4):
        rig.probe.message_port_pub(pmt.intern("credit"), pmt.PMT_T)
        wait_for(lambda number=number: rig.probe.handled == number)
    assert rig.source.stats()["packets"] == 3
    rig.probe.message_port_pub(pmt.intern("credit"), pmt.from_long(4))
    wait_for(lambda: rig.probe.handled == rig.source.emitted == 7, "as many packets as the integer says")


@pytest.mark.parametrize("backpressure", [False, True])
def test_a_credit_that_says_since_when_the_air_is_free_tells_a_slow_computer(rig: Rig, backpressure: bool) -> None:
    """Where the reader of a recording waits for room in the queue, nothing is to be dropped."""
    source = rig.make(packet_len=64, backpressure=backpressure)
    source.use_credit()
    rig.start(credit=True)
    free = source.clock()
    rig.probe.message_port_pub(pmt.intern("credit"), credit_of(1, free))
    wait_for(lambda: not source._end.pace.out_of_credit, "the credit")
    slowness = Slowness(source._end.pace)
    assert not slowness.behind(free + 0.1)
    assert slowness.behind(free + 1.0) != backpressure


def test_events_reach_the_observer_in_order(rig: Rig) -> None:
    events: list[Any] = []
    rig.make(packet_len=64, observer=Hears(events.append))
    rig.start()
    rig.publish(bytes(40))
    rig.publish(bytes(64_000))
    wait_for(lambda: len(events) == 4)
    assert sorted(type(event).__name__ for event in events) == ["Accepted", "Accepted", "Refused", "SentPacket"]
    assert isinstance(events[0], Accepted)
    assert any(isinstance(event, Refused) and event.reason == "too_large" for event in events)
    assert any(isinstance(event, SentPacket) for event in events)


def test_a_message_too_large_is_said_once_with_the_remedy(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    source = rig.make(packet_len=64)
    rig.start()
    rig.publish(bytes(64_000), count=3)
    wait_for(lambda: source.stats()["topics"]["/robot_1/odom"]["refused"] == {"too_large": 3})
    said = [record.getMessage() for record in caplog.records if "too_large" in record.getMessage()]
    assert len(said) == 1
    assert "packet_len" in said[0]


def test_a_message_of_which_a_robot_tells_nothing_is_said_once(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    source = rig.make(of_link=True)
    for serial, arrived in enumerate((True, False, False)):
        source._observe(Ended(serial, 0, 7, arrived))
    said = [record.getMessage() for record in caplog.records if "unconfirmed" in record.getMessage()]
    assert len(said) == 1
    assert said[0].startswith("topic odom: robot 7 ")


def test_a_port_that_nobody_reads_is_said_and_counted(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    source = rig.make()
    rig.top.msg_connect((rig.probe, "credit"), (source, "credit"))
    rig.top.start()
    wait_for(lambda: "nothing reads message port `pdus`; connect it" in caplog.text)
    rig.publish(bytes(40), count=5)
    rig.probe.message_port_pub(pmt.intern("credit"), pmt.PMT_T)
    wait_for(lambda: source.stats()["unread"] > 0)


def test_backpressure_holds_the_publisher_back_and_close_lets_it_go(rig: Rig) -> None:
    source = rig.make(packet_len=64, queue_depth=2, backpressure=True, graph_depth=0)
    source.use_credit()
    rig.start(credit=True)
    rig.publish(bytes(40), count=10)
    wait_for(lambda: source.stats()["topics"]["/robot_1/odom"]["queued"] == 2)
    assert source.stats()["topics"]["/robot_1/odom"]["submitted"] == 2
    for number in range(1, 6):
        rig.probe.message_port_pub(pmt.intern("credit"), pmt.PMT_T)
        wait_for(lambda number=number: rig.probe.handled == number)
    assert source.stats()["topics"]["/robot_1/odom"]["refused"] == {}
    source.close()
    assert source.stats()["held_back_at_close"] == 1


def test_settings_change_while_running(rig: Rig) -> None:
    source = rig.make(packet_len=64)
    rig.start()
    source.set_dst_id(4)
    source.set_packet_rate(1000.0)
    source.set_queue_depth(5)
    source.set_repeat_s(0.0)
    source.set_debug(True)
    source.set_debug(False)
    rig.publish(bytes(40))
    wait_for(lambda: rig.probe.handled == 1)
    packet = V0.decode(rig.probe.packets[0], 64)
    assert packet.dst_id == 4
    assert source.config.packet_rate == 1000.0
    with pytest.raises(ConfigError, match="dst_id = 300"):
        source.set_dst_id(300)


def test_a_failing_observer_does_not_end_transmission(rig: Rig) -> None:
    def fail(event: Any) -> None:
        if isinstance(event, SentPacket) and event.entries[0].serial == 0:
            raise ValueError("observer")

    source = rig.make(packet_len=64, observer=Hears(fail))
    rig.start()
    rig.publish(bytes(40))
    wait_for(lambda: source.stats()["observer_missed"] == 1)
    rig.publish(bytes(40))
    wait_for(lambda: rig.probe.handled == 2)
    assert source.stats()["observer_missed"] == 3  # nor the second message, nor its packet
    assert source.stats()["pump_failed"] == 0


def test_debug_lines(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, "gr_ros2.gr.source"):
        rig.make(packet_len=64, debug=True)
        rig.start()
        rig.publish(bytes(40))
        wait_for(lambda: rig.probe.handled == 1)
    assert "src=1 dst=255" in caplog.text
    assert "0:odom#" in caplog.text


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"packet_len": 13}, "packet_len = 13"),
        ({"colour": 1}, "unknown key colour"),
        ({"topics": ["nope"]}, "nope"),
        ({"robot": "/robot"}, "no digits"),
        ({"graph_middleware": "carrier-pigeon"}, "carrier-pigeon"),
        ({"min_fragment": 300}, "min_fragment = 300"),
        ({"scheduler": "freshness"}, "unknown key scheduler"),
        ({"weight": 2}, "unknown key weight"),
        ({"repair": "thrifty"}, "repair = 'thrifty': the paper's blocks have no such setting"),
    ],
)
def test_what_is_wrong_is_named(rig: Rig, settings: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        rig.make(**settings)


def test_a_registry_is_needed() -> None:
    with pytest.raises(ConfigError, match="registry"):
        RosSource(robot="/robot_1", graph_middleware="memory")
    with pytest.raises(ConfigError, match="nowhere"):
        RosSource("nowhere.csv", robot="/robot_1", graph_middleware="memory")


def test_a_loop_is_refused_whichever_comes_first(rig: Rig) -> None:
    rig.make()
    with pytest.raises(ConfigError, match="loop"):
        RosSink(REGISTRY, graph_middleware="memory", graph_domain_id=DOMAIN, publish_as="/robot_{robot}")
    RosSink(REGISTRY, graph_middleware="memory", graph_domain_id=DOMAIN + 1, publish_as="/robot_{robot}").close()
    rig.source.close()
    sink = RosSink(REGISTRY, graph_middleware="memory", graph_domain_id=DOMAIN, publish_as="/robot_{robot}")
    with pytest.raises(ConfigError, match="loop"):
        rig.make()
    sink.close()


def test_stopped_started_and_closed_twice(rig: Rig) -> None:
    source = rig.make()
    rig.start()
    rig.top.stop()
    rig.top.wait()
    rig.top.start()
    rig.publish(bytes(40))
    wait_for(lambda: rig.probe.handled == 1)
    rig.top.stop()
    rig.top.wait()
    source.close()
    source.close()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("gr-ros2-source")]


def test_other_messages_leave_while_a_large_one_is_coded(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    coding, go_on = threading.Event(), threading.Event()
    encode = TopicCodec.encode

    def slow(self: TopicCodec, payload: bytes) -> bytes:
        if len(payload) > 50_000:
            coding.set()
            assert go_on.wait(PATIENCE_S)
        return encode(self, payload)

    monkeypatch.setattr(TopicCodec, "encode", slow)
    live = rig.make(of_link=True).live
    sent = live.endpoint.sent.sent
    odom, tf = (topic.topic_id for topic in REGISTRY)
    rig.start()
    large = threading.Thread(target=rig.publish, args=(bytes([0, 1, 0, 0]) + bytes(100_000),))
    try:
        large.start()
        assert coding.wait(PATIENCE_S)
        assert live.lock.acquire(timeout=PATIENCE_S)
        live.endpoint.messages.submit(tf, bytes([0, 1, 0, 0]) + bytes(40), time.monotonic())
        live.wake()
        live.lock.release()
        wait_for(lambda: sent[tf] == 1)
        assert not sent[odom]
    finally:
        go_on.set()
        large.join(PATIENCE_S)
    wait_for(lambda: sent[odom] == 1)
