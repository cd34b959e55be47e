"""The bytes with which a robot asks another one for topics."""

from __future__ import annotations

from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.calls.wish_frames import (
    MOST_OFFERS,
    GiveUp,
    LinkRequest,
    ListRequest,
    OfferRow,
    WishAnswer,
    WishOutcome,
    WishRequest,
    read_answer,
    read_offers,
    read_request,
    write_answer,
    write_offers,
    write_request,
)
from gr_ros2.core.errors import EncodeError, WireError

names = st.from_regex(r"[a-z_/é]{1,60}", fullmatch=True)
figures = st.floats(0, 1e6, width=32)
requests = st.one_of(
    st.just(ListRequest()), st.builds(GiveUp, names), st.builds(WishRequest, names, figures, st.integers(1, 65535))
)
answers = st.builds(WishAnswer, st.sampled_from(WishOutcome), figures, figures, figures | st.just(inf))
rows = st.builds(OfferRow, names, names, figures, figures, st.booleans(), st.booleans())


@given(requests)
def test_a_request_is_read_as_it_was_written(request_: LinkRequest) -> None:
    assert read_request(write_request(request_)) == request_


@given(answers)
def test_an_answer_is_read_as_it_was_written(answer: WishAnswer) -> None:
    assert read_answer(write_answer(answer)) == answer


@given(st.lists(rows, max_size=5))
def test_offers_are_read_as_they_were_written(offers: list[OfferRow]) -> None:
    assert read_offers(write_offers(offers)) == offers


@given(st.binary(max_size=40) | st.builds(lambda kind, rest: bytes([kind]) + rest, st.integers(0, 3), st.binary()))
def test_whatever_is_read_is_refused_by_name_or_written_the_same(data: bytes) -> None:
    for read, write in ((read_request, write_request), (read_answer, write_answer), (read_offers, write_offers)):
        try:
            value = read(data)
        except WireError as error:
            assert error.kind in ("entry_bounds", "entry_kind")
        else:
            assert write(value) == data  # type: ignore[operator]


def test_the_bytes_are_those_of_the_page() -> None:
    assert write_request(ListRequest()).hex(" ") == "00"
    assert write_request(WishRequest("scan", 2.0, 60)).hex(" ") == "01 40 00 00 00 00 3c 73 63 61 6e"
    assert write_request(GiveUp("scan")).hex(" ") == "02 73 63 61 6e"
    sent = WishAnswer(WishOutcome.SENT, 2.0, 384.0, inf)
    assert write_answer(sent).hex(" ") == "00 40 00 00 00 43 c0 00 00 7f 80 00 00"
    row = OfferRow("scan", "sensor_msgs/msg/LaserScan", 10.0, 192.0, wanted=True)
    assert write_offers([row]).hex(" ") == (
        "01 41 20 00 00 43 40 00 00 04 19 73 63 61 6e "
        "73 65 6e 73 6f 72 5f 6d 73 67 73 2f 6d 73 67 2f 4c 61 73 65 72 53 63 61 6e"
    )


@pytest.mark.parametrize(
    "request_",
    [
        *(WishRequest("a", rate, 1) for rate in (-1.0, nan, inf)),
        *(WishRequest("a", 1.0, for_s) for for_s in (0, 65536)),
        *(GiveUp(name) for name in ("", "x" * 256, "a\x1b[2J")),
    ],
)
def test_what_cannot_be_asked_is_not_written(request_: LinkRequest) -> None:
    with pytest.raises(EncodeError):
        write_request(request_)


@pytest.mark.parametrize(
    "data",
    [
        *("", "03", "0000", "01", "01 40000000 0000 61", "01 bf800000 0001 61", "01 7fc00000 0001 61"),
        *("01 40000000 0001", "02", "02 ff", "02 1b5b324a", "02 " + "61" * 256),
    ],
)
def test_what_no_robot_asks_is_refused(data: str) -> None:
    with pytest.raises(WireError):
        read_request(bytes.fromhex(data))


@pytest.mark.parametrize("figures", ["7f800000 00000000 00000000", "00000000 7f800000 00000000"])
def test_no_answer_names_an_infinite_rate(figures: str) -> None:
    with pytest.raises(WireError):
        read_answer(bytes.fromhex(f"02 {figures}"))


def test_a_list_has_an_end() -> None:
    row = write_offers([OfferRow("a", "b")])
    assert len(read_offers(row * MOST_OFFERS)) == MOST_OFFERS
    with pytest.raises(WireError):
        read_offers(row * (MOST_OFFERS + 1))
