"""What is counted of incomplete messages is what they take."""

from __future__ import annotations

import tracemalloc

import pytest

from gr_ros2.paper.partials import Partial, Partials
from gr_ros2.wire.v0 import EntryV0


@pytest.mark.parametrize("fragments", [1, 9, 100])
def test_no_less_is_counted_than_is_used(fragments: int) -> None:
    partials = Partials()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for number in range(600):
            partial = Partial(1, number % 200, number + 300, number + 1000, 1000, 0)
            for index in range(300, 300 + fragments):
                partials.add(partial, EntryV0(number % 200, number + 300, index, 1000, bytes(bytearray(3))), number / 7)
        used = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert 0.6 * partials.size < used <= partials.size
