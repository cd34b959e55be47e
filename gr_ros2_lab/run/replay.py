"""Sends a recording through a simulated link and channel, and writes what arrives as a second recording.

Invariants: no ROS, no radio and no waiting; equal recordings and scenarios give equal messages and times; names, types,
type definitions, the QoS of every publisher and payloads (including header stamps) are those of the original, in their
canonical form where they are compressed; a topic that a link cannot carry is left out and reported; the file appears
whole or not at all.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from gr_ros2.core.errors import BagError, ConfigError
from gr_ros2.core.names import first
from gr_ros2.middleware.bag_files import BagContents, RecordedTopic, bag_contents
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, options_of
from gr_ros2.settings.robot import PublishOptions
from gr_ros2_lab.run.delivered import DeliveredBag, bag_origin_ns
from gr_ros2_lab.run.load import source_names
from gr_ros2_lab.run.outcome import Outcome
from gr_ros2_lab.run.robot_settings import ScenarioRobot
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.run.simulated_runner import run_simulated

_STORAGES: dict[str, Literal["mcap", "sqlite3"]] = {".mcap": "mcap", ".db3": "sqlite3"}
"""Storage of a single bag file, by its suffix. A path with any other suffix is a bag folder."""


@dataclass(frozen=True)
class Replayed:
    """What a replay did.

    :param carried, left_out: topics of the original, by absolute name
    :param remarks: one line each: why a topic could not be carried, and where the counts in the original's metadata
        differ from its messages
    """

    outcome: Outcome
    carried: tuple[str, ...]
    left_out: tuple[str, ...]
    remarks: tuple[str, ...] = ()


def replay(
    source: Path,
    target: Path,
    scenario: Scenario,
    topics: Sequence[str] = (),
) -> Replayed:
    """Send a recording through a scenario's link and record what comes out.

    The scenario's registry says which topics are carried. The registry is made from the recording instead if it has
    no topic of the recording, or if ``topics`` is given.

    :param source: bag folder, ``.mcap`` or ``.db3`` file
    :param target: ``.mcap`` or ``.db3`` file, otherwise a bag folder (MCAP); must not exist
    :param scenario: its own source is ignored; ``time`` real becomes samples
    :param topics: absolute names; () = as the registry says
    :raises BagError: when ``source`` cannot be read, or ``target`` exists or cannot be written
    :raises ConfigError: for a topic that the recording does not have or a link cannot carry, for too many topics, or
        for a wrong scenario
    """
    if target.exists():
        raise BagError(f"{target}: exists already; choose another name or remove it")
    contents = bag_contents(source)
    recorded = contents.topics
    scenario, registry = carrying(
        replace(scenario, time=scenario.time if scenario.simulated else "samples"), contents, topics
    )
    names = source_names(scenario.first, registry)
    src_id = scenario.first.robot_id
    with _bag_at(target, bag_origin_ns(scenario, names)) as bag:
        bag.copy_source(src_id, {topic_id: recorded[name] for name, topic_id in names.items()})
        outcome = run_simulated(scenario, None, registry=registry, bag=bag)
    left_out = sorted({*recorded, *contents.left_out} - set(names))
    return Replayed(outcome, tuple(names), tuple(left_out), tuple(contents.remarks))


def carrying(scenario: Scenario, contents: BagContents, topics: Sequence[str]) -> tuple[Scenario, Registry]:
    """The scenario with a recording as its source, and the registry of what it carries, see :func:`replay`.

    :raises ConfigError: see :func:`replay`
    """
    scenario = replace(scenario, source=f"bag:{contents.path}", bag_speed=1.0)
    registry = scenario.load_registry()
    names = {
        name: topic_id for name, topic_id in source_names(scenario.first, registry).items() if name in contents.topics
    }
    if topics or not names:
        scenario, registry = _made_for(scenario, registry, contents, topics)
        names = source_names(scenario.first, registry)
    else:
        carried = {registry[topic_id].name for topic_id in names.values()}
        left = {f"-{topic.name}": SendOptions() for topic in registry if topic.name not in carried}
        scenario = _sending(scenario, lambda robot: {**robot.topics, **left})
    _check_types(names, registry, contents.topics, contents.path)
    return scenario, registry


def _made_for(
    scenario: Scenario, registry: Registry, contents: BagContents, topics: Sequence[str]
) -> tuple[Scenario, Registry]:
    """The scenario with a registry made from the recording. Options of topics that are in both are kept."""
    source, recorded = contents.path, contents.topics
    for name in topics:
        if name in contents.left_out:
            raise ConfigError(
                f"topics = {name!r}: {source} has it, and it cannot be carried: {contents.left_out[name]}"
            )
        if name not in recorded:
            raise ConfigError(f"topics = {name!r}: {source} has {', '.join(first(recorded)) or 'no topics'}")
    rows = {name: recorded[name].info.type_name for name in topics or contents.some()}
    most = scenario.wire_format.max_topics
    if len(rows) > most:
        raise ConfigError(
            f"{source}: has {len(rows)} topics, and a link carries {most}; choose with --topics from "
            f"{', '.join(first(recorded))}"
        )
    names = {name: registry[topic_id].name for name, topic_id in source_names(scenario.first, registry).items()}
    kept = {name: row for name, row in names.items() if name in rows}
    publish = scenario.robots[-1].publish
    taken = {name: options_of(row, publish.topics, PublishOptions()) for name, row in kept.items()}
    scenario = _sending(
        scenario,
        lambda robot: {name: options_of(kept.get(name, ""), robot.topics, SendOptions()) for name in rows},
    )
    robots = [replace(robot, publish=replace(robot.publish, topics=taken)) for robot in scenario.robots]
    return replace(scenario, robots=tuple(robots)), Registry.from_rows(rows)


def _sending(scenario: Scenario, topics: Callable[[ScenarioRobot], dict[str, SendOptions]]) -> Scenario:
    """The scenario with another choice of topics of the robot that sends."""
    first, *others = scenario.robots
    return replace(scenario, robots=(replace(first, topics=topics(first)), *others))


def _check_types(
    names: Mapping[str, int], registry: Registry, recorded: Mapping[str, RecordedTopic], source: Path
) -> None:
    for name, topic_id in names.items():
        if (type_name := recorded[name].info.type_name) != registry[topic_id].type_name:
            raise ConfigError(
                f"{source}: {name} is {type_name}, in the registry {registry[topic_id].type_name}; "
                "choose with --topics, which takes the recording's"
            )


@contextmanager
def _bag_at(target: Path, origin_ns: int) -> Iterator[DeliveredBag]:
    """A bag that is at ``target`` when the block ends without an error. After an error no bag is left."""
    storage = _STORAGES.get(target.suffix)
    folder = target if storage is None else target.with_name(f".{target.name}.part")
    if folder != target:
        shutil.rmtree(folder, ignore_errors=True)
    with DeliveredBag(folder, origin_ns, storage or "mcap") as bag:
        yield bag
    if storage is not None:
        next(folder.glob(f"*{target.suffix}")).replace(target)
        shutil.rmtree(folder)
