"""Pictures of cameras and maps on the page: what is drawn, and how old it says it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from bokeh.document import Document

from gr_ros2.codecs.messages import GRID, IMAGE
from gr_ros2.dashboard.live_page import LivePage
from gr_ros2.dashboard.monitor import RadioView, RunMonitor
from gr_ros2.dashboard.pictures import FROZEN_S, MOST, newest_picture
from gr_ros2.dashboard.state import DashboardState
from gr_ros2.dashboard.views import PictureView, Snapshot
from gr_ros2.link.events import Accepted, Announced, Delivered
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.table import AnnouncedTopic
from tests.codecs import scenes

RED = np.zeros((240, 320, 3), np.uint8) + np.array([200, 0, 0], np.uint8)


def image(pixels: Any = RED, encoding: str = "rgb8") -> bytes:
    return scenes.image(pixels, encoding, 1)


def shown(type_name: str, message: bytes, age_s: float = 0.1) -> PictureView:
    picture = newest_picture(type_name)
    assert picture is not None
    picture.take(message, 10.0)
    view = picture.view("camera", 10.0 + age_s)
    assert view is not None
    return view


@pytest.mark.parametrize(("encoding", "channel"), [("rgb8", 0), ("bgr8", 2)])
def test_a_picture_has_its_colours_and_says_its_age(encoding: str, channel: int) -> None:
    view = shown(IMAGE, image(encoding=encoding))
    assert view.pixels.shape == (240, 320)
    rgba = view.pixels[0, 0].tobytes()
    assert rgba[channel] == 200
    assert rgba[3] == 255
    assert (view.words, view.frozen) == ("camera: 0.1 s old", False)


def test_a_frozen_picture_is_grey_and_says_so() -> None:
    view = shown(IMAGE, image(), FROZEN_S + 1)
    red, green, blue, _ = view.pixels[0, 0].tobytes()
    assert red == green == blue
    assert view.words == f"camera: frozen, {FROZEN_S + 1:.1f} s old"


def test_a_map_is_where_it_is_with_walls_free_and_unknown_apart_and_never_frozen() -> None:
    cells = np.full((600, 600), -1, np.int8)
    cells[:300], cells[0] = 0, 100
    view = shown(GRID, scenes.grid(cells), 100.0)
    assert max(view.pixels.shape) <= MOST
    wall, free, unknown = view.pixels[0, 5], view.pixels[5, 5], view.pixels[-1, 5]
    assert len({wall, free, unknown}) == 3
    assert view.place[2] == pytest.approx(600 * 0.05)
    assert not view.frozen


@pytest.mark.parametrize("bad", [b"", image()[:-9], image(encoding="rgb8")[:60], scenes.image(RED, "yuv999", 1)])
def test_what_cannot_be_shown_leaves_what_was_there(bad: bytes) -> None:
    picture = newest_picture(IMAGE)
    assert picture is not None
    picture.take(bad, 10.0)
    assert picture.view("camera", 11.0) is None
    picture.take(image(), 11.0)
    assert picture.view("camera", 11.5) is not None
    picture.take(bad, 12.0)
    view = picture.view("camera", 12.0)
    assert view is not None
    assert view.age_s == 1.0


def test_the_state_shows_the_picture_that_came_out_with_the_age_of_what_was_sent() -> None:
    state = DashboardState(Registry.empty(), {}, 64)
    state.receiver_event(Announced(2, (AnnouncedTopic(0, "camera", IMAGE),)), 0.0)
    state.sender_event(2, Accepted(0, 0, b"frame", 1.0))
    state.receiver_event(Delivered(2, 0, b"frame", 0, shown=image(), age_s=0.25), 2.0)
    (view,) = state.tick(2.5).pictures
    assert view.pixels.shape == (240, 320)
    assert 0.5 <= view.age_s <= 1.5


def test_the_page_draws_pictures_beside_each_other_and_the_map_below_the_paths() -> None:
    page = LivePage(Document(), RunMonitor(), "test")
    cameras = (shown(IMAGE, image()), shown(IMAGE, image(255 - RED)))
    for snapshot in (
        Snapshot(pictures=(*cameras, shown(GRID, scenes.exploring(1)[0]))),
        Snapshot(pictures=cameras[1:]),
    ):
        page.draw(snapshot, RadioView())
        pictures = page._sources["picture"].data
        assert len(pictures["image"]) == len([view for view in snapshot.pictures if not view.is_map])
        assert len(page._sources["grid"].data["image"]) == sum(view.is_map for view in snapshot.pictures)
        assert page._html["seen"].text.count("s old") == len(snapshot.pictures)
    page.draw(Snapshot(phase="running"), RadioView())
    assert "camera" in page._counter.empty.split()
