"""Few combinations of parameters have all pairs of values."""

from __future__ import annotations

from itertools import combinations, product

from hypothesis import given
from hypothesis import strategies as st

from tests.pairs import chosen


@given(st.lists(st.integers(1, 4), min_size=2, max_size=4))
def test_every_two_values_of_two_parameters_meet(sizes: list[int]) -> None:
    rows = list(chosen([range(size) for size in sizes]))
    for one, two in combinations(range(len(sizes)), 2):
        met = {(row[one], row[two]) for row in rows}
        assert met == set(product(range(sizes[one]), range(sizes[two])))


def test_they_are_few() -> None:
    assert len(list(chosen([range(2), range(2), range(3), range(4)]))) == 12
    assert len(list(chosen([range(2)] * 4))) <= 6
