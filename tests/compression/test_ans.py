"""The integer coder gives back what it took."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.compression.ans import (
    SCALE,
    Table,
    from_bytes,
    pop_natural,
    pop_rank,
    push_natural,
    push_rank,
    to_bytes,
)

weights = st.lists(st.integers(0, 1000), min_size=1, max_size=300).filter(any)


@given(weights, st.data(), st.integers(0, 1 << 400))
def test_symbols_come_back_in_reverse(shares: list[int], data: st.DataObject, start: int) -> None:
    table = Table(shares)
    possible = [symbol for symbol, share in enumerate(shares) if share]
    symbols = data.draw(st.lists(st.sampled_from(possible), max_size=50))
    x = start
    for symbol in symbols:
        x = table.push(x, symbol)
    for symbol in reversed(symbols):
        x, popped = table.pop(x)
        assert popped == symbol
    assert x == start


@given(weights)
def test_a_table_uses_all_its_slots(shares: list[int]) -> None:
    table = Table(shares)
    assert len(table.slots) == SCALE == sum(share for _, share in table.codes)
    assert all((share > 0) == (weight > 0) for (_, share), weight in zip(table.codes, shares, strict=True))


@given(st.integers(0, (1 << 64) - 1), st.integers(0, 65534), st.integers(0, 1 << 100))
def test_numbers_come_back(value: int, rank: int, start: int) -> None:
    assert pop_natural(push_natural(start, value)) == (start, value)
    assert pop_rank(push_rank(start, rank)) == (start, rank)
    assert from_bytes(to_bytes(start)) == start


def test_a_likely_symbol_costs_little() -> None:
    x, table = 1 << 100, Table([99, 1])
    for _ in range(100):
        x = table.push(x, 0)
    assert x.bit_length() in (102, 103)  # 100 times 0.0145 bits
