"""The adaptive rate in simulated time: the losses of each MCS, and scenarios from the settings to the result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import ReceiverEvent, SenderEvent, SentPacket
from gr_ros2.observe.observers import RunObservers
from gr_ros2.phy import PHY, Phy
from gr_ros2.phy.ofdm import RATES
from gr_ros2.settings.config import ChannelConfig
from gr_ros2.settings.files import find_registry
from gr_ros2_lab.medium import FixedPaths, RadioPath, make_medium
from gr_ros2_lab.medium.fading import RayleighFading
from gr_ros2_lab.medium.packets import PacketMedium, limits_of
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import Scenario, scenario_from
from gr_ros2_lab.run.simulate import simulate
from gr_ros2_lab.run.simulated_runner import run_simulated


class Rates:
    """Counts the packets with messages by their MCS."""

    name = "rates"
    instruments = False

    def __init__(self) -> None:
        self.sent: list[int] = []

    def run_started(self, _run: Any) -> None:
        pass

    def run_ended(self, _result: Any) -> None:
        pass

    def sender_event(self, _src_id: int, event: SenderEvent) -> None:
        if isinstance(event, SentPacket) and event.kind == "new":
            self.sent.append(event.mcs)

    def receiver_event(self, _event: ReceiverEvent, _now: float) -> None:
        pass


def adaptive(snr_db: float, **settings: Any) -> Scenario:
    """Odometry over `ofdm` with an adaptive rate and reports."""
    return scenario_from(
        {
            "name": "adaptive",
            "registry": find_registry("odom", Path()),
            "sim": {"odom_rate": 50},
            "time": "packets",
            "packet_len": 220,
            "robots": [{}, {"topics": []}],
            "phy": {"name": "ofdm", "sample_rate": 1e6, "options": {"rate": "adaptive"}},
            "channel": {"snr_db": snr_db},
            "paths": [{"from": 2, "delay_s": 0.005}],
            "duration_s": 2.0,
            **settings,
        }
    )


def adaptive_phy(**options: Any) -> Phy:
    phy: Phy = PHY.load("ofdm")(220, 1e6, rate="adaptive", **options)
    return phy


def test_each_rate_takes_less_air_and_needs_more_snr() -> None:
    phy = adaptive_phy()
    airtimes = [phy.airtime(220, mcs) for mcs in range(len(phy.mcs_table))]
    assert airtimes == [mcs.airtime_s for mcs in phy.mcs_table] == sorted(airtimes, reverse=True)
    assert [mcs.half_db for mcs in phy.mcs_table] == sorted(mcs.half_db for mcs in phy.mcs_table)
    assert phy.airtime() == airtimes[0]
    assert phy.airtime(24, 6) < phy.airtime(24, 0)


def arrived(phy: Phy, snr_db: float, mcs: int, packets: int) -> int:
    """How many of some packets arrive."""
    paths = [[RadioPath(1, ChannelConfig(snr_db=snr_db))], []]
    medium = PacketMedium(FixedPaths(paths), [phy, phy])
    for number in range(packets):
        medium.send(0, b"x", number, 0.5, mcs)
    count = len(list(medium.receptions(packets)))
    assert medium.lost[0, 1]["phy"] == packets - count
    return count


@pytest.mark.parametrize(("mcs", "name"), list(enumerate(RATES)))
def test_half_of_the_packets_of_a_rate_arrive_where_its_model_says(mcs: int, name: str) -> None:
    phy = adaptive_phy()
    model = phy.mcs_table[mcs]
    for snr_db in (model.half_db - 1.5, model.half_db - 0.5, model.half_db + 0.5, model.half_db + 2.5):
        pdr = arrived(phy, snr_db, mcs, 2000) / 2000
        assert pdr == pytest.approx(model.pdr(snr_db), abs=0.15), name
    low, high = limits_of(model)
    assert not arrived(phy, low - 0.1, mcs, 1)
    assert arrived(phy, high + 30, mcs, 1)


def test_packets_may_pass_through_the_modem_of_their_rate() -> None:
    phy = adaptive_phy()
    paths = [[RadioPath(1, ChannelConfig(snr_db=9.0))], []]
    medium = make_medium(FixedPaths(paths), [phy, phy], samples=True)
    for number, mcs in enumerate((0, 2, 5)):
        medium.send(0, bytes(220), number, phy.airtime(220, mcs), mcs)
    received = list(medium.receptions(3.0))
    assert [reception.sent.mcs for reception in received] == [0, 2]
    assert [reception.packet.snr_db for reception in received] == pytest.approx([9.0, 9.0], abs=3.0)


def test_fading_is_that_of_rayleigh_and_a_function_of_time() -> None:
    times = np.arange(0, 2000, 0.37)
    gains = np.array([RayleighFading(2.0, seed).gain_db(now) for seed in range(3) for now in times])
    powers = 10 ** (gains / 10)
    assert powers.mean() == pytest.approx(1.0, abs=0.05)
    for level in (0.05, 0.1, 0.5, 1.0):
        assert (powers < level).mean() == pytest.approx(1 - np.exp(-level), abs=0.03)
    one = RayleighFading(2.0, 1)
    assert one.gain_db(1.0) == RayleighFading(2.0, 1).gain_db(1.0) != RayleighFading(2.0, 2).gain_db(1.0)
    assert abs(one.gain_db(1.0) - one.gain_db(1.001)) < 1


@pytest.mark.parametrize(("snr_db", "mcs"), [(0.0, 0), (4.0, 1), (14.0, 4), (28.0, 6)])
def test_a_scenario_is_sent_at_the_rate_that_its_channel_allows(snr_db: float, mcs: int) -> None:
    rates = Rates()
    observers = RunObservers([rates], threaded=False)
    result = run_simulated(adaptive(snr_db), run_observers=observers).result
    assert result.topics[0].pdr == 1.0
    late = rates.sent[len(rates.sent) // 2 :]
    assert max(set(late), key=late.count) == mcs
    phy = adaptive_phy()
    assert result.phy["airtime_s"] == phy.airtime()
    assert result.phy["airtime_mean_s"] < phy.airtime()


def test_without_reports_everything_is_sent_at_the_most_robust_rate() -> None:
    rates = Rates()
    observers = RunObservers([rates], threaded=False)
    scenario = adaptive(28.0, robots=[{"direction": "send"}, {"direction": "receive"}], paths=[])
    result = run_simulated(scenario, run_observers=observers).result
    assert set(rates.sent) == {0}
    assert result.topics[0].pdr == 1.0


def test_what_an_adaptive_rate_cannot_have_is_said_in_a_line() -> None:
    for options in ({"payload_modulation": "qpsk"}, {"fec": "cc"}, {"detection_threshold": "stock"}):
        with pytest.raises(ConfigError, match="rate: adaptive"):
            adaptive_phy(**options)
    with pytest.raises(ConfigError, match="has one tap"):
        run_simulated(adaptive(9.0, channel={"snr_db": 9.0, "doppler_hz": 2.0, "taps": (1.0, 0.5)}))
    scenario = adaptive(9.0)
    with pytest.raises(ConfigError, match="a forecast has one rate"):
        simulate(scenario, phy=make_phy(scenario, scenario.load_registry()))
