"""How much a scenario offers to its link, and the sample rate that carries it.

Invariant: the offered load counts every message as if it used its packets alone, so it is never below the actual load
of the link.
"""

from __future__ import annotations

from pathlib import Path

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.names import first
from gr_ros2.middleware.bag_files import BagContents, bag_contents, read_bag
from gr_ros2.phy import PHY, Phy, configured
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.wire import Format
from gr_ros2_lab.run.robot_settings import senders_of
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.sim.fleet import Fleet

_SAMPLE_S = 2.0
"""Simulated seconds that are generated to find out message sizes. Sizes hardly vary."""


def make_phy(scenario: Scenario, registry: Registry) -> Phy:
    """The PHY of all robots, at its sample rate, or at ``headroom`` times what the robot needs that offers most.

    :raises ConfigError: for wrong PHY options, a channel that the PHY does not support, or when a robot offers nothing
    """
    chosen = scenario.phy.sample_rate
    rate = 0.0 if chosen == AUTO else chosen
    if not rate and PHY.load(scenario.phy.name).has_samples:
        at_1_hz = configured(scenario.phy, scenario.packet_len, 1.0)
        most = max(offered_packets(scenario, robot, registry) for robot in senders_of(scenario.all_robots))
        rate = scenario.phy.headroom * most * at_1_hz.airtime_samples()
    phy = configured(scenario.phy, scenario.packet_len, rate)
    check_channels(scenario, phy)
    return phy


def check_channels(scenario: Scenario, phy: Phy) -> None:
    """Refuse channels that a PHY does not support.

    :raises ConfigError: see :meth:`gr_ros2.phy.Phy.check_channel`
    """
    for channel in dict.fromkeys(path.channel for robot in scenario.all_robots for path in robot.paths):
        phy.check_channel(channel)


def offered_packets(scenario: Scenario, robot: RobotConfig, registry: Registry) -> float:
    """Packets/s that a robot needs if no packet carries more than one message.

    A recording counts with one message per second at least: at the average load of one with a message per hour, a
    packet would take the better part of an hour, and the last ones would never arrive.

    :raises ConfigError: when it offers nothing on the registered topics
    """
    by_sim = scenario.bag_path is None
    packets, seconds = _sim_load(scenario, robot, registry) if by_sim else _bag_load(scenario, registry)
    if packets == 0:
        raise ConfigError(f"{scenario.source}: nothing on the registered topics; set phy.sample_rate, or other topics")
    return packets / seconds


def source_names(robot: RobotConfig, registry: Registry) -> dict[str, int]:
    """Topic ids of the topics that a robot sends, by their absolute names."""
    return {topic.on_graph(robot.namespace): topic.topic_id for topic in registry.chosen(robot.words)}


def published_names(scenario: Scenario, robot: RobotConfig, registry: Registry) -> dict[str, str]:
    """Name of every topic of a robot where it comes out, by its name there. Of several that receive the first says
    it."""
    publish = next(other.config.publish for other in scenario.all_robots if other.takes and other.config is not robot)
    topics = registry.with_options(publish.topics, announced=True)
    return {
        name: topics[topic_id].republished(publish.as_, robot.robot_id)
        for name, topic_id in source_names(robot, registry).items()
    }


def recorded_names(scenario: Scenario, registry: Registry) -> dict[str, int]:
    """Those of :func:`source_names` that the scenario's recording has.

    :raises ConfigError: when the recording has none of them, or has one with another type or one that cannot be carried
    :raises BagError: when the recording cannot be read
    """
    names = source_names(scenario.first, registry)
    contents = recording(scenario)
    for name, topic_id in names.items():
        contents.check(name, registry[topic_id].type_name)
    found = {name: topic_id for name, topic_id in names.items() if name in contents.topics}
    if not found:
        has = "; ".join([", ".join(first(contents.topics)) or "no topics", *contents.remarks])
        raise ConfigError(f"{contents.path}: has none of {', '.join(names)}; it has {has}")
    return found


def recording(scenario: Scenario) -> BagContents:
    """What the scenario's recording contains; empty where the simulator is the source.

    :raises BagError: when the recording cannot be read
    """
    return BagContents(Path(), {}, {}, ()) if scenario.bag_path is None else bag_contents(scenario.bag_path)


def _sim_load(scenario: Scenario, robot: RobotConfig, registry: Registry) -> tuple[float, float]:
    names = source_names(robot, registry)
    duration = min(_SAMPLE_S, scenario.duration_s)
    messages = Fleet(scenario.sim).messages(duration, topics=names)
    sizes = {message.topic: len(message.payload) for message in messages}
    rates = Fleet(scenario.sim).rates()
    packets = 0.0
    for topic, size in sizes.items():
        rate = rates.get(topic.rsplit("/", 1)[-1], 0.0)
        alone = _packets_alone(size, scenario.packet_len, scenario.wire_format)
        packets += alone * (rate or 1 / scenario.duration_s)
    return packets, 1.0


def _bag_load(scenario: Scenario, registry: Registry) -> tuple[float, float]:
    assert scenario.bag_path is not None
    packets, messages = 0, 0
    begin = last = None
    for message in read_bag(scenario.bag_path, recorded_names(scenario, registry)):
        packets += _packets_alone(len(message.payload), scenario.packet_len, scenario.wire_format)
        messages += 1
        begin = message.stamp_ns if begin is None else begin
        last = message.stamp_ns
        if scenario.duration_s and (last - begin) * 1e-9 > scenario.duration_s * (scenario.bag_speed or 1):
            break
    seconds = ((last or 0) - (begin or 0)) * 1e-9 / (scenario.bag_speed or 1)
    return packets, min(seconds or 1.0, max(messages, 1))


def _packets_alone(size: int, packet_len: int, wire: Format) -> int:
    """Packets that a message of this size needs if it shares none; 0 for a message too large for the link."""
    return max(-(-size // wire.single_entry_payload(packet_len)), 1) if size <= wire.largest_message(packet_len) else 0
