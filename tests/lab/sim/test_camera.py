"""What a simulated camera sees."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gr_ros2.codecs.messages import IMAGE, read
from gr_ros2_lab.sim.camera import HEIGHT, WIDTH, picture
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.motion import State
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.sim.world import World


def _world() -> World:
    return World(20.0, 0, np.random.default_rng(1))


def view(state: State, *others: State, seed: int = 1) -> Any:
    return picture(_world(), state, others, np.random.default_rng(seed)).astype(int)


def test_a_picture_is_the_same_for_the_same_place_but_for_noise() -> None:
    here = State(5.0, 5.0, 0.3, 0.0, 0.0)
    assert view(here).shape == (HEIGHT, WIDTH, 3)
    assert np.array_equal(view(here), view(here))
    other = np.abs(view(here) - view(here, seed=2))
    assert 0 < other.mean() < 5
    assert other.max() <= 8


def test_a_near_wall_fills_the_view_and_a_far_one_shows_floor_and_ceiling() -> None:
    near, far = view(State(19.5, 10.0, 0.0, 0.0, 0.0)), view(State(1.0, 10.0, 0.0, 0.0, 0.0))
    column = WIDTH // 2
    # The wall is reddish, the floor and the ceiling bluish.
    assert (near[: HEIGHT * 3 // 4, column, 0] > near[: HEIGHT * 3 // 4, column, 2]).all()
    assert (far[-20:, column, 2] >= far[-20:, column, 0]).all()
    assert (far[:20, column, 2] >= far[:20, column, 0]).all()


def test_another_robot_is_seen_where_it_is() -> None:
    here = State(5.0, 10.0, 0.0, 0.0, 0.0)
    changed = np.abs(view(here) - view(here, State(9.0, 11.0, 0.0, 0.0, 0.0))).sum(2) > 20
    rows, columns = np.nonzero(changed)
    assert len(rows)
    assert columns.max() < WIDTH / 2, "it stands to the left"
    assert rows.min() > HEIGHT / 3, "it is lower than the walls"


@pytest.mark.parametrize("rate", [0.0, 5.0])
def test_a_fleet_with_a_camera_publishes_pictures_and_changes_nothing_else(rate: float) -> None:
    plain = list(Fleet(SimSettings(seed=3)).messages(1.0))
    found = list(Fleet(SimSettings(seed=3, camera_rate=rate)).messages(1.0))
    pictures = [message for message in found if message.topic.endswith("/camera")]
    assert len(pictures) == 2 * rate
    assert [message for message in found if message not in pictures] == plain
    for message in pictures:
        image = read(IMAGE, message.payload)
        assert (image.width, image.height, image.encoding, len(image.data)) == (320, 240, "rgb8", 320 * 240 * 3)
