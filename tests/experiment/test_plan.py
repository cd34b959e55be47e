"""The plan: forecasts that add up, and advice that holds when it is followed."""

from __future__ import annotations

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.errors import ConfigError
from gr_ros2.experiment.plan import Planner
from gr_ros2.experiment.scenario import load_scenario
from gr_ros2.experiment.simulate import simulate


def planner(name: str, *overrides: str, duration: float = 5.0) -> Planner:
    return Planner(load_scenario(name, overrides, duration_s=duration))


@pytest.mark.parametrize("name", ["paper-ofdm", "paper-ofdm-paced", "six-topics-paced", "demo"])
def test_the_shares_of_the_topics_are_the_airtime_used(name: str) -> None:
    forecast = planner(name).forecast()
    assert min(1.0, sum(topic.share for topic in forecast.topics)) == pytest.approx(forecast.used, rel=0.02)
    assert forecast.capacity == pytest.approx(1 / forecast.airtime_s)
    assert 0 <= forecast.pad < 1


def test_what_fits_is_said_to_fit() -> None:
    fits = planner("paper-ofdm-paced").forecast()
    assert fits.load == pytest.approx(fits.used, rel=0.02)
    assert fits.load < 1
    assert fits.topics[0].rate_hz == pytest.approx(fits.topics[0].offered_hz)
    assert planner("narrow-ofdm-paced").forecast().load > 1
    assert planner("paper-ofdm").forecast().load == pytest.approx(7.14, rel=0.05), "seven times, as the paper has it"


def test_a_forecast_is_what_the_link_does() -> None:
    scenario = load_scenario("six-topics-paced", duration_s=5.0)
    done = {topic.topic: topic for topic in simulate(scenario).topics}
    for topic in Planner(scenario).forecast().topics:
        assert topic.result.delivered == done[topic.topic].delivered


def test_advice_holds_when_it_is_followed() -> None:
    plan = planner("paper-ofdm")
    best = plan.advice()[0]
    assert best.setting == "ros_source.compression=true ros_sink.compression=true"
    followed = planner("paper-ofdm", *best.setting.split())
    assert followed.forecast().load < 1
    lens = [advice for advice in followed.advice() if advice.setting.startswith("packet_len=")]
    assert lens, "a packet length that fits the message"
    per_message = planner("paper-ofdm", *best.setting.split(), lens[0].setting).forecast().air_bytes_per_message
    assert per_message is not None
    assert per_message <= 115


def test_packet_lengths_too_small_for_the_largest_message_are_not_proposed() -> None:
    plan = planner("demo")
    assert all(255 * (packet_len - 13) >= 10104 for packet_len in plan._packet_lens())


@pytest.mark.parametrize(
    ("overrides", "says"),
    [(["phy.name=direct"], "takes no airtime"), (["sim.robots=1", "ros_source.namespace=/robot_7"], "has nothing on")],
)
def test_what_cannot_be_planned(overrides: list[str], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        planner("paper-ofdm-paced", *overrides)
