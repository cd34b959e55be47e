"""The `serial` front end: telemetry radios and LoRa modems that pass bytes on, on a serial line or by TCP."""

from __future__ import annotations

import os
import random
import socket
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import serial
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import RadioError, reason
from gr_ros2.phy import Phy
from gr_ros2.radio.framing import Cobs, Framing, Slip
from gr_ros2.radio.front_end import SharedAir
from gr_ros2.radio.packet_port import Connection, PacketFrontEnd, StreamConnection
from gr_ros2.settings.config import STRICT, Seconds

_FRAMINGS: dict[str, type[Framing]] = {"cobs": Cobs, "slip": Slip}
_TCP = "tcp://"
_CONNECT_S = 3.0


def _valid(device: str) -> str:
    if device.startswith(_TCP):
        address = urlsplit(device)
        if not address.hostname or not address.port:  # .port raises ValueError above 65535
            raise ValueError(f"write {_TCP}HOST:PORT")
    elif not device.startswith("/"):
        raise ValueError(f"write a device as /dev/ttyUSB0, or {_TCP}HOST:PORT")
    return device


Device = Annotated[str, Field(min_length=1), AfterValidator(_valid)]
"""``/dev/ttyUSB0`` or ``tcp://HOST:PORT``."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class StreamOptions(SharedAir):
    """What every front end on a stream of bytes takes."""

    device: Annotated[Device, Field(title="Device")]
    """``/dev/ttyUSB0``; or ``tcp://HOST:PORT``, for instance of direwolf or of a serial server"""
    baud: Annotated[int, Field(ge=50, le=4_000_000, title="Speed of the serial line (baud)")] = 57_600
    """speed of a serial line, the same as in the modem's settings"""
    backoff_s: Annotated[Seconds, Field(title="Random silence after a packet (s)")] = 0.0
    """s of silence after each packet, at random from 0 to this, where modems share a frequency and do not listen"""
    half_duplex: bool = True


class StreamFrontEnd(PacketFrontEnd):
    """A packet radio on a stream of bytes."""

    Options = StreamOptions
    has_radio = True

    def __init__(self, phy: Phy, **options: Any) -> None:
        self._rng = random.Random()
        super().__init__(phy, **options)

    def airtime(self, packet_len: int | None = None, mcs: int = 0) -> float:
        drawn = 0.0 if packet_len is None else self._rng.random() * float(self.options.backoff_s)
        return super().airtime(packet_len, mcs) + drawn

    @classmethod
    def airtime_with(cls, phy: Phy, chosen: Any, packet_len: int | None = None, mcs: int = 0) -> float:
        longest = float(chosen.backoff_s) if packet_len is None else 0.0
        return super().airtime_with(phy, chosen, packet_len, mcs) + longest


def open_stream(front_end: str, device: str, baud: int, framing: Framing) -> StreamConnection:
    """Open a device or a TCP connection.

    :param front_end: its name, for errors
    :param device: see :data:`Device`
    :param baud: of a serial line, 8 data bits, no parity
    :param framing: a new one
    :raises RadioError: when it cannot be opened
    """
    opener: Callable[[str, int, Framing], StreamConnection] = _tcp if device.startswith(_TCP) else _line
    try:
        return opener(device, baud, framing)
    except (OSError, ValueError) as error:  # pyserial raises ValueError for a baud rate that the driver refuses
        raise RadioError(
            f"front_end {front_end}: device = {device!r}: {reason(error)}; check that it is there, that no other "
            "program uses it, and that you may open it"
        ) from error


def _tcp(device: str, _: int, framing: Framing) -> StreamConnection:
    address = urlsplit(device)
    opened = socket.create_connection((address.hostname or "", address.port or 0), _CONNECT_S)
    opened.setblocking(False)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    return StreamConnection(opened.fileno(), opened.recv, opened.send, opened.close, framing)


def _line(device: str, baud: int, framing: Framing) -> StreamConnection:
    line = serial.Serial(device, baud, timeout=0, exclusive=True)
    descriptor = line.fileno()
    # pyserial would wait where the line takes no more.
    return StreamConnection(
        descriptor, partial(os.read, descriptor), partial(os.write, descriptor), line.close, framing
    )


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
