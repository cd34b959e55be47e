"""The bytes of requests and replies."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.calls.frames import CallFrame, read_frame, write_frame
from gr_ros2.core.errors import EncodeError, EntryBoundsError, EntryKindError, WireError

numbers = {
    "dst_id": st.integers(0, 254),
    "dst_boot": st.integers(0, 2**32 - 1),
    "number": st.integers(1, 2**32 - 1),
    "payload": st.binary(max_size=40),
}
requests = st.builds(
    CallFrame,
    **numbers,
    service_id=st.integers(0, 240),
    deadline_s=st.integers(0, 65535).map(lambda tenths: tenths / 10),
)
replies = st.builds(CallFrame, **numbers)


@given(requests | replies)
def test_a_frame_is_read_as_it_was_written(frame: CallFrame) -> None:
    assert read_frame(write_frame(frame)) == frame


@given(st.binary(max_size=30))
def test_whatever_is_read_is_written_the_same_or_refused_by_name(data: bytes) -> None:
    try:
        frame = read_frame(data)
    except WireError as error:
        assert error.kind in ("entry_bounds", "entry_kind")
    else:
        assert write_frame(frame) == data


def test_the_bytes_are_those_of_the_page() -> None:
    request = CallFrame(2, 0x6B49D200, 7, b"\0\1\0\0abcd", service_id=3, deadline_s=30.0)
    assert write_frame(request).hex(" ") == "00 02 00 00 00 00 6b 49 d2 00 00 00 00 07 03 01 2c 00 01 00 00 61 62 63 64"
    reply = CallFrame(1, 0x6B49D201, 7, b"\0\1\0\0efgh")
    assert write_frame(reply).hex(" ") == "01 01 00 00 00 00 6b 49 d2 01 00 00 00 07 00 01 00 00 65 66 67 68"


def test_a_short_deadline_is_not_taken_for_none() -> None:
    assert read_frame(write_frame(CallFrame(2, 1, 1, b"", 0, 0.01))).deadline_s == 0.1


@pytest.mark.parametrize(
    "frame",
    [
        CallFrame(255, 1, 1, b""),
        CallFrame(1, 1, 0, b""),
        CallFrame(1, 1, 1, b"", 241),
        CallFrame(1, 1, 1, b"", 1, 6553.6),
        CallFrame(1, -1, 1, b""),
    ],
)
def test_what_does_not_fit_is_not_written(frame: CallFrame) -> None:
    with pytest.raises(EncodeError):
        write_frame(frame)


@pytest.mark.parametrize(
    ("data", "error"),
    [
        ("", EntryBoundsError),
        ("010200000000000000010000000", EntryBoundsError),
        ("00020000000000000001000000010100", EntryBoundsError),
        ("0202000000000000000100000001", EntryKindError),
        ("01ff000000000000000100000001", EntryKindError),
        ("0102000000000000000100000000", EntryKindError),
        ("0002000000000000000100000001f10000", EntryKindError),
    ],
)
def test_what_cannot_be_is_refused_by_name(data: str, error: type[WireError]) -> None:
    with pytest.raises(error):
        read_frame(bytes.fromhex(data[: len(data) // 2 * 2]))
