"""Clouds: exact ones to the byte, voxels within half an edge, any layout of fields."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.codecs import CodedTopic, octree
from gr_ros2.codecs.messages import CLOUD, read, write
from gr_ros2.core.errors import DamagedError
from tests.codecs.scenes import Array, cloud, street

XYZ = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7))
LAYOUTS: dict[str, dict[str, Any]] = {
    "usual": {},
    "odd offsets": {"layout": (("x", 9, 7), ("y", 17, 7), ("z", 1, 7)), "step": 23},
    "doubles": {"layout": (("x", 0, 8), ("y", 8, 8), ("z", 16, 8), ("ring", 24, 4)), "step": 26},
    "big endian": {"big": True},
    "rows with padding": {"row_padding": 7},
    "tight": {"layout": XYZ, "step": 12},
}


def through(message: bytes, budget: int | None = None, **options: Any) -> tuple[Array, Any, str]:
    """The points that come out, shape (n, 3); the message; what was said."""
    topic = CodedTopic(CLOUD, {"cloud": options})
    coded = topic.encoder().encode(message, budget)
    found = read(CLOUD, topic.decoder().decode(coded.data))
    points = np.frombuffer(found.data, "<f4").reshape(found.width, found.point_step // 4)
    return points[:, :3], found, coded.said


def in_voxels(given: Array, out: Array, edge: float) -> bool:
    """Whether every point has one that comes out within half an edge for each axis, and none comes from nowhere."""
    near = edge / 2 + 4 * np.finfo(np.float32).eps * np.abs(given).max(initial=1)
    for part in np.array_split(given, len(given) // 200 + 1):
        if len(part) and not (np.abs(part[:, None] - out[None]).max(2) <= near).any(1).all():
            return False
    return all((np.abs(given - one).max(1) <= near).any() for one in out)


def finite(points: Array, reach: float = np.inf) -> Array:
    flat = points.reshape(-1, points.shape[2])[:, :3].astype(np.float64)
    return flat[np.isfinite(flat).all(1) & (np.linalg.norm(flat, axis=1) <= reach)]


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_exact_clouds_are_exact(layout: dict[str, Any]) -> None:
    message = cloud(street(0, 8, 100), **layout)
    topic = CodedTopic(CLOUD)
    coded = topic.encoder().encode(message)
    assert topic.decoder().decode(coded.data) == message
    assert not coded.said


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_voxels_are_within_half_an_edge_whatever_the_fields(layout: dict[str, Any]) -> None:
    points = street(0, 8, 150)
    out, message, said = through(cloud(points, **layout), voxel=0.3, range=40.0)
    assert in_voxels(finite(points, 40), out, 0.3)
    assert (message.height, message.is_dense, message.is_bigendian) == (1, True, False)
    assert "voxels of 0.3 m; without " in said


def test_the_points_left_out_are_counted_and_the_fields_are_named() -> None:
    points = np.ones((1, 5, 4), np.float32)
    points[0, :4, 0] = np.nan, np.inf, -np.inf, 31
    out, _, said = through(cloud(points), voxel=0.5, range=30.0)
    assert len(out) == 1
    expected = "without 4 of 5 points, which are not finite or beyond 30 m; without intensity"
    assert said == f"voxels of 0.5 m; {expected}"


@pytest.mark.parametrize("shape", [(0, 0, 4), (1, 0, 4), (2, 3, 4)])
def test_clouds_without_a_point_come_out_empty(shape: tuple[int, ...]) -> None:
    message = cloud(np.full(shape, np.nan, np.float32))
    assert len(through(message, voxel=0.1)[0]) == 0
    topic = CodedTopic(CLOUD)
    assert topic.decoder().decode(topic.encoder().encode(message).data) == message


def test_a_budget_makes_voxels_coarser_in_small_steps() -> None:
    points = street(0, 8, 150)
    message = cloud(points)
    for budget in (1500, 500, 100):
        out, _, said = through(message, budget, voxel=0.05)
        steps = 4 * np.log2(float(said.split()[2]) / 0.05)
        assert steps == pytest.approx(round(steps), abs=0.03)
        assert in_voxels(finite(points), out, 0.05 * 2 ** (round(steps) / 4))


def test_a_chain_of_clouds_keeps_within_its_budget_and_wastes_little_of_it() -> None:
    messages = [cloud(street(number, 16, 900)) for number in range(4)]
    for budget in (400, 1500, 5000):
        encoder = CodedTopic(CLOUD, {"cloud": {"voxel": 0.05, "range": 30.0}}).encoder()
        sizes = [len(encoder.encode(messages[n % 4], budget * (1 + n // 8)).data) / (1 + n // 8) for n in range(16)]
        assert max(sizes) <= budget
        assert np.median(sizes) > 0.7 * budget


def test_intensity_is_the_mean_of_a_voxel() -> None:
    points = np.zeros((1, 6, 4), np.float32)
    points[0, :, 0] = (0.1, 0.2, 5.1, 5.2, 5.3, 9)
    points[0, :, 3] = (10, 30, 1, 2, 3, 100)
    _, message, _ = through(cloud(points), voxel=1.0, keep="intensity")
    values = np.frombuffer(message.data, "<f4").reshape(-1, 4)
    assert [field.name for field in message.fields] == ["x", "y", "z", "intensity"]
    assert values[:, 3] == pytest.approx([20, 2, 100], abs=98 / 255)


def test_colour_is_the_mean_of_a_voxel() -> None:
    points = np.zeros((1, 3, 4), np.float32)
    points[0, 2, 0] = 5
    packed = np.array([0x102030, 0x304050, 0xFF0080], "<u4")
    points[0, :, 3] = packed.view("<f4")
    _, message, _ = through(cloud(points, layout=(*XYZ, ("rgb", 16, 7))), voxel=1.0, keep="rgb")
    values = np.frombuffer(message.data, "<u4").reshape(-1, 4)
    assert values[:, 3].tolist() == [0x203040, 0xFF0080]


def test_clouds_far_away_are_as_exact_as_their_numbers() -> None:
    points = street(0, 4, 100)[:, :, :3].astype(np.float64) + np.array([4e5, 5e6, 100])
    message = cloud(points, layout=(("x", 0, 8), ("y", 8, 8), ("z", 16, 8)), step=24)
    assert in_voxels(finite(points), through(message, voxel=1.0)[0], 1.0)


def test_voxels_too_small_for_their_extent_pass_exactly() -> None:
    points = np.array([[[0, 0, 0, 0], [1e6, 0, 0, 0], [1e30, 1, 1, 0]]], np.float32)
    _, message, said = through(cloud(points), voxel=0.01)
    assert message.width == 3
    assert said.startswith("cloud: more than 1048576 voxels of 0.01 m side by side")


@pytest.mark.parametrize("change", [{"width": 9}, {"height": 2}, {"point_step": 25}, {"row_step": 1}, {"data": b""}])
def test_a_size_that_does_not_fit_is_damaged(change: dict[str, Any]) -> None:
    good = read(CLOUD, cloud(street(0, 1, 8)))
    names = ("header", "height", "width", "fields", "is_bigendian", "point_step", "row_step", "data", "is_dense")
    fields = {name: getattr(good, name) for name in names} | change
    fields["data"] = np.frombuffer(bytes(fields["data"]), np.uint8)
    for options in ({}, {"voxel": 0.1}):
        with pytest.raises(DamagedError, match=r"damaged cloud: .* do not fit its .* bytes"):
            CodedTopic(CLOUD, {"cloud": options}).encoder().encode(write(CLOUD, **fields))


places = st.lists(st.tuples(*[st.integers(0, (1 << octree.MAX_LEVELS) - 1)] * 3), min_size=1, max_size=40)


@given(places)
def test_any_cells_come_back_from_an_octree(cells: list[tuple[int, int, int]]) -> None:
    codes = np.unique(octree.numbers(np.array(cells, np.uint64).T))
    assert set(map(tuple, octree.cells(codes).T.tolist())) == set(cells)
    levels = octree.levels(codes, octree.MAX_LEVELS)
    assert np.array_equal(octree.leaves(b"".join(levels), octree.MAX_LEVELS, 40), codes)
    coarse = octree.leaves(b"".join(levels[:-1]), octree.MAX_LEVELS - 1, 40)
    assert np.array_equal(coarse, np.unique(codes >> np.uint64(3)))


@given(st.binary(max_size=60), st.integers(0, 6))
def test_any_bytes_are_an_octree_of_few_leaves_or_damaged(tree: bytes, count: int) -> None:
    try:
        codes = octree.leaves(tree, count, 20)
    except DamagedError:
        return
    assert len(codes) <= 20
    assert b"".join(octree.levels(codes, count)) == tree


@settings(max_examples=60)
@given(
    st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=30),
    st.sampled_from([0.0, 0.1, 3.0]),
    st.booleans(),
)
def test_any_points_come_out(points: list[tuple[float, ...]], voxel: float, big: bool) -> None:
    given_points = np.array(points, np.float32).reshape(1, -1, 3)
    message = cloud(given_points, layout=XYZ, big=big)
    topic = CodedTopic(CLOUD, {"cloud": {"voxel": voxel}})
    coded = topic.encoder().encode(message)
    out = topic.decoder().decode(coded.data)
    if not voxel or not coded.said.startswith("voxels"):
        assert out == message
        return
    found = np.frombuffer(read(CLOUD, out).data, "<f4").reshape(-1, 3)
    assert in_voxels(finite(given_points), found, voxel)
