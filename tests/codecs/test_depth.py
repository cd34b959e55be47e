"""Depth: bounds on its errors, holes that stay holes, and every form in which drivers publish it."""

from __future__ import annotations

from struct import pack
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.codecs import CODECS, CodedTopic, video
from gr_ros2.codecs.base import KEY_TIMES
from gr_ros2.codecs.messages import COMPRESSED_IMAGE, IMAGE, read
from gr_ros2.codecs.sizes import LEAST_PER_BLOCK
from gr_ros2.core.errors import ConfigError
from tests.codecs.scenes import Array, compressed, header, image, room

WIDTH, HEIGHT = 160, 120


def through(message: bytes, type_name: str = IMAGE, budget: int | None = None, **options: Any) -> tuple[Any, str]:
    """The message that comes out, and what was said."""
    topic = CodedTopic(type_name, {"depth": options})
    coded = topic.encoder().encode(message, budget)
    assert coded.data[0] == CODECS["depth"].number
    return read(type_name, topic.decoder().decode(coded.data)), coded.said


def distances(said: str) -> tuple[float, float]:
    """The nearest and the farthest that a frame says, m."""
    words = said.split()
    return float(words[words.index("from") + 1]), float(words[words.index("to") + 1])


def bound(metres: Array, said: str, bits: int, unit: float) -> Array:
    """The greatest error of each distance, m: half a step of its inverse, and half a unit."""
    near, far = (
        float(said.split(" from ")[1].split(" ", maxsplit=1)[0]) - 0.01,
        float(said.split(" to ")[1].split(" ", maxsplit=1)[0]) + 0.01,
    )
    step = (1 / near - 1 / far) / ((1 << bits) - 1)
    inverse = np.maximum(1 / metres - step * 0.51, 1e-9)
    return 1 / inverse - metres + unit * 0.51 + 1e-4 * metres


@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "mono16"])
def test_the_error_is_below_half_a_step_and_holes_stay(bits: int, encoding: str) -> None:
    metres = room(0, WIDTH, HEIGHT)
    pixels = metres if encoding == "32FC1" else np.rint(metres * 1000).astype("<u2")
    out, said = through(image(pixels, encoding, 2, padding=4), mode=str(bits))
    shown = out.data.view(pixels.dtype).reshape(HEIGHT, WIDTH) * (1 if encoding == "32FC1" else 0.001)
    assert (out.header, out.encoding, out.width, out.height) == (header(2), encoding, WIDTH, HEIGHT)
    there = metres > 0
    assert np.array_equal(np.nan_to_num(shown) > 0, there)
    limit = bound(metres[there], said, bits, 0 if encoding == "32FC1" else 0.001)
    inner = (metres[there] > 1.01 * distances(said)[0]) & (metres[there] < 4)
    assert (np.abs(shown[there] - metres[there]) <= limit)[inner].all()
    assert f"in {bits} bits" in said


def test_video_of_depth_is_near_what_came_in_and_is_grey() -> None:
    topic = CodedTopic(IMAGE)
    encoder, decoder = topic.encoder(), topic.decoder()
    errors = []
    for number in range(6):
        metres = room(number, 320, 240)
        coded = encoder.encode(image(np.rint(metres * 1000).astype("<u2"), "16UC1", number), 1500)
        shown = read(IMAGE, decoder.decode(coded.data)).data.view("<u2").reshape(240, 320) / 1000
        both = (metres > 0) & (shown > 0)
        assert np.mean((metres > 0) != (shown > 0)) < 0.05
        errors.append(np.median(np.abs(shown - metres)[both]))
    assert max(errors) < 0.03


def holes(number: int, width: int, height: int) -> Array:
    """A room as a sensor sees it that has no depth beside edges and at many small places, mm."""
    metres = room(number, width, height)
    edges = np.abs(np.diff(metres, axis=1, prepend=metres[:, :1])) > 0.05
    metres[edges | np.roll(edges, -4, 1)] = 0
    rng = np.random.default_rng(number)
    for row, column in zip(rng.integers(0, height, 300), rng.integers(0, width, 300), strict=True):
        metres[row : row + 6, column : column + 8] = 0
    return np.rint(metres * 1000).astype("<u2")


