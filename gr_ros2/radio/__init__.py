"""One robot's end of a link: both directions, on any PHY and any front end of the table."""

from __future__ import annotations

from dataclasses import dataclass

from gr_ros2.backends import Backend, BackendTable


@dataclass(frozen=True)
class FrontEndBackend(Backend):
    """One row of the front end table.

    :param sample_rate: default sample rate of a link, samples/s; all devices of the front end support it
    """

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
    },
    FrontEndBackend,
)

__all__ = ["FRONT_ENDS", "FrontEndBackend"]
