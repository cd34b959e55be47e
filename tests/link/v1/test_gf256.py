"""GF(256): the field, and that any square part of the coefficients' matrix has an inverse."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link.v1.gf256 import CAUCHY, INVERSE, TIMES, coefficient, combine

BYTE = st.integers(0, 255)


def product(a: int, b: int) -> int:
    """Multiplication as on paper: shift, and reduce by the polynomial."""
    total = 0
    while b:
        if b & 1:
            total ^= a
        a = a << 1 ^ (0x11D if a & 128 else 0)
        b >>= 1
    return total


def test_the_tables_are_the_field() -> None:
    for a in range(256):
        assert TIMES[a] == bytes(product(a, b) for b in range(256))
    assert all(product(a, INVERSE[a]) == 1 for a in range(1, 256))


@given(st.integers(0, 255), st.integers(0, 1 << 40))
def test_coefficients_are_as_the_page_has_them(repair_id: int, number: int) -> None:
    factor = coefficient(repair_id, number)
    assert product(factor, (128 + repair_id % 128) ^ (number % 128)) == 1
    assert CAUCHY[(128 | repair_id % 128) ^ number % 128] == TIMES[factor]


@given(st.integers(1, 24), st.randoms(use_true_random=False))
def test_square_parts_are_invertible(size: int, rng: random.Random) -> None:
    repair_ids = rng.sample(range(128), size)
    columns = rng.sample(range(128), size)
    matrix = [[coefficient(row, column) for column in columns] for row in repair_ids]
    for index in range(size):
        pivot = next((row for row in range(index, size) if matrix[row][index]), -1)
        assert pivot >= index, "the matrix is singular"
        matrix[index], matrix[pivot] = matrix[pivot], matrix[index]
        inverse = INVERSE[matrix[index][index]]
        matrix[index] = [product(inverse, value) for value in matrix[index]]
        for row in range(index + 1, size):
            factor = matrix[row][index]
            matrix[row] = [a ^ product(factor, b) for a, b in zip(matrix[row], matrix[index], strict=True)]


@given(st.lists(st.tuples(st.integers(0, 1 << 30), st.binary(max_size=20)), max_size=6), st.integers(0, 127))
def test_a_combination_is_the_sum_of_the_products(bodies: list[tuple[int, bytes]], repair_id: int) -> None:
    longest = max((len(body) for _, body in bodies), default=0)
    expected = bytearray(longest)
    for number, body in bodies:
        for at, byte in enumerate(body):
            expected[at] ^= product(coefficient(repair_id, number), byte)
    assert combine(bodies, repair_id) == bytes(expected)
