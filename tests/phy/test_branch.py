"""Several receivers of one transmitter, for every PHY of the table: each behind a channel of its own."""

from __future__ import annotations

import random

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import PHY
from gr_ros2.phy.loopback import LoopbackLink
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.phy.test_loopback import make
from tests.waiting import wait_for


@pytest.mark.parametrize("throttled", [True, False])
@pytest.mark.parametrize("name", list(PHY))
def test_every_receiver_has_losses_of_its_own(name: str, throttled: bool) -> None:
    rng = random.Random(1)
    source, first, second, third = (Probe() for _ in range(4))
    sent = [rng.randbytes(64) for _ in range(100)]
    further = [(ChannelConfig(), second), (ChannelConfig(packet_loss=0.5, seed=3), third)]
    with LoopbackLink(make(name), source, first, throttled=throttled, further=further) as link:
        for packet in sent:
            source.post(packet)
        complete, lossy = link.branches
        wait_for(lambda: first.handled == second.handled == lossy.received == 100, "every packet")
        wait_for(lambda: third.handled == 100 - lossy.counts().dropped, "what is not lost")
        assert complete.counts().dropped == 0
        assert 20 < lossy.counts().dropped < 80
    assert first.packets == second.packets == sent
    assert third.packets == [packet for packet in sent if packet in set(third.packets)]


def test_noise_at_one_receiver_is_not_heard_at_another() -> None:
    source, first, second = Probe(), Probe(), Probe()
    with LoopbackLink(make("ofdm"), source, first, further=[(ChannelConfig(snr_db=-20.0, seed=1), second)]) as link:
        for _ in range(20):
            source.post(bytes(64))
        wait_for(lambda: first.handled == 20, "every packet")
        assert link.branches[0].channel.snr_db == -20.0
    assert second.handled < 20


def test_a_channel_that_the_phy_cannot_have_is_refused() -> None:
    with pytest.raises(ConfigError, match="snr_db"):
        LoopbackLink(make("direct"), Probe(), Probe(), further=[(ChannelConfig(snr_db=10.0), Probe())])
