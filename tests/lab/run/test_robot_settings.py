"""The robots that a scenario consists of, and the paths between them."""

from __future__ import annotations

from gr_ros2_lab.run.scenario import load_scenario


def test_who_only_sends_hears_nobody_and_who_only_receives_is_heard_by_nobody() -> None:
    robots = "robots=[{direction: send}, {direction: receive}, {direction: receive}]"
    first, *others = load_scenario("demo", [robots, "paths=[{to: 3, packet_loss: 0.5}]"]).all_robots
    assert first.config.sends and not first.takes
    assert [(path.receiver, path.channel.packet_loss) for path in first.paths] == [(1, 0.1), (2, 0.5)]
    assert [(other.config.sends, other.takes, other.paths) for other in others] == [(False, True, ())] * 2


def test_receivers_that_report_have_ways_back_of_their_own() -> None:
    robots = "robots=[{}, {topics: []}, {topics: []}]"
    scenario = load_scenario("demo", [robots, "paths=[{to: 1, delay_s: 0.5}]"])
    first, *others = scenario.all_robots
    assert not first.takes, "nobody sends it messages"
    assert [other.robot_id for other in others] == [2, 3]
    paths = [path for other in others for path in other.paths]
    assert [(path.receiver, path.delay_s, path.channel.packet_loss) for path in paths] == [(0, 0.5, 0.1)] * 2
    assert paths[0].channel.seed != paths[1].channel.seed


def test_robots_that_all_send_and_receive_are_on_one_graph_each() -> None:
    scenario = load_scenario("two-robots-half-duplex", ["robots=[{}, {}, {graph: {domain_id: 7}}]"])
    assert [robot.robot_id for robot in scenario.all_robots] == [1, 2, 3]
    assert [[path.receiver for path in robot.paths] for robot in scenario.all_robots] == [[1, 2], [0, 2], [0, 1]]
    assert [robot.config.graph.domain_id for robot in scenario.all_robots if robot.takes] == ["auto", "auto", 7]
    assert all(0 < robot.start_s < 1 for robot in scenario.all_robots)
    assert len({path.channel.seed for robot in scenario.all_robots for path in robot.paths}) == 6
