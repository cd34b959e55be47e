"""The sensors of one robot: true motion and a generator in, serialized ROS 2 messages out.

Invariants: payloads are CDR, little endian, with the 4-byte encapsulation header. Every topic has its own generator, so
the bytes of one topic do not depend on the rate of another. Stamps are counted in ns from the start time that is passed
in. Frame names are those of REP 105. With them an Odometry is 724 B and an Imu 324 B, as in common recordings.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Final

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gr_ros2.core.arrays import Floats
from gr_ros2_lab.sim.camera import HEIGHT, WIDTH, picture
from gr_ros2_lab.sim.motion import MAX_TURN, RADIUS, State
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.sim.world import World

TYPES: Final = {
    "scan": "sensor_msgs/msg/LaserScan",
    "odom": "nav_msgs/msg/Odometry",
    "imu": "sensor_msgs/msg/Imu",
    "cmd_vel": "geometry_msgs/msg/Twist",
    "map": "nav_msgs/msg/OccupancyGrid",
    "clock": "rosgraph_msgs/msg/Clock",
}
"""The paper's table 4."""
RTCM: Final = "rtcm"
CAMERA: Final = "camera"
ALL_TYPES: Final = {**TYPES, RTCM: "rtcm_msgs/msg/Message", CAMERA: "sensor_msgs/msg/Image"}
"""And the corrections of a base station, in the type that GNSS drivers use for them, and a camera."""
ALWAYS_HZ: Final = {"cmd_vel": 10.0, "clock": 10.0}
"""Rates that nobody sets: those of a usual controller, and of a usual clock."""
GRAVITY: Final = 9.80665
SCAN_RANGE: Final = 12.0
"""Farthest range that the scanner measures, m; beyond it a beam reads +inf (REP 117)."""
SCAN_NOISE: Final = 0.01
"""Standard deviation of a range, m."""
IMU_GYRO_NOISE: Final = 0.01
"""Standard deviation of a turn rate, rad/s."""
IMU_ACCEL_NOISE: Final = 0.1
"""Standard deviation of an acceleration, m/s^2."""
IMU_ORIENTATION_NOISE: Final = 0.01
"""Standard deviation of the orientation about each axis, rad."""
_SCAN_MIN: Final = 0.05
_STORE: Final = get_typestore(Stores.ROS2_HUMBLE)
_STORE.register(get_types_from_msg("std_msgs/Header header\nuint8[] message\n", ALL_TYPES[RTCM]))
_TYPE: Final[dict[str, Any]] = {name: _STORE.types[name] for name in _STORE.types}
_HEADER, _TIME = _TYPE["std_msgs/msg/Header"], _TYPE["builtin_interfaces/msg/Time"]
_POINT, _POSE = _TYPE["geometry_msgs/msg/Point"], _TYPE["geometry_msgs/msg/Pose"]
_QUATERNION, _VECTOR = _TYPE["geometry_msgs/msg/Quaternion"], _TYPE["geometry_msgs/msg/Vector3"]
_TWIST = _TYPE["geometry_msgs/msg/Twist"]
_TWIST_CDR: Final = {order: struct.Struct(f"{order}6d") for order in "<>"}


