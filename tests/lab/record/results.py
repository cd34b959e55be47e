"""A result to write, read, tabulate."""

from __future__ import annotations

from gr_ros2.observe.result import AgeResult, LatencyResult, TopicResult
from gr_ros2_lab.record.result import Result

ODOM = TopicResult(
    topic="/robot_1/odom",
    type="nav_msgs/msg/Odometry",
    src_id=1,
    sent=10,
    delivered=9,
    pdr=0.9,
    goodput_Bps=123.5,
    latency_s=LatencyResult(0.1, 0.2, 0.3, 0.4),
    latency_clock="submit",
    age_s=AgeResult(0.05, 0.5),
    path_error_m=0.01,
    ledger={"delivered": 9, "lost_fragments": 1},
    latency_cdf_s=(0.1, 0.4),
)
IMU = TopicResult(
    topic="/robot_1/imu",
    type="sensor_msgs/msg/Imu",
    src_id=1,
    sent=0,
    delivered=0,
    pdr=None,
    goodput_Bps=0.0,
    latency_s=LatencyResult(),
    latency_clock=None,
    age_s=AgeResult(),
    path_error_m=None,
    ledger={},
)
RESULT = Result(
    scenario="paper-direct",
    seed=3,
    duration_s=15.0,
    config={"name": "paper-direct", "channel": {"taps": ["1+0j"]}},
    topics=(ODOM, IMU),
    packets={"sent": 150, "received": 149, "crc_failed": 1, "malformed": 0},
    phy={"name": "direct", "sample_rate": None, "airtime_s": None},
)
