"""ROS messages as values, and back to the bytes that DDS carries.

Invariants: both byte orders are read, little endian is written; a message that cannot be read as its type is a
DamagedError.
"""

from __future__ import annotations

from functools import cache
from struct import Struct
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import DamagedError
from gr_ros2.middleware.type_definitions import DAMAGED, MADE
from gr_ros2.wire import varint

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
VIDEO, PACKET = "foxglove_msgs/msg/CompressedVideo", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
CLOUD, GRID = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid"
GRID_UPDATE = "map_msgs/msg/OccupancyGridUpdate"
_UPDATE_TEXT = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n"

_STAMP = Struct("<iI")


@cache
def store() -> Typestore:
    """The types of Humble, those of video, and the changes of a map."""
    found = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in {**MADE, GRID_UPDATE: _UPDATE_TEXT}.items():
        found.register(get_types_from_msg(text, name))
    return found


def read(type_name: str, message: bytes) -> Any:
    """The message as a value.

    :raises DamagedError: when the bytes are not such a message
    """
    try:
        return store().deserialize_cdr(message, type_name)
    except DAMAGED as error:
        raise DamagedError(f"damaged message: not a {type_name} ({' '.join(str(error).split())})") from error


def write(type_name: str, **fields: Any) -> bytes:
    """The bytes of a message of these fields."""
    return bytes(store().serialize_cdr(store().types[type_name](**fields), type_name))


class Origin:
    """When and where a message was made: stamp and frame of its header, as a few bytes of a frame."""

    def __init__(self, header: Any) -> None:
        self.sec, self.nanosec, self.frame_id = int(header.stamp.sec), int(header.stamp.nanosec), str(header.frame_id)

    def stamp(self) -> bytes:
        """Eight bytes."""
        return _STAMP.pack(self.sec, self.nanosec)


def stamp_of(data: bytes) -> Any:
    """The stamp of 8 bytes.

    :raises DamagedError: of fewer
    """
    if len(data) < _STAMP.size:
        raise DamagedError("damaged frame: it is cut short")
    sec, nanosec = _STAMP.unpack_from(data)
    return store().types["builtin_interfaces/msg/Time"](sec, nanosec)


def header_of(stamp: Any, frame_id: str) -> Any:
    """A header."""
    return store().types["std_msgs/msg/Header"](stamp, frame_id)


def text(value: str) -> bytes:
    """A text as a part of a frame, its length first."""
    data = value.encode()
    return varint(len(data)) + data


def take(data: bytes, count: int) -> tuple[bytes, bytes]:
    """The first bytes, and the rest.

    :raises DamagedError: when there are fewer
    """
    if count > len(data):
        raise DamagedError("damaged frame: it is cut short")
    return data[:count], data[count:]


def take_text(data: bytes) -> tuple[str, bytes]:
    """A text and what follows it.

    :raises DamagedError: cut short, or not a text
    """
    length, begin = read_varint(data)
    value, rest = take(data[begin:], length)
    try:
        return value.decode(), rest
    except UnicodeDecodeError as error:
        raise DamagedError("damaged frame: a text that is not UTF-8") from error
