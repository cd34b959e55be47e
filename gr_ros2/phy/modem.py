"""The `modem` PHY: packets to a radio that modulates them itself, such as a TNC or a telemetry radio. No samples.

The airtime follows from the bit rate that is stated, since such a modem does not tell how long a packet takes.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.phy.base import PacketPhy
from gr_ros2.settings.config import Seconds

BITS = 8


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid"))
class ModemOptions:
    """Settings of this PHY beside packet length."""

    bit_rate: Annotated[float, Field(gt=0, allow_inf_nan=False, title="Bit rate (bits/s)")] = 9600.0
    """bits/s that the modem sends on the air"""
    overhead_bytes: Annotated[int, Field(ge=0, le=4096, title="Bytes added to a packet")] = 0
    """bytes that framing and the modem add to each packet, 0..4096"""
    overhead_s: Annotated[Seconds, Field(title="Time added to a packet (s)")] = 0.0
    """s for each packet beside its bits: switching the transmitter on, preamble, gap"""


class ModemPhy(PacketPhy):
    """A modem that takes packets and modulates them itself.

    Airtime of a packet of n bytes: ``overhead_s + 8 (n + overhead_bytes) / bit_rate``.
    """

    name = "modem"
    crossing = "its packets go to and come from a front end such as kiss, serial or udp"
    Options = ModemOptions

    @property
    def any_length(self) -> bool:
        return True

    def airtime(self, packet_len: int | None = None, mcs: int = 0) -> float:  # noqa: ARG002 - one rate
        length = self.packet_len if packet_len is None else packet_len
        bits = BITS * (length + self.options.overhead_bytes)
        return float(self.options.overhead_s + bits / self.options.bit_rate)
