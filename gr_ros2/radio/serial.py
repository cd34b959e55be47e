"""The `serial` front end: telemetry radios and LoRa modems that pass bytes on, on a serial line or by TCP."""

from __future__ import annotations

from typing import Literal

from pydantic.dataclasses import dataclass

from gr_ros2.radio.framing import Cobs, Framing, Slip
from gr_ros2.radio.packet_port import Connection, PacketFrontEnd
from gr_ros2.radio.serial_device import StreamOptions, open_stream
from gr_ros2.settings.config import STRICT

_FRAMINGS: dict[str, type[Framing]] = {"cobs": Cobs, "slip": Slip}


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SerialOptions(StreamOptions):
    """Settings of this front end.

    :param framing: how packets are told apart in the stream, the same at every robot: ``cobs`` adds one byte in 254,
        ``slip`` is RFC 1055
    """

    framing: Literal["cobs", "slip"] = "cobs"


class SerialFrontEnd(PacketFrontEnd):
    """See :class:`SerialOptions`."""

    name = "serial"
    Options = SerialOptions
    has_radio = True

    def _connect(self) -> Connection:
        options = self.options
        framing = _FRAMINGS[options.framing](self.phy.packet_len, self._counters)
        return open_stream(self.name, options.device, options.baud, framing)
