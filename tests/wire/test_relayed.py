"""A relayed message reads back as it was written, and bytes raise nothing but named errors."""

from __future__ import annotations

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import EncodeError, WireError
from gr_ros2.wire.ages import AGE_STEP_S, NO_AGE, age_code, age_of, limit_code
from gr_ros2.wire.relayed import (
    MOST_HOPS,
    Relayed,
    read_carried,
    read_relayed,
    write_carried,
    write_relayed,
)

U8 = st.integers(0, 255)
ID = st.integers(0, 254)
MESSAGES = st.builds(
    Relayed,
    ID,
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFFFF_FFFF),
    U8,
    st.integers(0, 240),
    st.integers(0, MOST_HOPS),
    st.binary(max_size=40),
    st.booleans(),
    U8,
    U8,
    st.just(NO_AGE),
    st.just(0),
    st.none(),
)
IN_A_ROW = st.builds(
    lambda message, back, place: message._replace(after=(message.number - back, place)),
    MESSAGES,
    st.sampled_from([0, 1, 127, 128, (1 << 28) - 1]),
    U8,
).filter(lambda message: message.after[0] >= 0 and message.after < (message.number, message.place))


@given(MESSAGES | IN_A_ROW)
def test_round_trip(message: Relayed) -> None:
    assert read_relayed(write_relayed(message)) == message


@given(st.binary(max_size=20) | st.builds(lambda data: bytes(5) + data, st.binary(min_size=5, max_size=15)))
def test_any_bytes(data: bytes) -> None:
    try:
        message = read_relayed(data)
    except WireError:
        return
    assert write_relayed(message) == data


@given(ID, MESSAGES.filter(lambda message: message.dst_id != 255), U8, st.integers(0, 127))
def test_round_trip_of_carried_messages(taker: int, message: Relayed, limit: int, waits: int) -> None:
    message = message._replace(limit=limit, waits=waits)
    assert read_carried(write_carried(taker, message)) == (taker, message)


@given(st.binary(max_size=20))
def test_any_bytes_for_a_carried_message(data: bytes) -> None:
    try:
        taker, message = read_carried(data)
    except WireError:
        return
    assert write_carried(taker, message) == data


@given(st.floats(0, 1e6))
def test_an_age_never_gets_less_and_a_limit_never_more(age: float) -> None:
    up, down = age_of(age_code(age)), age_of(limit_code(age))
    assert age <= up + 1e-12 * age and (up <= max(age * (1 + 1 / 16), age + AGE_STEP_S) or age_code(age) == NO_AGE)
    assert min(age, 4915.2) * (1 - 1 / 16) - AGE_STEP_S <= down <= age * (1 + 1e-12)
    assert age_of(age_code(inf)) == age_of(limit_code(inf)) == inf


@pytest.mark.parametrize(("taker", "dst_id"), [(255, 9), (-1, 9), (3, 255)])
def test_a_carried_message_names_two_robots(taker: int, dst_id: int) -> None:
    with pytest.raises(EncodeError):
        write_carried(taker, Relayed(7, 0xCAFE, 70_000, 1, 3, 2, b"goal", dst_id=dst_id))


@pytest.mark.parametrize(
    "change",
    [{"origin": 255}, {"topic_id": 241}, {"hops": 32}, {"start": 1 << 16}, {"number": -1}, {"place": 256}]
    + [{"after": after} for after in ((70_000, 1), (-1, 0), (69_999, 256))],
)
def test_fields_out_of_range(change: dict[str, int]) -> None:
    message = Relayed(7, 0xCAFE, 70_000, 1, 3, 2, b"odom")
    with pytest.raises(EncodeError):
        write_relayed(message._replace(**change))


def test_it_says_whose_message_it_is() -> None:
    said = Relayed(7, 0xCAFE, 70_000, 1, 3, 2, b"", dst_id=9, age=age_code(0.05)).describe()
    assert said == "robot 7's (boot ends in cafe) topic 3 to robot 9, from its packet 70000.1, hop 2, 0.05 s old"
