"""One robot's end of a link: both directions, on any PHY and any front end of the table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from gr_ros2.core.backends import Backend, BackendTable


@dataclass(frozen=True)
class FrontEndBackend(Backend):
    """One row of the front end table.

    :param phy: the PHY of a link that names none
    :param phy_options: its settings
    :param sample_rate: default sample rate of a link, samples/s; all devices of the front end support it
    """

    phy: str = "psk"
    phy_options: Mapping[str, Any] = field(default_factory=dict)
    sample_rate: float = 1e6


FRONT_ENDS = BackendTable(
    "front_end",
    {
        "sim": FrontEndBackend(
            "gr_ros2.radio.sim",
            "SimFrontEnd",
            "channel model: what a robot sends comes back to it",
            title="Simulated Radio",
        ),
        "zmq": FrontEndBackend(
            "gr_ros2.radio.zmq",
            "ZmqFrontEnd",
            "samples over ZeroMQ: processes or machines without radios",
            "pyzmq",
            title="ZeroMQ Radio",
        ),
        "file": FrontEndBackend(
            "gr_ros2.radio.file", "FileFrontEnd", "SigMF recordings, written and replayed", title="SigMF File Radio"
        ),
        "soapy": FrontEndBackend(
            "gr_ros2.radio.soapy",
            "SoapyFrontEnd",
            "any SoapySDR device",
            "gr-soapy, part of GNU Radio 3.10",
            title="SoapySDR Radio",
            sample_rate=2e6,
        ),
        "uhd": FrontEndBackend(
            "gr_ros2.radio.uhd", "UhdFrontEnd", "USRPs", "gr-uhd, part of GNU Radio 3.10", title="USRP Radio"
        ),
        "pluto": FrontEndBackend(
            "gr_ros2.radio.pluto",
            "PlutoFrontEnd",
            "ADALM-Pluto",
            "gr-iio, part of GNU Radio 3.10",
            title="Pluto Radio",
            sample_rate=2.5e6,
        ),
        "kiss": FrontEndBackend(
            "gr_ros2.radio.kiss",
            "KissFrontEnd",
            "TNCs and modems that speak KISS, such as direwolf",
            "pyserial",
            title="KISS Modem",
            phy="modem",
            phy_options={"bit_rate": 1200.0, "overhead_bytes": 19, "overhead_s": 0.4},
        ),
        "serial": FrontEndBackend(
            "gr_ros2.radio.serial",
            "SerialFrontEnd",
            "telemetry radios on a serial line",
            "pyserial",
            title="Serial Modem",
            phy="modem",
            phy_options={"bit_rate": 57_600.0, "overhead_bytes": 5},
        ),
        "udp": FrontEndBackend(
            "gr_ros2.radio.udp",
            "UdpFrontEnd",
            "one datagram per packet, for modems with an Ethernet port",
            title="UDP Modem",
            phy="modem",
            phy_options={"bit_rate": 1e6, "overhead_bytes": 28},
        ),
    },
    FrontEndBackend,
)

__all__ = ["FRONT_ENDS", "FrontEndBackend"]
