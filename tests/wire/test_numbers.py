"""Numbers of any width, unwrapped."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.wire import unwrap


@given(st.integers(1, 32), st.integers(-(2**40), 2**40), st.data())
def test_what_lies_in_the_window_comes_back(bits: int, least: int, data: st.DataObject) -> None:
    number = data.draw(st.integers(least, least + 2**bits - 1))
    assert unwrap(number % 2**bits, least, bits) == number


def test_both_edges_of_the_window() -> None:
    assert [unwrap(low, 1000 - 63, 8) for low in (937 % 256, 936 % 256)] == [937, 936 + 256]
    assert unwrap(0xFFFF, 0x1_0000 - 64, 16) == 0xFFFF
    assert unwrap(0, 0, 16) == 0
