"""The `modem` PHY: no samples, and airtime from the bit rate that is stated."""

from __future__ import annotations

import pytest

from gr_ros2.core.errors import ConfigError, PhyError
from gr_ros2.phy import PHY
from gr_ros2.phy.modem import ModemPhy


def test_a_packet_takes_as_long_as_its_bits() -> None:
    phy: ModemPhy = PHY.load("modem")(220, bit_rate=1200.0, overhead_bytes=19, overhead_s=0.4)
    assert phy.airtime() == pytest.approx(0.4 + 8 * 239 / 1200)
    assert phy.airtime(13) == pytest.approx(0.4 + 8 * 32 / 1200)
    assert phy.any_length
    assert phy.airtime_samples() == phy.burst_power() == 0


def test_it_has_no_blocks() -> None:
    phy = PHY.load("modem")(64)
    for block in (phy.transmitter, phy.receiver):
        with pytest.raises(PhyError, match="front end such as kiss, serial or udp"):
            block()


def test_a_wrong_bit_rate_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="bit_rate"):
        PHY.load("modem")(64, bit_rate=0.0)
