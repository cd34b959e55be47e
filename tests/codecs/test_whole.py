"""Clouds in a link's message codec."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.codecs.messages import CLOUD, read
from gr_ros2.compression.link_codec import WHOLE
from gr_ros2.core.errors import CodecError, ConfigError
from gr_ros2.gr.factory import message_codec
from gr_ros2.settings.config import SendOptions, build
from gr_ros2.settings.registry import Topic
from tests.codecs.scenes import cloud, street


def codec_of(**options: object) -> object:
    return message_codec([Topic(0, "points", CLOUD, build(SendOptions, options))])


def test_an_exact_cloud_is_much_shorter_than_by_zstd_and_comes_out_to_the_byte() -> None:
    message = cloud(
        street(columns=450)[:, :, :4], step=16, layout=(("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("i", 12, 7))
    )
    ours, zstd = codec_of(), codec_of(codec="zstd")
    coded = ours.encode(0, message)
    assert coded[0] == WHOLE
    assert len(coded) < 0.85 * len(zstd.encode(0, message))
    receiver = message_codec([Topic(0, "points", CLOUD)])  # knows the type from the table, and no option
    assert receiver.decode(0, coded) == message == ours.canonical(0, message)


def test_cells_come_out_as_they_were_said_to() -> None:
    message = cloud(street(columns=450))
    ours = codec_of(cloud={"voxel": 0.2, "range": 30.0})
    coded = ours.encode(0, message)
    assert len(coded) < 8000
    came = message_codec([Topic(0, "points", CLOUD)]).decode(0, coded)
    assert came == ours.canonical(0, message) != message
    points = np.frombuffer(bytes(read(CLOUD, came).data), "<f4").reshape(-1, 3)
    assert len(points) > 500
    assert np.abs(points).max() <= 30.2


def test_range_and_keep_say_what_of_a_cloud_leaves() -> None:
    message = cloud(street(columns=450))
    cells = {"voxel": 0.2}
    names = {}
    for keep in ("", "intensity"):
        came = codec_of(cloud={**cells, "keep": keep}).canonical(0, message)
        names[keep] = [field.name for field in read(CLOUD, came).fields]
    assert names == {"": ["x", "y", "z"], "intensity": ["x", "y", "z", "intensity"]}
    near, all_of_it = (len(codec_of(cloud={**cells, **more}).encode(0, message)) for more in ({"range": 10.0}, {}))
    assert near < all_of_it


def test_what_contradicts_itself_and_what_no_codec_is_for_passes_as_it_is() -> None:
    ours = codec_of()
    broken = bytearray(cloud(street(rings=4, columns=50)))
    broken[4 + 12 + 4 + 6 : 4 + 12 + 4 + 12] = b"\xff" * 6  # height and width fit no data
    for message in (bytes(broken), bytes(broken[:30]), b"\0\1\0\0"):
        assert ours.decode(0, ours.encode(0, message)) == ours.canonical(0, message)
    other = message_codec([Topic(0, "odom", "nav_msgs/msg/Odometry")])
    with pytest.raises(CodecError, match="unknown codec 4"):
        other.decode(0, bytes([WHOLE, 3]) + b"x" * 20)


@given(st.binary(max_size=300))
def test_any_bytes_are_a_message_or_a_codec_error(body: bytes) -> None:
    receiver = message_codec([Topic(0, "points", CLOUD)])
    try:
        came = receiver.decode(0, bytes([WHOLE]) + body)
    except CodecError:
        return
    assert len(came) <= (1 << 16) + (1 << 12) * len(body)


def test_an_option_without_effect_is_refused() -> None:
    with pytest.raises(ConfigError, match="an exact cloud has every point"):
        build(SendOptions, {"cloud": {"range": 30.0}})
