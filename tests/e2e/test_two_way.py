"""Both robots talk at once, on real DDS and real GNU Radio."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.report.page import read_runs, write_report
from gr_ros2_lab.run.runner import run_scenario
from tests.e2e.support import check_books, check_complete, delivered_bag, scenario


@pytest.mark.slow
@pytest.mark.real_time
def test_both_directions_deliver_everything_and_are_told_apart(tmp_path: Path) -> None:
    clean = [
        "topics=auto",
        "paths=[]",
        "phy.sample_rate=1e6",
        "topics=[odom, imu]",
    ]
    outcome = run_scenario(scenario("two-way", *clean, "robots.1.topics=[odom]", duration_s=2.0), tmp_path)
    result = outcome.result
    check_complete(result)
    names = {topic.topic: topic.src_id for topic in result.topics}
    assert names == {"/robot_1/odom": 1, "/robot_1/imu": 1, "/robot_2/odom": 2}
    for topic in result.topics:
        other = topic.topic.replace("/robot", "/rx_robot")
        assert len(delivered_bag(tmp_path, other)) == topic.delivered == result.counters["listener"][other]
    assert result.phy["channels"] == 2
    assert result.counters["source"]["packets"] + result.counters["back"]["source"]["packets"] == result.packets["sent"]
    write_report(read_runs([tmp_path]), tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert re.search(r"Air in use: the channel of robot 1 \d+%.*; the channel of robot 2 \d+%", page)


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("version", [0, 1])
def test_losses_of_one_direction_leave_the_other_alone(tmp_path: Path, version: int) -> None:
    lossy = [
        *([] if version else ["paper={}"]),
        "topics=auto",
        "phy.name=direct",
        "phy.options={}",
        "topics=[odom]",
        "paths=[{from: 2, to: 1, packet_loss: 0.3}]",
    ]
    result = run_scenario(scenario("two-way", *lossy, duration_s=2.0), tmp_path).result
    check_books(result)
    there, back = result.topics
    assert there.ledger == {"delivered": there.sent}, "nothing is even repaired"
    assert back.ledger["repaired"] > 0 if version else back.delivered < back.sent
    lost = result.counters["back"]["channel"]
    assert set(lost) <= {"burst_loss", "packet_loss"}
    under_way = result.packets["sent"] - result.packets["received"] - sum(lost.values())
    assert 0 <= under_way <= result.phy["channels"], "at most a report of each robot left as the run ended"
    assert result.counters["channel"] == {}


def test_a_sink_that_would_feed_the_source_beside_it_is_refused(tmp_path: Path) -> None:
    loop = scenario("two-way", "robots.0.publish.as=/robot_1", duration_s=1.0)
    with pytest.raises(ConfigError, match=r"loop: the sink publishes /robot_1/scan"):
        run_scenario(loop, tmp_path)
