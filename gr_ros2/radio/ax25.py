"""AX.25 UI frames (version 2.2 of the protocol): what a TNC of amateur radio expects in a KISS frame.

Only the connectionless part, without digipeaters: two addresses, the control field of a UI frame, "no layer 3".
"""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator

_CALLSIGN = re.compile(r"([A-Z0-9]{1,6})(?:-(1[0-5]|[0-9]))?")
_ADDRESS_LEN = 7
_UI, _NO_LAYER_3 = 0x03, 0xF0
_RESERVED = 0x60
_COMMAND, _LAST = 0x80, 0x01

HEADER_LEN = 2 * _ADDRESS_LEN + 2
"""Bytes that a frame has before its information field."""


def _valid(callsign: str) -> str:
    if callsign and not _CALLSIGN.fullmatch(callsign):
        raise ValueError("a callsign has 1 to 6 capital letters and digits, and -0 to -15 after them if needed")
    return callsign


Callsign = Annotated[str, AfterValidator(_valid)]
"""``N0CALL`` or ``N0CALL-7``; '' = none."""


def ui_header(destination: str, source: str) -> bytes:
    """What stands before the information field.

    :param destination: callsign of the station or group that is addressed
    :param source: callsign of the sender
    """
    addresses = _address(destination, _COMMAND) + _address(source, _LAST)
    return addresses + bytes([_UI, _NO_LAYER_3])


def information(frame: bytes, destination: str) -> bytes | None:
    """The information field of a UI frame to ``destination``, whoever sent it. None for any other frame."""
    if len(frame) < HEADER_LEN or frame[2 * _ADDRESS_LEN : HEADER_LEN] != bytes([_UI, _NO_LAYER_3]):
        return None
    wanted = _address(destination, 0)
    same_call = frame[: _ADDRESS_LEN - 1] == wanted[:-1]
    same_ssid = (frame[_ADDRESS_LEN - 1] ^ wanted[-1]) & 0x1E == 0
    return frame[HEADER_LEN:] if same_call and same_ssid else None


def _address(callsign: str, flags: int) -> bytes:
    found = _CALLSIGN.fullmatch(callsign)
    assert found is not None
    name, ssid = found.group(1), int(found.group(2) or 0)
    return bytes(ord(letter) << 1 for letter in name.ljust(6)) + bytes([_RESERVED | ssid << 1 | flags])
