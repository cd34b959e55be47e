"""Robots in real time: a ROS graph for each, and between them one channel or one of its own for each."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Middleware, Qos, join_graph
from gr_ros2.middleware.bag_files import bag_contents
from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.result import Result, read_result
from gr_ros2_lab.record.team import read_team
from gr_ros2_lab.run.outcome import DELIVERED_BAG, Outcome, Progress
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario

LIVE = ["time=real", "robots=3", "duration_s=4"]


class Controller:
    """A program on the graph of a robot, which joins as soon as the run names its domain.

    :ivar heard: messages of another robot
    """

    def __init__(self, place: int, topic: str) -> None:
        self._place, self._topic = place, topic
        self._graph: Middleware | None = None
        self.heard: list[bytes] = []
        self.graphs: tuple[tuple[str, int | None], ...] = ()

    def __call__(self, progress: Progress) -> None:
        if self._graph is None:
            self.graphs = progress.graphs
            domain = progress.graphs[self._place][1]
            assert domain is not None
            self._graph = join_graph("dds", domain_id=domain, node_name="controller", localhost_only=True)
            self._graph.subscribe(self._topic, "nav_msgs/msg/Odometry", Qos("reliable", None, 0), self.heard.append)

    def close(self) -> None:
        assert self._graph is not None
        self._graph.close()


@pytest.mark.slow
@pytest.mark.real_time
def test_each_robot_has_a_link_and_a_graph_on_which_a_program_hears_the_others(tmp_path: Path) -> None:
    controller = Controller(1, "/rx_robot_3/odom")
    run_scenario(load_scenario("team", LIVE), tmp_path, controller)
    controller.close()
    assert len({domain for _, domain in controller.graphs}) == len(controller.graphs) == 3
    assert controller.heard
    result = read_result(tmp_path)
    heard = _tables(result)
    assert [len(topics) for topics in heard] == [2, 2, 2]
    assert min(topic.delivered for topics in heard for topic in topics) >= 0.9 * 40
    assert result.counters["medium"]["bursts"] >= result.packets["sent"]
    team = read_team(tmp_path)
    assert team is not None
    assert set(team.ways) == {1, 2, 3}
    assert all(team.beliefs.values())
    assert set(bag_contents(tmp_path / DELIVERED_BAG).topics) == {"/rx_robot_2/odom", "/rx_robot_3/odom"}


@pytest.mark.slow
@pytest.mark.real_time
def test_robots_that_drive_begin_to_do_so_with_the_run(tmp_path: Path) -> None:
    """Both clocks are the medium's, on which the robots are where the simulator says."""

    def snr_db(outcome: Outcome) -> float:
        outcome.team.write(tmp_path)  # type: ignore[union-attr]
        team = read_team(tmp_path)
        assert team is not None
        return sum(sum(snr for _, snr in snrs) / len(snrs) for snrs in team.snr_db.values()) / len(team.snr_db)

    driving = ["robots=2", "duration_s=4", "channel.walls_db=0", "channel.tx_power_dbm=10"]
    live = run_scenario(load_scenario("demo-team", [*driving, "time=real"]))
    simulated = run_scenario(load_scenario("demo-team", driving))
    assert snr_db(live) == pytest.approx(snr_db(simulated), abs=2.0)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["phy={name: modem, options: {bit_rate: 1e5}}"], "phy modem has no samples"),
        (["own_domains=false"], "what robot 1 sends comes out twice on one ROS graph"),
        (["own_domains=false", "duplex=full", "medium=exclusive"], "what robot 1 sends comes out twice"),
    ],
)
def test_what_no_robot_in_real_time_has_is_refused_in_a_line(overrides: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)) as refused:
        load_scenario("team", ["time=real", *overrides])
    assert "\n" not in str(refused.value)


@pytest.mark.slow
@pytest.mark.real_time
def test_robots_on_channels_of_their_own_hear_whom_they_can_and_send_meanwhile(tmp_path: Path) -> None:
    gains = "[[null, -90, null], [-90, null, -90], [null, -90, null]]"
    own = ["duplex=full", "medium=exclusive", "duration_s=2", f"gains_db={gains}"]
    run_scenario(load_scenario("team", [*LIVE, *own]), tmp_path)
    result = read_result(tmp_path)
    heard = [{topic.src_id for topic in topics} for topics in _tables(result)]
    assert heard == [{2}, {1, 3}, {2}]
    assert min(topic.delivered for topics in _tables(result) for topic in topics) >= 0.9 * 20
    assert result.phy["channels"] == 3
    assert result.counters["medium"]["bursts"] >= result.packets["sent"]
    assert len(result.counters["robots"]) == 2


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize(
    ("overrides", "arrives"),
    [
        (["duplex=full", "medium=exclusive", "paper={}", "phy.options.detection_threshold=stock"], False),
        (["duplex=full", "medium=exclusive", "phy={name: direct}", "gains_db=null"], True),
        (["paths=[{from: 1, delay_s: 0.02}]"], True),
    ],
    ids=["version 0, stock receiver", "version 1, no radio", "version 1, one channel"],
)
def test_what_channels_lose_between_robots_in_real_time_is_repaired_by_version_1(
    tmp_path: Path, overrides: list[str], arrives: bool
) -> None:
    """A computer that is too slow has time to receive all of it. Robots with version 1 go on reporting: some of that is
    still on its way when the run ends."""
    lossy = ["robots=2", "duration_s=1", "drain_s=60", "channel.packet_loss=0.2"]
    run_scenario(load_scenario("team", [*LIVE, *lossy, *overrides]), tmp_path)
    result = read_result(tmp_path)
    lost = sum(counted["channel"]["packet_loss"] for counted in (result.counters, result.counters["back"]))
    assert lost > 0
    ended = result.packets["received"] + lost
    assert ended <= result.packets["sent"] if arrives else ended == result.packets["sent"]
    assert all(sum(topic.ledger.values()) == topic.sent == 10 for topic in result.topics)
    assert all(topic.delivered == topic.sent for topic in result.topics) == arrives


@pytest.mark.slow
@pytest.mark.real_time
def test_where_robots_are_decides_who_hears_them_on_channels_of_their_own_too(tmp_path: Path) -> None:
    """Robot 1 is too quiet for anybody."""
    placed = ["gains_db=null", "channel={from: positions}", "robots=[{tx_power_dbm: -150}, {}, {}]"]
    run_scenario(load_scenario("team", [*LIVE, *placed, "duplex=full", "medium=exclusive", "duration_s=2"]), tmp_path)
    tables = _tables(read_result(tmp_path))
    assert {topic.src_id: topic.delivered > 0 for topics in tables for topic in topics} == {1: False, 2: True, 3: True}


def _tables(result: Result) -> list[tuple[TopicResult, ...]]:
    return [result.topics, *(receiver.topics for receiver in result.receivers)]
