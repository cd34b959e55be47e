"""The robots that a scenario consists of: short forms, and robots that all send and receive."""

from __future__ import annotations

from gr_ros2_lab.run.scenario import load_scenario


def test_a_one_way_scenario_is_a_robot_that_sends_and_those_that_receive() -> None:
    demo = load_scenario("demo")
    first, *others = load_scenario("demo", ["reports=null", "receivers=[{packet_loss: 0.5}]"]).all_robots
    assert first.source == demo.ros_source
    assert first.sink is None
    assert [(path.receiver, path.channel.packet_loss) for path in first.paths] == [(1, 0.1), (2, 0.5)]
    assert [(other.source, other.sink, other.paths) for other in others] == [(None, demo.ros_sink, ())] * 2


def test_receivers_that_report_have_ids_and_ways_back_of_their_own() -> None:
    scenario = load_scenario("demo", ["reports={delay_s: 0.5, channel: {packet_loss: 0.1}}", "receivers=[{}]"])
    _, *others = scenario.all_robots
    assert [other.robot_id for other in others] == [254, 253]
    paths = [path for other in others for path in other.paths]
    assert [(path.receiver, path.delay_s, path.channel.packet_loss) for path in paths] == [(0, 0.5, 0.1)] * 2
    assert paths[0].channel.seed != paths[1].channel.seed


def test_robots_that_all_send_and_receive_are_on_one_graph_each() -> None:
    scenario = load_scenario("two-robots-half-duplex", ["robots=[{}, {}, {ros_source: {domain_id: 7}}]"])
    assert [robot.robot_id for robot in scenario.all_robots] == [1, 2, 3]
    assert [[path.receiver for path in robot.paths] for robot in scenario.all_robots] == [[1, 2], [0, 2], [0, 1]]
    assert [robot.sink.domain_id for robot in scenario.all_robots if robot.sink is not None] == ["auto", "auto", 7]
    assert all(0 < robot.start_s < 1 for robot in scenario.all_robots)
    assert len({path.channel.seed for robot in scenario.all_robots for path in robot.paths}) == 6
