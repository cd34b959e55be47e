"""What a link that carries bursts does not load, since it would cost memory and time at every start."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import sys
from gr_ros2.phy import PHY
from gr_ros2.radio import robot_link, zmq
PHY.load("{name}")(64, 1e6)
print(*sorted(name for name in sys.modules if name.count(".") == 1 and name.startswith("gnuradio.")))
"""


@pytest.mark.parametrize("name", ["ofdm", "psk"])
def test_of_gnu_radio_only_its_core_is_loaded(name: str) -> None:
    done = subprocess.run([sys.executable, "-c", CODE.format(name=name)], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["gnuradio.gr"]
