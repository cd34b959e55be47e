"""The room: distances, rays and map agree with each other and with plain geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gr_ros2_lab.sim.world import GAP, World


@pytest.fixture(scope="module", params=range(4))
def world(request: pytest.FixtureRequest) -> World:
    return World(20.0, 12, np.random.default_rng(request.param))


def test_an_empty_room_has_walls_only() -> None:
    room = World(10.0, 0, np.random.default_rng(0))
    assert room.clearance(np.array([[5.0, 5.0], [1.0, 5.0], [-1.0, 5.0]])).tolist() == [5.0, 1.0, -1.0]
    rays = room.cast(2.0, 3.0, np.array([0.0, math.pi / 2, math.pi, -math.pi / 2]))
    assert rays == pytest.approx([8.0, 7.0, 2.0, 3.0])


def test_obstacles_leave_room_to_pass(world: World) -> None:
    assert len(world.boxes) >= 4
    assert len(world.circles) >= 4
    edges = [world.circles]
    edges.append(np.column_stack([world.boxes[:, :2], np.hypot(world.boxes[:, 2], world.boxes[:, 3])]))
    discs = np.concatenate(edges)
    for i, (x, y, reach) in enumerate(discs):
        assert min(x, y, world.size - x, world.size - y) - reach >= GAP - 1e-9
        for ox, oy, other in discs[:i]:
            assert math.hypot(x - ox, y - oy) - reach - other >= GAP - 1e-9


def test_rays_end_on_the_first_surface(world: World) -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform(0.2, world.size - 0.2, (40, 2))
    free = points[world.clearance(points) > 0.1]
    assert len(free) > 10
    for x, y in free:
        angles = rng.uniform(-math.pi, math.pi, 50)
        ranges = world.cast(x, y, angles)
        direction = np.column_stack([np.cos(angles), np.sin(angles)])
        ends = np.array([x, y]) + ranges[:, None] * direction
        assert np.abs(world.clearance(ends)).max() < 1e-9
        on_the_way = np.array([x, y]) + (np.linspace(0, 0.999, 60)[:, None] * ranges)[..., None] * direction
        assert world.clearance(on_the_way).min() > 0


def test_rays_see_other_robots() -> None:
    room = World(10.0, 0, np.random.default_rng(0))
    others = np.array([[7.0, 5.0, 0.35]])
    assert room.cast(5.0, 5.0, np.array([0.0, math.pi]), others) == pytest.approx([1.65, 5.0])


@pytest.mark.parametrize("cells", [100, 37])
def test_the_map_shows_walls_and_obstacles(world: World, cells: int) -> None:
    grid = world.occupancy(cells)
    origin, resolution = world.map_origin_resolution(cells)
    assert grid.shape == (cells, cells)
    assert set(np.unique(grid)) == {0, 100}
    for row, column in np.random.default_rng(1).integers(0, cells, (500, 2)):
        centre = np.array([origin + (column + 0.5) * resolution, origin + (row + 0.5) * resolution])
        clearance = float(world.clearance(centre))
        assert (grid[row, column] == 100) == (clearance < resolution / 2)
    for x, y in np.concatenate([world.circles[:, :2], world.boxes[:, :2]]):
        assert grid[int((y - origin) / resolution), int((x - origin) / resolution)] == 100
    assert (grid[0] == 100).all()
    assert (grid[:, -1] == 100).all()


def test_obstacles_out_of_reach_change_no_distance_within_it(world: World) -> None:
    rng = np.random.default_rng(3)
    for middle in rng.uniform(1, world.size - 1, (50, 2)):
        points = middle + rng.uniform(-1, 1, (7, 3, 2))
        exact, near = world.clearance(points), world.clearance(points, 0.5)
        assert np.array_equal(np.minimum(exact, 0.5), np.minimum(near, 0.5))
