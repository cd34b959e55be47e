"""Physical layers behind one interface: choose one by name."""

from __future__ import annotations

from gr_ros2.core.backends import Backend, BackendTable
from gr_ros2.phy.base import Phy
from gr_ros2.settings.config import PhyConfig

_GNURADIO = "GNU Radio 3.10 (apt install gnuradio)"

PHY = BackendTable(
    "phy",
    {
        "direct": Backend(
            "gr_ros2.phy.direct", "DirectPhy", "message loopback, no samples", title="Direct (no samples)"
        ),
        "ofdm": Backend(
            "gr_ros2.phy.ofdm", "OfdmPhy", "OFDM against echoes, own or stock receiver", _GNURADIO, title="OFDM"
        ),
        "gfsk": Backend("gr_ros2.phy.gfsk", "GfskPhy", "GMSK bursts, constant envelope", _GNURADIO, title="GFSK"),
        "psk": Backend(
            "gr_ros2.phy.psk", "PskPhy", "single-carrier BPSK, QPSK or 8-PSK bursts", _GNURADIO, title="PSK"
        ),
        "lora": Backend(
            "gr_ros2.phy.lora", "LoraPhy", "chirp spread spectrum, own format or LoRa's", _GNURADIO, title="LoRa-like"
        ),
        "wifi": Backend(
            "gr_ros2.phy.wifi",
            "WifiPhy",
            "IEEE 802.11 a/g/p frames, by gr-ieee802-11",
            f"{_GNURADIO} and gr-ieee802-11 (https://github.com/bastibl/gr-ieee802-11, branch maint-3.10)",
            title="Wi-Fi (802.11)",
            imports=("ieee802_11",),
        ),
        "modem": Backend(
            "gr_ros2.phy.modem", "ModemPhy", "a radio that modulates packets itself; no samples", title="Modem"
        ),
    },
    Backend,
)


def configured(config: PhyConfig, packet_len: int, sample_rate: float) -> Phy:
    """The PHY that a configuration asks for.

    :param packet_len: bytes per packet
    :param sample_rate: samples/s
    :raises ConfigError: for an unknown name or setting, or a value out of range
    :raises BackendMissingError: when what it needs is not installed
    """
    settings = {"kernels": config.kernels, **config.options}
    phy: Phy = PHY.load(config.name)(packet_len, sample_rate, **settings)
    return phy


__all__ = ["PHY", "Phy", "configured"]
