"""The `kiss` front end: a TNC or a modem that speaks KISS, by TCP (direwolf) or on a serial line.

KISS does not say how long a packet was on the air, nor whether it has been sent. So phy ``modem`` states the bit rate.
"""

from __future__ import annotations

from collections import Counter
from typing import Annotated

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.radio.ax25 import HEADER_LEN, Callsign, information, ui_header
from gr_ros2.radio.framing import Kiss
from gr_ros2.radio.packet_port import Connection
from gr_ros2.radio.serial_device import StreamFrontEnd, StreamOptions, open_stream
from gr_ros2.settings.config import STRICT

_MAX_PORT = 15


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
