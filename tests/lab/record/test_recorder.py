"""From the events of a run to its results."""

from __future__ import annotations

import random

import pytest

from gr_ros2.link import AirPacket
from gr_ros2.observe.positions import humble_types
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.record.recorder import Recorder
from tests.packets import data_of

REGISTRY = Registry.from_rows({"odom": "nav_msgs/Odometry", "fix": "sensor_msgs/NavSatFix", "raw": "my_msgs/Thing"})


def _point_stamped(x: float, y: float) -> bytes:
    store = humble_types()
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](0, 0), "map")
    message = store.types["geometry_msgs/msg/PointStamped"](header, store.types["geometry_msgs/msg/Point"](x, y, 0.0))
    return bytes(store.serialize_cdr(message, "geometry_msgs/msg/PointStamped"))


def test_a_run_over_the_engines() -> None:
    registry = Registry.from_rows({"at": "geometry_msgs/PointStamped", "imu": "sensor_msgs/Imu"})
    recorder = Recorder(registry, {4: "/robot_4"})
    sender = Sender(
        registry,
        *paper_from(robot=4, packet_len=64),
        rng=random.Random(1),
        observer=lambda event: recorder.sender_event(4, event),
    )
    receiver = Receiver(registry, *paper_from(robot=0, packet_len=64))
    for step in range(100):
        now = 100 + step / 10
        sender.submit(0, _point_stamped(step, 2 * step), now)
        while (data := data_of(sender.next_packet(now))) is not None:
            if 20 <= step < 30:  # an outage
                continue
            for event in receiver.receive(AirPacket(data), now + 0.05):
                recorder.receiver_event(event, now + 0.05)
    assert recorder.progress() == (100, 90)
    at, imu = recorder.finish(duration_s=10, t_end=110)
    assert (at.topic, at.type, at.src_id) == ("/robot_4/at", "geometry_msgs/msg/PointStamped", 4)
    assert (at.sent, at.delivered, at.pdr, at.corrupt) == (100, 90, 0.9, 0)
    assert at.ledger == {"delivered": 90, "lost_fragments": 10}
    assert at.latency_s.p50 == pytest.approx(0.05)
    assert at.latency_clock == "submit"
    assert at.age_s.peak == pytest.approx(0.05 + 11 * 0.1)
    assert at.path_error_m == pytest.approx(0, abs=1e-6)
    assert at.rms_error_m == pytest.approx(0.05 * 10 * 5**0.5, rel=1e-3)
    assert at.goodput_Bps == pytest.approx(90 * len(_point_stamped(0, 0)) / 10)
    assert (imu.sent, imu.pdr, imu.path_error_m, imu.latency_clock) == (0, None, None, None)
    trace = recorder.trace(100, 110, {"/robot_4/at": "/rx_robot_4/at"})
    (path,) = trace.paths()
    assert (path.topic, path.published_as) == ("/robot_4/at", "/rx_robot_4/at")
    assert (len(path.sent), len(path.received)) == (100, 90)
    assert path.sent[3].tolist() == [3, 6]
    (messages,) = trace.messages()
    assert messages.t_sent[[0, -1]] == pytest.approx([0, 9.9])
    assert (messages.fate != "delivered").nonzero()[0].tolist() == list(range(20, 30))
    assert set(messages.fate[20:30]) == {"lost_fragments"}
    packets = recorder.ledger.packets()["sent"]
    assert recorder.airtime(lambda *_: 0.5) == {
        "airtime_s": 0.5,
        "airtime_mean_s": 0.5,
        "airtime_per_message_s": pytest.approx(0.5 * packets / 90),
        "airtime_per_byte_s": pytest.approx(0.5 * packets / 90 / len(_point_stamped(0, 0))),
        "airtime_of_senders_s": {"4": {"new": pytest.approx(0.5 * packets)}},
        "air_span_s": pytest.approx(9.9 + 0.5, abs=0.1),
        "bytes_per_message": pytest.approx(64 * packets / 90),
    }
    without = recorder.airtime(None)
    assert without.pop("airtime_of_senders_s") == {}
    assert without.pop("air_span_s") == pytest.approx(9.9, abs=0.1)
    assert without.pop("bytes_per_message") == pytest.approx(64 * packets / 90)
    assert set(without.values()) == {None}


def test_only_the_topics_asked_for_are_listed() -> None:
    assert [topic.topic for topic in Recorder(REGISTRY, {1: "robot_1"}).finish(1, 1)] == [
        "/robot_1/odom",
        "/robot_1/fix",
        "/robot_1/raw",
    ]
    assert [topic.topic for topic in Recorder(REGISTRY, {1: ""}, topic_ids={1: [1]}).finish(1, 1)] == ["/fix"]
    assert Recorder(REGISTRY, {1: ""}).airtime(lambda *_: 1.0)["airtime_per_message_s"] is None


def test_what_does_not_deserialize_has_no_position_and_is_counted() -> None:
    recorder = Recorder(REGISTRY, {1: ""})
    sender = Sender(REGISTRY, *paper_from(robot=1), observer=lambda event: recorder.sender_event(1, event))
    sender.submit(0, b"no odometry", 0.0)
    odom = recorder.finish(1, 1)[0]
    assert odom.path_error_m is None
    assert (odom.sent, odom.left_out_sent, odom.left_out_received) == (1, 1, 0)
