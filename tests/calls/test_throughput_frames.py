"""The bytes with which robots measure the link between them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.calls.throughput_frames import (
    MEASURE,
    REPORT,
    Carried,
    MeasureOutcome,
    MeasureRequest,
    read_measure,
    read_measured,
    write_measure,
    write_measured,
)
from gr_ros2.core.errors import EncodeError, WireError

counts = st.integers(0, 2**32 - 1)
ages = st.floats(-1e6, 1e6, width=32)
requests_ = st.builds(MeasureRequest, st.sampled_from((MEASURE, REPORT)), counts, st.integers(1, 60))
told = st.builds(
    Carried,
    st.sampled_from(MeasureOutcome),
    counts,
    counts,
    counts,
    counts,
    st.floats(0, 1e6, width=32),
    ages,
    ages,
    ages,
)


@given(requests_, told)
def test_what_is_written_is_read_as_it_was(request_: MeasureRequest, measured: Carried) -> None:
    assert read_measure(write_measure(request_)) == request_
    assert read_measured(write_measured(measured)) == measured


@given(st.binary(max_size=40) | st.builds(lambda kind, rest: bytes([kind]) + rest, st.integers(0, 4), st.binary()))
def test_whatever_is_read_is_refused_by_name_or_written_the_same(data: bytes) -> None:
    for read, write in ((read_measure, write_measure), (read_measured, write_measured)):
        try:
            value = read(data)
        except WireError as error:
            assert error.kind in ("entry_bounds", "entry_kind")
        else:
            assert len(write(value)) == len(data)  # type: ignore[operator]


@pytest.mark.parametrize(
    "request_", [MeasureRequest(MEASURE, 1, 0), MeasureRequest(REPORT, 1, 61), MeasureRequest(2, 1, 5)]
)
def test_what_cannot_be_is_not_written(request_: MeasureRequest) -> None:
    with pytest.raises(EncodeError):
        write_measure(request_)
