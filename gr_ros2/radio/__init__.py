"""One robot's end of a link: both directions, on any PHY and any front end of the table."""

from __future__ import annotations

from gr_ros2.backends import Backend, BackendTable

FRONT_ENDS = BackendTable(
    "front_end",
    {
        "sim": Backend(
            "gr_ros2.radio.sim",
            "SimFrontEnd",
            "channel model: what a robot sends comes back to it",
            title="Simulated Radio",
        ),
        "zmq": Backend(
            "gr_ros2.radio.zmq",
            "ZmqFrontEnd",
            "samples over ZeroMQ: processes or machines without radios",
            "pyzmq",
            title="ZeroMQ Radio",
        ),
        "file": Backend(
            "gr_ros2.radio.file", "FileFrontEnd", "SigMF recordings, written and replayed", title="SigMF File Radio"
        ),
        "soapy": Backend(
            "gr_ros2.radio.soapy",
            "SoapyFrontEnd",
            "any SoapySDR device",
            "gr-soapy, part of GNU Radio 3.10",
            title="SoapySDR Radio",
        ),
        "uhd": Backend(
            "gr_ros2.radio.uhd", "UhdFrontEnd", "USRPs", "gr-uhd, part of GNU Radio 3.10", title="USRP Radio"
        ),
        "pluto": Backend(
            "gr_ros2.radio.pluto", "PlutoFrontEnd", "ADALM-Pluto", "gr-iio, part of GNU Radio 3.10", title="Pluto Radio"
        ),
    },
    Backend,
)

__all__ = ["FRONT_ENDS"]
