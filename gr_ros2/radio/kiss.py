"""The `kiss` front end: a TNC or a modem that speaks KISS, by TCP (direwolf) or on a serial line.

With a callsign each packet is the information of an AX.25 UI frame (version 2.2): two addresses, no digipeaters, the
control field of a UI frame, "no layer 3".

KISS does not say how long a packet was on the air, nor whether it has been sent. So phy ``modem`` states the bit rate.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.radio.framing import Kiss
from gr_ros2.radio.packet_port import Connection
from gr_ros2.radio.serial import StreamFrontEnd, StreamOptions, open_stream
from gr_ros2.settings.config import STRICT

_MAX_PORT = 15
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


@dataclass(frozen=True, kw_only=True, config=STRICT)
class KissOptions(StreamOptions):
    """Settings of this front end."""

    tnc_port: Annotated[int, Field(ge=0, le=_MAX_PORT, title="Port of the TNC")] = 0
    """which radio of the TNC, 0..15"""
    callsign: Annotated[Callsign, Field(title="Own callsign")] = ""
    """own callsign, for AX.25 UI frames, as direwolf needs them; '' = packets as they are"""
    destination: Annotated[Callsign, Field(title="Callsign of the group")] = "GRROS2"
    """callsign of the group of robots"""

    @model_validator(mode="after")
    def _addressed(self) -> KissOptions:
        if self.callsign and not self.destination:
            raise ValueError("destination is missing; with callsign a frame goes from one station to another")
        return self


class KissFrontEnd(StreamFrontEnd):
    """Packets as frames of KISS."""

    name = "kiss"
    timing_error_s = 0.1
    Options = KissOptions

    def _connect(self) -> Connection:
        options, longest = self.options, self.phy.packet_len
        framing: Kiss
        if options.callsign:
            framing = Ax25Kiss(longest, self._counters, options)
        else:
            framing = Kiss(longest, self._counters, port=options.tnc_port)
        return open_stream(self.name, options.device, options.baud, framing)


class Ax25Kiss(Kiss):
    """Packets as information of AX.25 UI frames.

    :param options: callsigns and port
    """

    def __init__(self, longest: int, dropped: Counter[str] | None, options: KissOptions) -> None:
        super().__init__(longest, dropped, port=options.tnc_port)
        self._most += 2 * HEADER_LEN
        self._header = ui_header(options.destination, options.callsign)
        self._destination = options.destination

    def frame(self, packet: bytes) -> bytes:
        return super().frame(self._header + packet)

    def _content(self, frame: bytes) -> bytes | None:
        content = super()._content(frame)
        if content is None:
            return None
        packet = information(content, self._destination)
        if packet is None:
            self.dropped["foreign"] += 1
        return packet
