"""The pulse of `psk` is GNU Radio's, of which this package has a form of its own."""

from __future__ import annotations

import numpy as np
import pytest
from gnuradio.filter import firdes

from gr_ros2.phy.psk import root_raised_cosine


@pytest.mark.parametrize("sps", [2, 4, 7])
@pytest.mark.parametrize("rolloff", [0.2, 0.35, 0.5, 1.0])
def test_the_pulse_is_that_of_firdes(sps: int, rolloff: float) -> None:
    theirs = np.array(firdes.root_raised_cosine(1.0, sps, 1.0, rolloff, 10 * sps + 1))
    assert np.allclose(root_raised_cosine(sps, rolloff), theirs / np.sqrt((theirs**2).sum()), atol=1e-6)
