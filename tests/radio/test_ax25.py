"""AX.25 UI frames as the protocol has them."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter, ValidationError

from gr_ros2.radio.kiss import HEADER_LEN, Callsign, information, ui_header


def test_addresses_are_those_of_the_specification() -> None:
    header = ui_header("NJ7P", "N7LEM")  # the example of AX.25 2.2, section 3.12
    assert header.hex() == "9c946ea04040e0" + "9c6e988a9a4061" + "03f0"
    assert len(header) == HEADER_LEN
    assert ui_header("GRROS2-15", "N0CALL-7")[6] == 0xE0 | 15 << 1
    assert ui_header("GRROS2-15", "N0CALL-7")[13] == 0x61 | 7 << 1


def test_only_frames_to_the_group_have_information_for_us() -> None:
    frame = ui_header("GRROS2", "N0CALL-7") + b"packet"
    assert information(frame, "GRROS2") == b"packet"
    assert information(ui_header("GRROS2", "N0CALL"), "GRROS2") == b""
    for other in ("GRROS3", "GRROS2-1", "APRS"):
        assert information(frame, other) is None
    connected = bytearray(frame)
    connected[14] = 0x2F  # SABM
    for wrong in (b"", frame[:15], bytes(connected), frame[:15] + b"\xcc" + frame[16:]):
        assert information(wrong, "GRROS2") is None


@pytest.mark.parametrize("callsign", ["n0call", "TOOLONGCALL", "N0CALL-16", "N0CALL-", "N0 CALL"])
def test_what_is_no_callsign_is_refused(callsign: str) -> None:
    with pytest.raises(ValidationError, match="1 to 6 capital letters"):
        TypeAdapter(Callsign).validate_python(callsign)
