"""Maps that grow: exact whatever was confirmed, and as small as what has changed."""

from __future__ import annotations

import tracemalloc
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.changes import KEPT
from gr_ros2.codecs.grid import updated
from gr_ros2.codecs.messages import GRID, GRID_UPDATE, read
from gr_ros2.core.errors import DamagedError, MissingFrameError
from tests.codecs.scenes import exploring, grid, header, write

SIZE = 1000


def test_a_small_change_of_a_large_map_costs_what_the_change_costs() -> None:
    rng = np.random.default_rng(1)
    cells = rng.choice(np.array([-1, 0, 100], np.int8), (SIZE, SIZE))
    topic = CodedTopic(GRID)
    encoder, decoder = topic.encoder(), topic.decoder()
    first = encoder.encode(grid(cells))
    decoder.decode(first.data)
    encoder.confirmed(first.name)
    cells[100:120, 300:330] = rng.choice(np.array([0, 100], np.int8), (20, 30))
    message = grid(cells, 1)
    changed = encoder.encode(message)
    assert decoder.decode(changed.data) == message
    assert len(changed.data) < 20 * 30 / 3 < len(first.data) / 1000
    same = encoder.encode(grid(cells, 2))
    assert len(same.data) < 20 * 30 / 3


def test_a_map_that_has_grown_on_all_sides_is_compared_where_it_was() -> None:
    rng = np.random.default_rng(1)
    cells = rng.choice(np.array([-1, 0, 100], np.int8), (200, 300))
    grown = np.full((260, 330), -1, np.int8)
    grown[40:240, 10:310] = cells
    topic = CodedTopic(GRID)
    encoder, decoder = topic.encoder(), topic.decoder()
    first = encoder.encode(grid(cells))
    decoder.decode(first.data)
    encoder.confirmed(first.name)
    message = grid(grown, 1, origin=(-10 - 10 * 0.05, -10 - 40 * 0.05))
    coded = encoder.encode(message)
    assert decoder.decode(coded.data) == message
    assert len(coded.data) < 150


def test_nothing_is_referred_to_that_was_not_confirmed() -> None:
    topic = CodedTopic(GRID)
    encoder = topic.encoder()
    maps = exploring(4, 200)
    frames = [encoder.encode(message) for message in maps[:2]]
    assert [frame.before for frame in frames] == [None, None]
    encoder.confirmed(frames[0].name)
    encoder.confirmed(12345)
    changed = encoder.encode(maps[2])
    assert changed.before == frames[0].name
    assert encoder.encode(maps[3], key=True).before is None
    with pytest.raises(MissingFrameError):
        topic.decoder().decode(changed.data)


def test_what_both_ends_keep_is_the_newest_whatever_was_referred_to() -> None:
    topic = CodedTopic(GRID)
    encoder, decoder = topic.encoder(), topic.decoder()
    maps, names = exploring(KEPT + 2, 200), []
    for message in maps[:-1]:
        coded = encoder.encode(message)
        assert decoder.decode(coded.data) == message
        if not names:
            encoder.confirmed(coded.name)
        names.append(coded.name)
    encoder.confirmed(names[1])  # late: the oldest that both ends keep
    coded = encoder.encode(maps[-1])
    assert coded.before == names[1]
    assert decoder.decode(coded.data) == maps[-1]


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.data())
def test_any_history_is_exact(data: st.DataObject) -> None:
    """Grids of any size and place; each frame arrives or not, and is confirmed sooner, later or never."""
    topic = CodedTopic(GRID)
    encoder, decoder = topic.encoder(), topic.decoder()
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    arrived: list[int] = []
    for number in range(12):
        high, wide = data.draw(st.integers(0, 12)), data.draw(st.integers(0, 12))
        origin = data.draw(st.tuples(*[st.floats(-3, 3) | st.just(float("nan"))] * 2))
        message = grid(rng.integers(-1, 3, (high, wide)), number, origin, data.draw(st.sampled_from([0.05, 0.0, 1.0])))
        coded = encoder.encode(message, key=data.draw(st.booleans()) and number % 4 == 3)
        if data.draw(st.booleans()):
            assert decoder.decode(coded.data) == message
            arrived = [*arrived, coded.name][-KEPT:]
        if arrived and data.draw(st.booleans()):
            encoder.confirmed(data.draw(st.sampled_from(arrived)))


def box(x: int, y: int, height: int, width: int, cells: int | None = None) -> bytes:
    data = np.full(height * width if cells is None else cells, 42, np.int8)
    return write(GRID_UPDATE, header=header(77, "map"), x=x, y=y, width=width, height=height, data=data)


@pytest.mark.parametrize("origin", [(0.0, 0.0), (float("nan"), 0.0)])
def test_a_box_that_has_changed_becomes_part_of_a_map_and_nothing_else_changes(origin: tuple[float, float]) -> None:
    cells = np.arange(12 * 9, dtype=np.int8).reshape(9, 12) % 100
    for x, y, high, wide in ((0, 0, 9, 12), (3, 2, 4, 5), (11, 8, 1, 1), (5, 5, 0, 3)):
        made = read(GRID, updated(grid(cells, 3, origin), box(x, y, high, wide)))
        wanted = cells.copy()
        wanted[y : y + high, x : x + wide] = 42
        assert (made.data.reshape(9, 12) == wanted).all()
        assert made.header == header(77, "map")
        assert repr(made.info) == repr(read(GRID, grid(cells, 3, origin)).info)


@pytest.mark.parametrize(
    "bad", [(9, 0, 4, 5), (-1, 0, 1, 1), (0, 7, 3, 1), (0, 0, 2, 3, 5), (0, 0, 0, 13), (2**31 - 1, 0, 1, 1)]
)
def test_a_box_that_does_not_fit_its_map_is_damaged(bad: tuple[int, ...]) -> None:
    with pytest.raises(DamagedError):
        updated(grid(np.zeros((9, 12), np.int8)), box(*bad))


def test_bytes_that_are_no_box_are_damaged() -> None:
    whole = box(1, 1, 2, 3)
    for cut in range(len(whole)):
        with suppress(DamagedError):
            assert len(updated(grid(np.zeros((9, 12), np.int8)), whole[:cut])) > 100
    with pytest.raises(DamagedError):
        updated(whole, whole)


@pytest.mark.parametrize("shape", [(0, (1 << 32) - 1), ((1 << 32) - 1, 0)])
def test_a_map_without_cells_costs_nothing_whatever_its_other_side_says(shape: tuple[int, int]) -> None:
    topic = CodedTopic(GRID)
    encoder, decoder = topic.encoder(), topic.decoder()
    tracemalloc.start()
    for cells in (np.zeros((5, 5), np.int8), *[np.zeros(shape, np.int8)] * 2, np.ones((5, 5), np.int8)):
        message = grid(cells)
        coded = encoder.encode(message)
        encoder.confirmed(coded.name)
        assert decoder.decode(coded.data) == message
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()
