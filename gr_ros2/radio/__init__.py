"""One robot's end of a link: both directions, on any PHY and any front end of the table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from gr_ros2.core.backends import Backend, BackendTable


@dataclass(frozen=True)
class FrontEndBackend(Backend):
    """One front end of the table.

    :param phy: the PHY of a link that names none
    :param phy_options: its settings
    :param sample_rate: default sample rate of a link, samples/s; all devices of the front end support it
    """

    phy: str = "psk"
    phy_options: Mapping[str, Any] = field(default_factory=dict)
    sample_rate: float = 1e6


_ROOM = {"payload_modulation": "bpsk", "fec": "cc", "fft_len": 256, "cp_len": 128, "scramble": True}
"""OFDM with a prefix longer than most rooms echo."""
_FIRST_LEN, _HALL_LEN = 135, 116
"""Bytes of its longest packet: hello, the row of a topic and its first message fit into one. In a hall that would take
a quarter of a second longer, so row and message do. With 64 B they take three."""

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
        "audio": FrontEndBackend(
            "gr_ros2.radio.audio",
            "AudioFrontEnd",
            "sound: a loudspeaker and a microphone, a cable, or a voice radio",
            "pip install gr-ros2[audio] and apt install libportaudio2",
            title="Sound Card",
            phy="ofdm",
            phy_options=_ROOM,
            sample_rate=8e3,
        ),
        "kiss": FrontEndBackend(
            "gr_ros2.radio.kiss",
            "KissFrontEnd",
            "TNCs and modems that speak KISS, such as direwolf",
            "pyserial",
            title="KISS Modem",
            phy="modem",
            # TXDELAY takes 0.3 s, the wait for a free channel 0.35 s, and another station's packets as long again.
            phy_options={"bit_rate": 1200.0, "overhead_bytes": 19, "overhead_s": 1.5},
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


@dataclass(frozen=True)
class Preset:
    """A kind of radio: what a link over one needs, as its YAML would say it.

    :param front_end: a name of ``FRONT_ENDS``
    :param summary: one line of help: the radio, and how it has to be set up
    :param settings: of the front end
    :param phy_options: of the PHY
    :param packet_len: bytes of the longest packet
    :param phy: a name of ``gr_ros2.phy.PHY``; '' = that of the front end
    :param sample_rate: samples/s; 0 = that of the front end
    :param medium: who may send when; '' = everybody at any time
    """

    front_end: str
    summary: str
    settings: Mapping[str, Any]
    phy_options: Mapping[str, Any]
    packet_len: int
    phy: str = ""
    sample_rate: float = 0.0
    medium: str = ""


PRESETS: Mapping[str, Preset] = {
    "sound": Preset(
        "audio",
        "loudspeakers and microphones in one room, about a metre apart",
        {"half_duplex": True},
        _ROOM,
        _FIRST_LEN,
        medium="slots",
    ),
    "hall": Preset(
        "audio",
        "loudspeakers and microphones some metres apart, or where echoes are louder than the direct sound: slow",
        {"half_duplex": True, "turnaround_s": 0.3},
        {**_ROOM, "fft_len": 512, "cp_len": 256},
        _HALL_LEN,
        sample_rate=3e3,
        medium="slots",
    ),
    "voice": Preset(
        "audio",
        "the audio socket of a voice radio, FM or SSB, keyed by sound (VOX) unless front_end.ptt says how",
        {"centre_hz": 1500.0, "half_duplex": True, "turnaround_s": 0.2, "ptt": "vox"},
        {"fec": "cc"},
        64,
        "psk",
        6e3,
        "slots",
    ),
    "cable": Preset(
        "audio",
        "an audio cable from the output of each computer to the input of the other",
        {"centre_hz": 11_000.0},
        {"payload_modulation": "16qam", "fec": "cc", "scramble": True},
        220,
        sample_rate=24e3,
    ),
    "sik": Preset(
        "serial",
        "SiK telemetry radios, RFD900: SERIAL_SPEED 57, AIR_SPEED 64, MAVLINK 0, ECC 0",
        {"baud": 57_600},
        # Both radios share 64,000 bits/s by turns. Of each turn, headers and the pause to the next take a fifth.
        {"bit_rate": 24_000.0, "overhead_bytes": 5},
        220,
    ),
    "lora-uart": Preset(
        "serial",
        "LoRa modules with a UART, E22 or E32: 57600 baud 8N1, transparent, air rate 19.2k",
        # They do not listen before they send. Silence of twice a packet lets the other robot through.
        {"baud": 57_600, "backoff_s": 0.15},
        # SF7 at 500 kHz, code rate 4/5. The module waits for the end of the bytes, then sends its preamble.
        {"bit_rate": 12_000.0, "overhead_bytes": 5, "overhead_s": 0.03},
        # E32 modules send 58 bytes at a time, and E22 modules 32 to 240. 3 of them are framing.
        55,
    ),
}
"""Radios that several front ends could stand for, by the name that ``--radio`` takes. ``kiss`` is a front end."""

__all__ = ["FRONT_ENDS", "PRESETS", "FrontEndBackend", "Preset"]
