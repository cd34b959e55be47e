"""The `direct` PHY has no samples, no airtime and no options."""

from __future__ import annotations

import pytest

from gr_ros2.core.errors import ConfigError, PhyError
from gr_ros2.phy import PHY


def test_it_takes_no_air() -> None:
    phy = PHY.load("direct")(64)
    assert phy.airtime_samples() == 0
    assert phy.airtime() == 0.0
    assert phy.burst_power() == 0.0


def test_it_has_no_blocks() -> None:
    phy = PHY.load("direct")(64, 1e6)
    with pytest.raises(PhyError, match="direct"):
        phy.transmitter()
    with pytest.raises(PhyError, match="direct"):
        phy.receiver()


def test_an_option_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="gap"):
        PHY.load("direct")(64, 0.0, gap=1)
