"""Arrays are turned back exactly."""

from __future__ import annotations

import contextlib
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.compression import bulk
from gr_ros2.compression.zstd_frames import Zstd, read_varint
from gr_ros2.core.errors import DamagedError
from gr_ros2.wire import varint

special = st.sampled_from([math.inf, -math.inf, math.nan, -0.0])
ranges = st.lists(st.floats(0, 100) | special, min_size=1, max_size=99)


@given(st.sampled_from([1, 2, 4, 8]), st.booleans(), st.binary(max_size=400))
def test_any_array(size: int, real: bool, data: bytes) -> None:
    data = data[: len(data) - len(data) % size]
    way, parameter, turned = bulk.transform(data, size, real, len)
    assert len(turned) == len(data)
    assert bulk.inverse_transform(way, parameter, turned, size) == data


@given(ranges, st.integers(0, 4))
def test_ranges_in_whole_steps_become_decimals(values: list[float], decimals: int) -> None:
    data = struct.pack(f"<{len(values)}f", *(round(v, decimals) if math.isfinite(v) else v for v in values))
    way, parameter, turned = bulk.transform(data, 4, True, len)
    assert way == bulk.DECIMALS
    assert bulk.inverse_transform(way, parameter, turned, 4) == data


@given(st.sampled_from([1, 2, 4, 8]), st.integers(0, 9), st.integers(0, 9), st.binary(max_size=100))
def test_arbitrary_ways_end_in_bytes_or_a_value_error(size: int, way: int, parameter: int, data: bytes) -> None:
    with contextlib.suppress(ValueError):
        assert len(bulk.inverse_transform(way, parameter, data, size)) == len(data)


@given(st.binary(max_size=3000) | st.binary(max_size=40).map(lambda b: b * 50), st.binary(max_size=64))
def test_zstd_frames_come_back(data: bytes, dictionary: bytes) -> None:
    zstd = Zstd(dictionary if len(dictionary) >= 8 else b"")
    assert zstd.decompress(zstd.compress(data), 3000) == data
    assert zstd.decompress(zstd.compress(data, sized=False), 3000, len(data)) == data


@given(st.binary(max_size=100))
def test_arbitrary_frames_end_in_bytes_or_damage(coded: bytes) -> None:
    with contextlib.suppress(DamagedError):
        assert len(Zstd().decompress(coded, 1000)) <= 1000


@given(st.integers(0, (1 << 35) - 1))
def test_varints(value: int) -> None:
    assert read_varint(varint(value) + b"x") == (value, len(varint(value)))
    with pytest.raises(DamagedError):
        read_varint(varint(value)[:-1])
