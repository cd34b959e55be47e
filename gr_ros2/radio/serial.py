"""The `serial` front end: telemetry radios and LoRa modems that pass bytes on, on a serial line or by TCP."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.radio.framing import Cobs, Framing, Slip
from gr_ros2.radio.packet_port import Connection
from gr_ros2.radio.serial_device import StreamFrontEnd, StreamOptions, open_stream
from gr_ros2.settings.config import STRICT

_FRAMINGS: dict[str, type[Framing]] = {"cobs": Cobs, "slip": Slip}


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SerialOptions(StreamOptions):
    """Settings of this front end."""

    framing: Literal["cobs", "slip"] = "cobs"
    """how packets are told apart, the same at every robot: `cobs` adds one byte in 254, `slip` is RFC 1055"""
    rssi: Annotated[bool, Field(title="Byte of signal strength")] = False
    """the radio adds a byte of signal strength behind each packet (E22: REG3, bit 7)"""


class SerialFrontEnd(StreamFrontEnd):
    """Packets as frames on a serial line."""

    name = "serial"
    Options = SerialOptions

    def _connect(self) -> Connection:
        options = self.options
        self._framing = _FRAMINGS[options.framing](self.phy.packet_len, self._counters, rssi=options.rssi)
        return open_stream(self.name, options.device, options.baud, self._framing)

    @property
    def rssi_dbm(self) -> int | None:
        return self._framing.rssi_dbm
