"""The block for medium access: the bytes, what has a code, and reading back."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import EncodeError, EntryBoundsError
from gr_ros2.wire.mac_block import (
    LONGEST_AHEAD,
    MAP_SLOTS,
    MOST_LEN,
    MOST_WEIGHT,
    Block,
    announceable,
    read_block,
    write_block,
)

VECTORS = {
    "000000000000": Block(0, (0, 0), 0, (0, 0)),
    "ff1617130204": Block(255, (22, 23), 19, (2, 4)),
    "10807f40ffff": Block(16, (131, 127), 66, (255, 255)),
    "20ff01ff0001": Block(32, (639, 1), 255, (0, 1), 0),
    "050707820304b800000112fe": Block(5, (7, 7), 2, (3, 4), 0x8000001, (18, 254), 12),
}
aheads = st.integers(0, LONGEST_AHEAD).map(announceable)
bytes_ = st.integers(0, 255)
robots = st.one_of(st.integers(0, 63), st.integers(0, 64).map(lambda n: 63 + 3 * n))
blocks = st.builds(
    Block,
    bytes_,
    st.tuples(aheads, aheads),
    robots,
    st.tuples(bytes_, bytes_),
    st.none(),
    st.just((0, 255)),
    st.just(1),
) | st.builds(
    Block,
    bytes_,
    st.tuples(aheads, aheads),
    robots,
    st.tuples(bytes_, bytes_),
    st.integers(0, 2**MAP_SLOTS - 1),
    st.tuples(bytes_, bytes_),
    st.integers(1, MOST_WEIGHT),
)


@pytest.mark.parametrize("text", VECTORS)
def test_the_bytes(text: str) -> None:
    block = VECTORS[text]
    data = bytes.fromhex(text)
    if block.expected == 0:
        data += bytes((0, 0, 0, 0, 0, 255))
    assert write_block(block) == data
    assert read_block(b"xx" + data + b"yy", 2) == (block, 2 + len(data))


@given(blocks)
def test_what_is_written_reads_back(block: Block) -> None:
    data = write_block(block)
    assert len(data) in (6, MOST_LEN)
    assert read_block(data) == (block, len(data))


@given(st.binary(max_size=14))
def test_every_block_that_reads_has_one_encoding(data: bytes) -> None:
    try:
        block, end = read_block(data)
    except EntryBoundsError:
        assert len(data) < MOST_LEN
        return
    assert write_block(block) == data[:end]


@given(st.integers(0, LONGEST_AHEAD))
def test_what_is_announced_is_no_sooner_and_next_to_it(ahead: int) -> None:
    assert 0 <= announceable(ahead) - ahead < 4


def test_a_number_of_robots_without_a_code_is_rounded_up() -> None:
    assert read_block(write_block(Block(0, heard=64)))[0].heard == 66
    assert read_block(write_block(Block(0, heard=254)))[0].heard == 255


@pytest.mark.parametrize(
    "block",
    [
        Block(256),
        Block(0, (128, 0)),
        Block(0, (643, 0)),
        Block(0, names=(256, 0)),
        Block(0, expected=1 << 28),
        Block(0, expected=0, weight=17),
        Block(0, expected=0, weight=0),
    ],
)
def test_a_field_out_of_range_is_refused(block: Block) -> None:
    with pytest.raises(EncodeError):
        write_block(block)
