"""A channel that is bad in just the rhythm in which something is sent again lets it pass all the same."""

from __future__ import annotations

import pytest

from gr_ros2.settings.config import SendOptions
from tests.link.v1.air import Air, Robot, registry
from tests.link.v1.test_ages import MODES, SealMode


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("hears", [True, False])
@pytest.mark.parametrize("phase", [n / 4 for n in range(8)])
def test_robots_meet_in_a_channel_that_is_bad_every_other_second(mode: SealMode, hears: bool, phase: float) -> None:
    """After their first hellos were lost; robots that hear say theirs, and what they keep, less and less often then."""
    names = registry(map=SendOptions(durability="transient_local"))
    one, two = Robot(1, names, mode=mode, packet_len=200, hears=hears), Robot(2, mode=mode, packet_len=200, hears=hears)
    air = Air(one, two)
    air.lost = lambda *_: air.now < 3 or (air.now + phase) % 2 < 1
    one.end.messages.submit(0, b"the map", 0.0)
    assert air.run(100, lambda: bool(two.delivered(1))) < 60
