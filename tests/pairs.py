"""Values of several parameters of a test, so few that every two values of two parameters meet once.

A fault that takes three particular values at once is rare (D. R. Kuhn et al., "Software fault interactions and
implications for software testing", IEEE Transactions on Software Engineering 30, 2004), and all combinations of four
parameters are a minute where these are ten seconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product
from typing import Any

import pytest


def pairs(*fixtures: str, **values: Sequence[Any]) -> pytest.MarkDecorator:
    """Mark a test with combinations of two or more parameters, in which every two values of two of them meet.

    :param fixtures: parameters that are those of fixtures with these names
    """
    return pytest.mark.parametrize(tuple(values), list(chosen(list(values.values()))), indirect=fixtures)


def chosen(values: Sequence[Sequence[Any]]) -> Iterator[tuple[Any, ...]]:
    """Rows of one value each: always one in which the most pairs meet that have not met."""
    places = range(len(values))
    rows = list(product(*(range(len(each)) for each in values)))
    left = {(one, row[one], two, row[two]) for row in rows for one, two in combinations(places, 2)}
    while left:
        row = max(rows, key=lambda row: sum((a, row[a], b, row[b]) in left for a, b in combinations(places, 2)))
        left -= {(one, row[one], two, row[two]) for one, two in combinations(places, 2)}
        yield tuple(each[place] for each, place in zip(values, row, strict=True))