@pytest.mark.parametrize("budget", [240, 800, 3800])
def test_depth_with_many_holes_is_within_its_budget_and_smaller_where_that_is_short(budget: int) -> None:
    topic = CodedTopic(IMAGE)
    encoder, decoder = topic.encoder(), topic.decoder()
    share = []
    for number in range(12):
        pixels = holes(number, 640, 480)
        coded = encoder.encode(image(pixels, "16UC1", number), budget)
        out = read(IMAGE, decoder.decode(coded.data))
        share.append(len(coded.data) / budget / (1 if coded.before else KEY_TIMES))
        assert decoder.size == (out.width, out.height)
        assert out.width * out.height / 256 * LEAST_PER_BLOCK <= budget or out.height == 120
        shown, step = out.data.view("<u2").reshape(out.height, out.width), 640 // out.width
        given = pixels[step // 2 :: step, step // 2 :: step].astype(int)
        both = (shown > 0) & (given > 0)
        assert both.mean() > 0.75
        assert np.median(np.abs(shown - given)[both]) < 100
    assert max(share) <= 1.1, share


@pytest.mark.parametrize("big", [False, True])
def test_both_byte_orders_are_read(big: bool) -> None:
    values = np.rint(room(0, WIDTH, HEIGHT) * 1000).astype(">u2" if big else "<u2")
    out, _ = through(image(values, "16UC1", big=big), mode="12")
    shown = out.data.view("<u2").reshape(HEIGHT, WIDTH)
    assert np.abs(shown.astype(int) - values).max() <= 6


@pytest.mark.parametrize("budget", [None, 500])
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -np.inf, -1.0])
def test_an_image_without_depth_comes_out_without(value: float, budget: int | None) -> None:
    out, _ = through(image(np.full((15, 17), value, np.float32), "32FC1"), budget=budget)
    assert np.isnan(out.data.view("<f4")).all()
    assert len(out.data) == 15 * 17 * 4


def test_something_that_comes_nearer_begins_a_new_chain() -> None:
    topic = CodedTopic(IMAGE)
    encoder = topic.encoder()
    far, near = np.full((48, 64), 3000, "<u2"), np.full((48, 64), 3000, "<u2")
    near[10:30, 10:30] = 400
    before = [encoder.encode(image(pixels, "16UC1"), 900).before for pixels in (far, far, near, near, far)]
    assert [name is None for name in before] == [True, False, True, False, False]


def test_compressed_depth_in_millimetres() -> None:
    values = np.rint(room(0, WIDTH, HEIGHT) * 1000).astype(">u2")
    rows = values.view(np.uint8).reshape(HEIGHT, -1)
    data = pack("<iff", 0, 0.0, 0.0) + video.packed("png", video.from_rows(rows, WIDTH, "gray16be"))
    out, _ = through(compressed(data, "16UC1; compressedDepth png", 3), COMPRESSED_IMAGE, mode="12")
    assert (out.header, out.format) == (header(3), "16UC1; compressedDepth png")
    shown = video.to_rows(video.still("png", bytes(out.data)[12:]), 2 * WIDTH).copy().view(">u2")
    assert np.array_equal(shown > 0, values > 0)
    assert np.abs(shown.astype(int) - values).max() <= 6


def test_compressed_depth_in_metres_keeps_its_own_steps() -> None:
    metres = room(0, WIDTH, HEIGHT)
    a, b = 100.0 * (100.0 + 1), 1.0 - 100.0 * (100.0 + 1) / 10.0
    with np.errstate(divide="ignore"):
        values = np.where(metres > 0, np.clip(np.rint(a / metres + b), 1, 65535), 0).astype(">u2")
    data = pack("<iff", 0, a, b) + video.packed(
        "png", video.from_rows(values.view(np.uint8).reshape(HEIGHT, -1), WIDTH, "gray16be")
    )
    out, _ = through(compressed(data, "32FC1; compressedDepth"), COMPRESSED_IMAGE, mode="12")
    assert bytes(out.data)[:12] == data[:12]
    numbers = video.to_rows(video.still("png", bytes(out.data)[12:]), 2 * WIDTH).copy().view(">u2").astype(float)
    there = values > 0
    shown = a / (numbers[there] - b)
    assert np.abs(shown - metres[there]).max() < 0.02


def test_exact_is_exact() -> None:
    message = image(room(0, 32, 24), "32FC1")
    topic = CodedTopic(IMAGE, {"depth": {"mode": "exact"}})
    coded = topic.encoder().encode(message, 100)
    assert topic.decoder().decode(coded.data) == message


@pytest.mark.parametrize(
    ("options", "text"),
    [({"mode": "9"}, "mode is '9'"), ({"near": -1}, "near is -1"), ({"near": 3, "far": 2}, "near is 3 and far 2")],
)
def test_a_wrong_option_is_named(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        CodedTopic(IMAGE, {"depth": options})


@pytest.mark.parametrize("metres", [1.15e30, 1.1500001306413817e30, 3e38])
def test_what_no_sensor_measures_comes_out_as_a_distance(metres: float) -> None:
    for budget in (None, 300):
        out, _ = through(image(np.full((4, 4), metres, np.float32), "32FC1"), budget=budget)
        assert np.isfinite(out.data.view("<f4")).all()


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.data())
def test_any_numbers_come_out_in_their_size(width: int, height: int, data: st.DataObject) -> None:
    values = data.draw(st.lists(st.floats(width=32), min_size=width * height, max_size=width * height))
    budget = data.draw(st.sampled_from([None, 300]))
    metres = np.array(values, np.float32).reshape(height, width)
    out, _ = through(image(metres, "32FC1"), budget=budget)
    shown = out.data.view("<f4").reshape(height, width)
    if budget is None:
        assert np.array_equal(shown > 0, (metres > 0) & np.isfinite(metres))
    assert (shown[shown > 0] < np.inf).all()
