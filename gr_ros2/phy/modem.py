"""The `modem` PHY: packets to a radio that modulates them itself, such as a TNC or a telemetry radio. No samples.

The airtime follows from the bit rate that is stated, since such a modem does not tell how long a packet takes.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.config import Seconds
from gr_ros2.errors import PhyError
from gr_ros2.phy.base import PacketReceiver, PacketTransmitter, Phy

BITS = 8


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid"))
class ModemOptions:
    """Settings of this PHY beside packet length.

    :param bit_rate: bits/s that the modem sends on the air
    :param overhead_bytes: bytes that framing and the modem add to each packet, 0..4096
    :param overhead_s: s that the modem needs for each packet beside its bits: switching the transmitter on, preamble,
        gap
    """

    bit_rate: Annotated[float, Field(gt=0, allow_inf_nan=False, title="Bit rate (bits/s)")] = 9600.0
    overhead_bytes: Annotated[int, Field(ge=0, le=4096, title="Bytes added to a packet")] = 0
    overhead_s: Annotated[Seconds, Field(title="Time added to a packet (s)")] = 0.0


class ModemPhy(Phy):
    """See :class:`ModemOptions`.

    Airtime of a packet of n bytes: ``overhead_s + 8 (n + overhead_bytes) / bit_rate``.
    """

    name = "modem"
    has_samples = False
    Options = ModemOptions

    def __init__(self, packet_len: int, sample_rate: float = 0.0, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)

    @property
    def any_length(self) -> bool:
        return True

    def airtime_samples(self, packet_len: int | None = None) -> int:  # noqa: ARG002
        return 0

    def airtime(self, packet_len: int | None = None, rung: int = 0) -> float:  # noqa: ARG002 - one rate
        length = self.packet_len if packet_len is None else packet_len
        bits = BITS * (length + self.options.overhead_bytes)
        return float(self.options.overhead_s + bits / self.options.bit_rate)

    def burst_power(self) -> float:
        return 0.0

    def transmitter(self) -> PacketTransmitter:
        raise PhyError("phy modem has no transmitter; its packets go to a front end such as kiss, serial or udp")

    def receiver(self, own_process: bool = False) -> PacketReceiver:  # noqa: ARG002
        raise PhyError("phy modem has no receiver; its packets come from a front end such as kiss, serial or udp")
