from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2_lab.race.contenders import CONTENDERS
from gr_ros2_lab.race.measure import Identity, RaceSender, measure
from gr_ros2_lab.race.race_settings import RaceSettings, conditions, read_recordings
from gr_ros2_lab.race.slots import HOST_S, run_slots


def test_three_robots_in_slots_hear_everything_in_spite_of_losses(tmp_path: Path) -> None:
    settings = RaceSettings(robots=3, duration_s=2, loss=(0.05,), load=(2.0,), packet_len=96)
    recordings = read_recordings(settings, tmp_path)
    senders = [RaceSender(recording, Identity(recording)) for recording in recordings]
    (condition,) = conditions(settings, recordings)
    found = {}
    for name in ("gr-ros2", "gr-ros2-latest"):
        seen = run_slots(settings, senders, condition, CONTENDERS[name])
        found[name] = measure(seen, contender=name, load=2.0, loss=0.05, sample_rate=condition.sample_rate, robots=3)
        assert found[name].matched
        assert found[name].sent == 3 * 2 * 70
        assert found[name].altered == found[name].duplicates == 0
        assert found[name].latency_p50 > HOST_S
        assert found[name].drops["on_air"] > 0
        assert found[name].all_heard > 0.5  # robots listen before they enter
    assert found["gr-ros2"].pdr == 1
    assert 0.8 < found["gr-ros2-latest"].pdr < 1
    assert found["gr-ros2-latest"].latency_p99 < found["gr-ros2"].latency_p99
    again = run_slots(settings, senders, condition, CONTENDERS["gr-ros2"])
    assert measure(again, contender="", load=2.0, loss=0.05, sample_rate=0.0).age_mean == pytest.approx(
        found["gr-ros2"].age_mean
    )
