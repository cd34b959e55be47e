"""Floating point numbers come back bit for bit."""

from __future__ import annotations

import math
import struct

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.compression.floats import (
    CLASSES,
    KnownNumbers,
    bits_of,
    class_table,
    pop_double,
    pop_quaternion,
    pop_single,
    push_double,
    push_quaternion,
    push_single,
)

CONSTANTS = KnownNumbers([bits_of(value) for value in (1.0, -0.0, 0.001, math.nan)])
letters = st.sampled_from(sorted(CLASSES))
doubles = st.integers(0, (1 << 64) - 1) | st.floats().map(bits_of)
short = st.builds(lambda n, k: bits_of(n / 10**k), st.integers(-(10**9), 10**9), st.integers(0, 7))
square = st.builds(lambda n: bits_of((n / 1000) * (n / 1000)), st.integers(0, 10**5))
widened = st.floats(width=32).map(bits_of)
starts = st.integers(0, 1 << 200)


def real(bits: int) -> float:
    value: float = struct.unpack("<d", struct.pack("<Q", bits))[0]
    return value


@given(doubles | short | square | widened, letters, starts)
def test_doubles(bits: int, letter: str, start: int) -> None:
    table = class_table(letter)
    x = push_double(start, bits, real(bits), table, CONSTANTS)
    assert pop_double(x, table, CONSTANTS) == (start, bits)


@given(st.integers(0, (1 << 32) - 1), letters, starts)
def test_any_single(bits: int, letter: str, start: int) -> None:
    value = struct.unpack("<f", struct.pack("<I", bits))[0]
    assert pop_single(push_single(start, bits, value, class_table(letter)), class_table(letter)) == (start, bits)


@given(st.floats(-1e6, 1e6), st.integers(0, 6), letters)
def test_short_singles(value: float, decimals: int, letter: str) -> None:
    packed = struct.pack("<f", round(value, decimals))
    bits, value = struct.unpack("<I", packed)[0], struct.unpack("<f", packed)[0]
    assert pop_single(push_single(7, bits, value, class_table(letter)), class_table(letter)) == (7, bits)


@given(st.lists(doubles | short, min_size=4, max_size=4), letters, starts)
def test_any_four_numbers_as_a_quaternion(bits: list[int], letter: str, start: int) -> None:
    table = class_table(letter)
    x = push_quaternion(start, bits, [real(b) for b in bits], table, CONSTANTS)
    assert pop_quaternion(x, table, CONSTANTS) == (start, bits)


@given(
    st.lists(st.floats(-1, 1) | st.sampled_from([0.0, -0.0]), min_size=4, max_size=4).filter(
        lambda q: math.sqrt(sum(v * v for v in q)) > 1e-3
    ),
    letters,
    starts,
)
def test_unit_quaternions(four: list[float], letter: str, start: int) -> None:
    length = math.sqrt(sum(v * v for v in four))
    values = [v / length for v in four]
    bits = [bits_of(v) for v in values]
    table = class_table(letter)
    x = push_quaternion(start, bits, values, table, CONSTANTS)
    assert pop_quaternion(x, table, CONSTANTS) == (start, bits)


def test_a_turn_about_the_vertical_costs_one_number() -> None:
    values = [0.0, 0.0, math.sin(0.4321), math.cos(0.4321)]
    x = push_quaternion(1, [bits_of(v) for v in values], values, class_table("u"), CONSTANTS)
    assert x.bit_length() < 64
