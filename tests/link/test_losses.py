"""Lost packets: as many and in such bursts as asked for, the same with the same seed, each counted by its cause."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import pytest

from gr_ros2.link.losses import GilbertElliott, PduLosses
from gr_ros2.settings.config import BurstLoss, ChannelConfig

COUNT = 200_000


def passed(count: int = COUNT, **settings: Any) -> tuple[list[bool], PduLosses]:
    """What becomes of so many packets, one a second."""
    losses = PduLosses(ChannelConfig(**settings))
    return [losses.passes(float(now)) for now in range(count)], losses


def runs_of(values: list[bool], wanted: bool) -> list[int]:
    """Lengths of the runs of one value."""
    return [len(list(group)) for value, group in groupby(values) if value is wanted]


@pytest.mark.parametrize(
    "bursts",
    [
        BurstLoss(p_good_to_bad=0.02, p_bad_to_good=0.25),
        BurstLoss(p_good_to_bad=0.2, p_bad_to_good=0.1, loss_good=0.05, loss_bad=0.6),
        BurstLoss(p_good_to_bad=1.0, p_bad_to_good=1.0),
        BurstLoss(p_good_to_bad=0.0, p_bad_to_good=1.0),
    ],
)
def test_the_share_lost_is_that_of_the_stationary_chain(bursts: BurstLoss) -> None:
    lost = COUNT - sum(passed(burst_loss=bursts, seed=1)[0])
    assert lost / COUNT == pytest.approx(bursts.mean_loss, abs=0.01)


def test_bursts_are_as_long_as_the_bad_state_lasts() -> None:
    bursts = BurstLoss(p_good_to_bad=0.02, p_bad_to_good=0.2)
    fates, losses = passed(burst_loss=bursts, seed=1)
    lost, between = runs_of(fates, False), runs_of(fates, True)
    assert sum(lost) / len(lost) == pytest.approx(1 / bursts.p_bad_to_good, rel=0.05)
    assert sum(between) / len(between) == pytest.approx(1 / bursts.p_good_to_bad, rel=0.05)
    assert losses.dropped == {"burst_loss": sum(lost)}
    # The lengths are geometric: a burst of one packet is as frequent as the bad state is left at once.
    assert lost.count(1) / len(lost) == pytest.approx(bursts.p_bad_to_good, abs=0.02)


def test_the_first_packet_is_lost_as_often_as_any() -> None:
    bursts = BurstLoss(p_good_to_bad=0.1, p_bad_to_good=0.3)
    first = [GilbertElliott(bursts, seed).loses() for seed in range(4000)]
    assert sum(first) / len(first) == pytest.approx(bursts.mean_loss, abs=0.03)


def test_random_losses_come_alone() -> None:
    fates, losses = passed(packet_loss=0.2, seed=1)
    lost = runs_of(fates, False)
    assert losses.dropped["packet_loss"] / COUNT == pytest.approx(0.2, abs=0.01)
    assert sum(lost) / len(lost) == pytest.approx(1 / 0.8, rel=0.02)


def test_nothing_passes_while_the_link_is_unplugged() -> None:
    fates, losses = passed(30, outages=((3, 5), (10.5, 12)))
    assert [now for now, fate in enumerate(fates) if not fate] == [3, 4, 11]
    assert losses.dropped == {"outages": 3}


def test_equal_seeds_lose_the_same_packets() -> None:
    every = {"packet_loss": 0.1, "burst_loss": BurstLoss(0.1, 0.5), "outages": ((5, 9),)}
    first = passed(1000, seed=7, **every)[0]
    assert passed(1000, seed=7, **every)[0] == first
    assert passed(1000, seed=8, **every)[0] != first


def test_a_change_does_not_shift_what_the_seed_does_later() -> None:
    steady, changed = (PduLosses(ChannelConfig(packet_loss=0.3, seed=2)) for _ in range(2))
    before = [[losses.passes(0.0) for _ in range(100)] for losses in (steady, changed)]
    changed.packet_loss = 0.9
    during = [[losses.passes(0.0) for _ in range(100)] for losses in (steady, changed)]
    changed.packet_loss = 0.3
    after = [[losses.passes(0.0) for _ in range(100)] for losses in (steady, changed)]
    assert before[0] == before[1]
    assert during[0] != during[1]
    assert after[0] == after[1]
    only_bursts, both = (passed(1000, burst_loss=BurstLoss(0.1, 0.5), **more)[1] for more in ({}, {"packet_loss": 0.5}))
    assert only_bursts.dropped["burst_loss"] == both.dropped["burst_loss"]
