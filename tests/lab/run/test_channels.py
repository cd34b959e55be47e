"""The built-in channel scenarios: what each channel does without repair, and with it, on simulated time."""

from __future__ import annotations

import pytest

from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario

DURATION_S = 6.0


def odometry(name: str, *changes: str) -> TopicResult:
    settings = ["time=samples", "repair='off'", *changes]
    scenario = load_scenario(name, settings, duration_s=DURATION_S, seed=1)
    (topic,) = run_scenario(scenario).result.topics
    assert sum(topic.ledger.values()) == topic.sent > 0
    return topic


def pdr(name: str, *changes: str) -> float:
    found = odometry(name, *changes).pdr
    assert found is not None
    return found


def test_noise_hides_packets_from_the_stock_receiver() -> None:
    assert 0.3 < pdr("channel-awgn") < 0.75
    assert pdr("channel-awgn", "phy.options.detection_threshold=auto") > 0.97


@pytest.mark.parametrize("name", ["channel-multipath", "channel-cfo"])
def test_what_ofdm_is_made_for(name: str) -> None:
    assert pdr(name) > 0.97


def test_a_carrier_beyond_the_search_range_is_not_found() -> None:
    assert pdr("channel-cfo", "channel.frequency_offset=0.1") == 0


@pytest.mark.slow
def test_a_wrong_sample_clock_takes_long_packets() -> None:
    assert pdr("channel-clock-offset") < 0.9
    for remedy in ("phy.options.scramble=true", "packet_len=220"):
        assert pdr("channel-clock-offset", remedy) > 0.97


def test_fades_take_packets_in_a_row() -> None:
    faded = odometry("channel-rayleigh")
    assert faded.pdr is not None
    assert 0.6 < faded.pdr < 0.98
    assert faded.age_s.peak is not None
    assert faded.age_s.peak > 0.1  # three messages or more


def test_repair_brings_back_what_noise_and_fades_take() -> None:
    assert pdr("channel-awgn", "repair=auto") > pdr("channel-awgn") + 0.1
    assert pdr("channel-rayleigh", "repair=auto") > 0.98


def test_bursts_take_fewer_messages_than_as_many_single_losses() -> None:
    alone = pdr("channel-burst-loss", "channel.burst_loss=null", "channel.packet_loss=0.0909")
    assert pdr("channel-burst-loss") > alone + 0.2


def test_a_link_that_was_unplugged_goes_on_as_before() -> None:
    alone = "topics.odom.reliability=best_effort"  # in order, it would wait hold_s for what is lost
    odom = odometry("channel-unplugged", "channel.outages=[[2, 3.5]]", alone)
    assert odom.pdr == pytest.approx(0.75, abs=0.01)
    assert odom.age_s.peak == pytest.approx(1.55, abs=0.05)
    assert odom.latency_s.max is not None
    assert odom.latency_s.max < 0.1  # nothing had queued up
