"""A run made by hand of the events a link reports, so that every number of it is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gr_ros2.link.events import Accepted, Delivered, Missed, PacketId, Received, Refused, SentEntry, SentPacket
from gr_ros2.observe.positions import humble_types
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0
from gr_ros2_lab.record.recorder import Recorder
from gr_ros2_lab.record.result import Result, write_result
from gr_ros2_lab.record.trace import Trace, write_trace
from gr_ros2_lab.report.page import Run

REGISTRY = Registry.from_rows({"odom": "nav_msgs/Odometry", "imu": "sensor_msgs/Imu"})
T0 = 100.0
ODOM, LOST, TOO_LARGE, IN_FLIGHT, UNSENT, IMU = 40, 8, 2, 4, 1, 9
"""Messages: odometry in all; of it lost, too large, left but not arrived, not left; and IMU, the last in flight."""
DURATION_S = 4.0
AIRTIME_S = 0.01


def odometry(x: float, y: float) -> bytes:
    """A serialized position."""
    store = humble_types()
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "odom")
    point, turn = types["geometry_msgs/msg/Point"](x, y, 0.0), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    still = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    none = np.zeros(36)
    pose = types["geometry_msgs/msg/PoseWithCovariance"](types["geometry_msgs/msg/Pose"](point, turn), none)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](types["geometry_msgs/msg/Twist"](still, still), none)
    message = types["nav_msgs/msg/Odometry"](header, "base_link", pose, twist)
    return bytes(store.serialize_cdr(message, "nav_msgs/msg/Odometry"))


def recorded() -> Recorder:
    """Every 0.1 s an odometry message in two packets, every fourth time with an IMU message in the second one.

    The first TOO_LARGE are refused; of every fourth, LOST in all, the second packet is lost; the last UNSENT stay, and
    the IN_FLIGHT before them do not arrive. A packet takes 50 ms, a message 70 ms.
    """
    recorder = Recorder(REGISTRY, {1: "/robot_1"})
    serial = number = 0
    for step in range(ODOM):
        now = T0 + step / 10
        payload = odometry(step, step / 2)
        odom, serial = serial, serial + 1
        recorder.sender_event(1, Accepted(odom, 0, payload, now))
        if step < TOO_LARGE:
            recorder.sender_event(1, Refused(odom, 0, "too_large"))
            continue
        imu = -1
        if step % 4 == 0:
            imu, serial = serial, serial + 1
            recorder.sender_event(1, Accepted(imu, 1, b"imu %d" % step, now))
        if step >= ODOM - UNSENT:
            continue
        for index in (0, 1):
            record = [SentEntry(odom, 0, step, index, 2)]
            if imu >= 0 and index == 0:
                record.append(SentEntry(imu, 1, step, 0, 1))
            entries = tuple(
                EntryV0(e.topic_id, step, e.index, e.total, bytes([step, e.topic_id, e.index])) for e in record
            )
            packet = PacketV0(1, 255, number & 255, 1, entries)
            data = V0.encode(packet, 64)
            number += 1
            left = now + (index + 1) * 0.02 - 0.02
            identity = PacketId(1, 0, number, 0)
            recorder.sender_event(1, SentPacket(data, packet, *identity, tuple(record), left))
            lost = step % 4 == 3 and index == 1 and step < 4 * LOST + 2
            if lost or step >= ODOM - UNSENT - IN_FLIGHT:
                continue
            recorder.receiver_event(Received(data, packet, *identity), left + 0.05)
            if imu >= 0 and index == 0:
                recorder.receiver_event(Delivered(1, 1, b"imu %d" % step, 0, step), left + 0.05)
            if index == 1:
                recorder.receiver_event(Delivered(1, 0, payload, 0, step), left + 0.05)
    return recorder


def make_run(directory: Path, scenario: str = "paper-ofdm", *, missed: int = 0) -> Run:
    """The run, written into a folder; before, the ROS graph lost ``missed`` odometry messages besides."""
    recorder = recorded()
    if missed:
        recorder.sender_event(1, Missed(0, missed))
    topics = recorder.finish(DURATION_S, T0 + DURATION_S)
    result = Result(
        scenario=scenario,
        seed=3,
        duration_s=DURATION_S,
        config={"name": scenario, "description": "made <by> hand", "time": "real"},
        topics=topics,
        packets=recorder.ledger.packets(),
        phy={"name": "ofdm", "sample_rate": 1e5, **recorder.airtime(lambda *_: AIRTIME_S)},
        counters={"source": {"packets": 1}},
    )
    trace = recorder.trace(T0, T0 + DURATION_S, {"/robot_1/odom": "/rx_robot_1/odom"})
    directory.mkdir(parents=True, exist_ok=True)
    write_trace(trace, directory)
    write_result(result, directory)
    return Run(directory, scenario, result, trace)


def empty_trace() -> Trace:
    """A run in which nothing was sent."""
    recorder = Recorder(REGISTRY, {1: "/robot_1"})
    recorder.finish(1, 1)
    return recorder.trace(0, 1, {})
