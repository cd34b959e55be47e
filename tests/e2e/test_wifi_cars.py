"""Two cars that share occupancy grid and odometry over IEEE 802.11p frames, where gr-ieee802-11 is installed."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.study.forecast import Planner
from tests.e2e.support import check_complete, check_identical, delivered_bag, scenario


@pytest.mark.slow
def test_each_gets_the_grid_and_the_odometry_of_the_other(tmp_path: Path) -> None:
    pytest.importorskip("ieee802_11", reason="gr-ieee802-11 is not installed")
    cars = scenario("wifi-cars", "time=samples", duration_s=1.5)
    result = run_scenario(cars, tmp_path).result
    check_complete(result)
    assert {topic.topic for topic in result.topics} == {
        f"/robot_{number}/{name}" for number in (1, 2) for name in ("odom", "map")
    }
    for topic in result.topics:
        sent = [message.payload for message in Fleet(cars.sim).messages(1.5, topics={topic.topic})]
        check_identical(delivered_bag(tmp_path, topic.topic.replace("/robot", "/rx_robot")), sent)


def test_the_forecast_knows_its_airtime() -> None:
    pytest.importorskip("ieee802_11", reason="gr-ieee802-11 is not installed")
    forecast = Planner(load_scenario("wifi-cars", ["topics=[odom]"], duration_s=1.0)).forecast()
    # 36 bytes around a packet, 48 bits a symbol of 8 us, 40 us of preamble and header, a gap of 40 us.
    assert forecast.airtime_s == pytest.approx((40 + 8 * -(-(22 + 8 * (760 + 36)) // 48) + 40.1) * 1e-6)
    assert all(topic.result.pdr == 1.0 for topic in forecast.topics)