class Sensors:
    """All topics of one robot.

    :param start_ns: stamp of t = 0, ns
    :param start: true state at t = 0, where the odometry starts too
    """

    def __init__(self, settings: SimSettings, world: World, robot_id: int, start: State, start_ns: int) -> None:
        self._settings, self._world, self._start_ns = settings, world, start_ns
        self._prefix = settings.frame_prefix(robot_id)
        # One generator per topic. The 2 separates their seeds from those of world and routes, which have 0 and 1.
        self._rng = {name: np.random.default_rng([settings.seed, 2, robot_id, i]) for i, name in enumerate(ALL_TYPES)}
        self._odom_pose = (start.x, start.y, start.heading)
        self._odom_t = 0.0
        rng = self._rng["imu"]
        self._gyro_bias = rng.normal(0.0, IMU_GYRO_NOISE / 5, 3)
        self._accel_bias = rng.normal(0.0, IMU_ACCEL_NOISE / 5, 3)
        turn = 2 * math.pi / settings.beams
        self._bearings: Floats = -math.pi + turn * np.arange(settings.beams, dtype=np.float64)
        # Variances as drivers fill them in: position, height, roll, pitch and heading.
        pose = (1e-3, 1e-3, 1e6, 1e6, 1e6, 3e-2)
        speed_noise, turn_noise = settings.odom_noise
        twist = (speed_noise**2, 1e-6, 1e6, 1e6, 1e6, turn_noise**2)
        self._pose_covariance, self._twist_covariance = np.diag(pose).ravel(), np.diag(twist).ravel()
        self._imu_covariance = [
            np.diag([noise**2] * 3).ravel() for noise in (IMU_ORIENTATION_NOISE, IMU_GYRO_NOISE, IMU_ACCEL_NOISE)
        ]

    def read(self, topic: str, t: float, state: State, others: Sequence[State]) -> bytes:
        """The message of one topic at simulated time ``t``, which is not before the topic's last message.

        :param others: states of the other robots at ``t``
        """
        message = getattr(self, f"_{topic}")(t, state, others)
        return bytes(_STORE.serialize_cdr(message, ALL_TYPES[topic]))

    def localize(self, t: float, state: State) -> None:
        """Let the odometry go on from the true place, which it drifts away from otherwise."""
        self._odom_pose, self._odom_t = (state.x, state.y, state.heading), t

    def _time(self, t: float) -> Any:
        ns = self._start_ns + round(t * 1e9)
        return _TIME(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)

    def _header(self, t: float, frame: str) -> Any:
        return _HEADER(stamp=self._time(t), frame_id=f"{self._prefix}{frame}")

    def _scan(self, t: float, state: State, others: Sequence[State]) -> Any:
        settings = self._settings
        round_things = np.array([(other.x, other.y, RADIUS) for other in others], dtype=np.float64).reshape(-1, 3)
        ranges = self._world.cast(state.x, state.y, self._bearings + state.heading, round_things)
        ranges = ranges + self._rng["scan"].normal(0.0, SCAN_NOISE, settings.beams)
        ranges = np.where(ranges > SCAN_RANGE, np.inf, np.maximum(ranges, _SCAN_MIN))
        turn = 2 * math.pi / settings.beams
        return _TYPE["sensor_msgs/msg/LaserScan"](
            header=self._header(t, "laser"),
            angle_min=-math.pi,
            angle_max=float(self._bearings[-1]),
            angle_increment=turn,
            time_increment=0.0,
            scan_time=1.0 / settings.scan_rate,
            range_min=_SCAN_MIN,
            range_max=SCAN_RANGE,
            ranges=ranges.astype(np.float32),
            intensities=np.empty(0, dtype=np.float32),
        )

    def _odom(self, t: float, state: State, others: Sequence[State]) -> Any:  # noqa: ARG002
        (speed_noise, turn_noise), drawn = self._settings.odom_noise, self._rng["odom"].standard_normal(2).tolist()
        speed = state.speed + speed_noise * drawn[0]
        turn = state.turn + turn_noise * drawn[1]
        dt, self._odom_t = t - self._odom_t, t
        x, y, heading = self._odom_pose
        middle = heading + 0.5 * turn * dt
        x, y, heading = x + speed * dt * math.cos(middle), y + speed * dt * math.sin(middle), heading + turn * dt
        self._odom_pose = (x, y, heading)
        pose = _POSE(position=_POINT(x=x, y=y, z=0.0), orientation=_quaternion(0.0, 0.0, heading))
        return _TYPE["nav_msgs/msg/Odometry"](
            header=self._header(t, "odom"),
            child_frame_id=f"{self._prefix}base_link",
            pose=_TYPE["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=self._pose_covariance),
            twist=_TYPE["geometry_msgs/msg/TwistWithCovariance"](
                twist=_twist(speed, turn), covariance=self._twist_covariance
            ),
        )

    def _imu(self, t: float, state: State, others: Sequence[State]) -> Any:  # noqa: ARG002
        noise = self._rng["imu"].standard_normal((3, 3))
        tilt = (IMU_ORIENTATION_NOISE * noise[0]).tolist()
        gyro = (self._gyro_bias + IMU_GYRO_NOISE * noise[1]).tolist()
        accel = (self._accel_bias + IMU_ACCEL_NOISE * noise[2]).tolist()
        orientation, angular, linear = self._imu_covariance
        return _TYPE["sensor_msgs/msg/Imu"](
            header=self._header(t, "imu_link"),
            orientation=_quaternion(tilt[0], tilt[1], state.heading + tilt[2]),
            orientation_covariance=orientation,
            angular_velocity=_VECTOR(x=gyro[0], y=gyro[1], z=state.turn + gyro[2]),
            angular_velocity_covariance=angular,
            linear_acceleration=_VECTOR(
                x=state.acceleration + accel[0], y=state.speed * state.turn + accel[1], z=GRAVITY + accel[2]
            ),
            linear_acceleration_covariance=linear,
        )

    def _cmd_vel(self, t: float, state: State, others: Sequence[State]) -> Any:  # noqa: ARG002
        """``state`` is the motion at the end of the period, which is the command."""
        return _twist(state.speed, max(-MAX_TURN, min(MAX_TURN, state.turn)))

    def _map(self, t: float, state: State, others: Sequence[State]) -> Any:  # noqa: ARG002
        cells = self._settings.map_cells
        origin, resolution = self._world.map_origin_resolution(cells)
        return _TYPE["nav_msgs/msg/OccupancyGrid"](
            header=self._header(t, "map"),
            info=_TYPE["nav_msgs/msg/MapMetaData"](
                map_load_time=self._time(0.0),
                resolution=resolution,
                width=cells,
                height=cells,
                origin=_POSE(position=_POINT(x=origin, y=origin, z=0.0), orientation=_quaternion(0.0, 0.0, 0.0)),
            ),
            data=self._world.occupancy(cells).ravel(),
        )

    def _clock(self, t: float, state: State, others: Sequence[State]) -> Any:  # noqa: ARG002
        return _TYPE["rosgraph_msgs/msg/Clock"](clock=self._time(t))

    def _rtcm(self, t: float, state: State, others: Sequence[State]) -> Any:  # noqa: ARG002
        """The observations of an epoch, one frame (RTCM 10403.3, section 4) per constellation. Their bits are noise to
        every compression, so they are random here."""
        frames = b"".join(_rtcm_frame(number, self._rng[RTCM].bytes(_MSM4_LEN - 2)) for number in _MSM4)
        return _TYPE[ALL_TYPES[RTCM]](header=self._header(t, "gnss"), message=np.frombuffer(frames, np.uint8))

    def _camera(self, t: float, state: State, others: Sequence[State]) -> Any:
        view = picture(self._world, state, others, self._rng[CAMERA])
        return _TYPE[ALL_TYPES[CAMERA]](
            header=self._header(t, "camera"),
            height=HEIGHT,
            width=WIDTH,
            encoding="rgb8",
            is_bigendian=0,
            step=3 * WIDTH,
            data=view.ravel(),
        )


_MSM4: Final = (1074, 1084, 1094, 1124)
"""Messages MSM4 of GPS, GLONASS, Galileo and BeiDou."""
_MSM4_LEN: Final = 164
"""Bytes of one with 10 satellites of two signals each: 169 + 10 * 18 + 20 * 48 bits."""


def _rtcm_frame(number: int, rest: bytes) -> bytes:
    """A frame: preamble, length, a message that begins with its number of 12 bits, and the CRC-24Q of all that."""
    body = (number << 4).to_bytes(2, "big") + rest
    frame = b"\xd3" + len(body).to_bytes(2, "big") + body
    crc = 0
    for byte in frame:
        crc ^= byte << 16
        for _ in range(8):
            crc = crc << 1 ^ (0x1864CFB if crc & 0x800000 else 0)
    return frame + (crc & 0xFFFFFF).to_bytes(3, "big")


@lru_cache(maxsize=1024)  # all robots that hear a message ask for the same
def read_odometry(payload: bytes) -> tuple[int, State]:
    """The stamp in ns of a serialized odometry of a robot on the ground, and what it says."""
    message: Any = _STORE.deserialize_cdr(payload, TYPES["odom"])
    stamp, pose, twist = message.header.stamp, message.pose.pose, message.twist.twist
    heading = 2 * math.atan2(pose.orientation.z, pose.orientation.w)
    state = State(pose.position.x, pose.position.y, heading, twist.linear.x, twist.angular.z)
    return stamp.sec * 1_000_000_000 + stamp.nanosec, state


def write_command(speed: float, turn: float) -> bytes:
    """A serialized ``geometry_msgs/msg/Twist`` for a robot on the ground, m/s and rad/s."""
    return bytes(_STORE.serialize_cdr(_twist(speed, turn), TYPES["cmd_vel"]))


def read_command(payload: bytes) -> tuple[float, float] | None:
    """Speed and turn rate of a serialized Twist; None for bytes that are none, or numbers that are not finite."""
    if len(payload) < 4 + _TWIST_CDR["<"].size:
        return None
    order = "<" if payload[1] & 1 else ">"  # RTPS 9.4.2.14: representation identifiers of little endian are odd
    speed, *_, turn = _TWIST_CDR[order].unpack_from(payload, 4)
    return (speed, turn) if math.isfinite(speed) and math.isfinite(turn) else None


def _twist(speed: float, turn: float) -> Any:
    return _TWIST(linear=_VECTOR(x=speed, y=0.0, z=0.0), angular=_VECTOR(x=0.0, y=0.0, z=turn))


def _quaternion(roll: float, pitch: float, yaw: float) -> Any:
    """The quaternion of the three half-angle rotations, rad (REP 103 axes). Roll and pitch are small tilts."""
    sr, cr = math.sin(roll / 2), math.cos(roll / 2)
    sp, cp = math.sin(pitch / 2), math.cos(pitch / 2)
    sy, cy = math.sin(yaw / 2), math.cos(yaw / 2)
    return _QUATERNION(
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
        w=cr * cp * cy + sr * sp * sy,
    )
