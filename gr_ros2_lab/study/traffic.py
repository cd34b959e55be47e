"""What a plan is about: a scenario, or a link with the messages of a recording or of the ROS graph as it is now.

Invariant: nothing is sent. A recording of the graph lies in a temporary folder and is removed afterwards.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.names import first
from gr_ros2.middleware import Middleware, Qos, TopicInfo, join
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.bag_files import bag_contents
from gr_ros2.radio.config import link_from
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.files import find_registry, read_settings, settled
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.topic_choice import TopicChoice
from gr_ros2_lab.run.replay import carrying
from gr_ros2_lab.run.scenario import SHARED, Scenario, scenario_from

_log = logging.getLogger(__name__)
_LOOK_S = 2.0
"""s for which the graph is asked what there is: discovery does not say when it is complete."""
_OF_THE_AIR = ("phy", "medium", "relay", "airtime", "channel")
"""What a link and a scenario have in common beside their robots."""
_DEFAULT = {
    "name": "link",
    "robot": 1,
    "graph": {"namespace": ""},
    "phy": {"name": "psk", "sample_rate": 1e6},
    "front_end": {"name": "sim"},
}


def link_values(path: Path | None, overrides: Sequence[str]) -> dict[str, Any] | None:
    """The settings of a link's YAML file, such as `gr-ros2 link --save` writes; None where the file is something else.

    :param path: None: a link of its default settings over ``psk`` at 1 MS/s, with every topic
    :raises ConfigError: when a setting is wrong
    """
    if path is None:
        return settled(_DEFAULT, Path(), overrides)
    if path.suffix not in (".yaml", ".yml") or not path.is_file():
        return None
    values = read_settings(path, overrides)
    return values if "front_end" in values else None


def of_recording(values: Mapping[str, Any], bag: Path, duration_s: float | None) -> tuple[Scenario, Registry]:
    """A link that sends a recording, to robots that report what they receive.

    :param values: see :func:`link_values`
    :param duration_s: s of the recording, 0 or None = all
    :raises ConfigError: when the recording has none of the link's topics, or a setting is wrong
    :raises BagError: when it cannot be read
    """
    link, contents = link_from(values), bag_contents(bag)
    for line in contents.remarks:
        _log.warning(line)
    chosen: list[str] = []
    robot = {name: values[name] for name in SHARED if name in values}
    air = {name: values[name] for name in _OF_THE_AIR if name in values}
    settings: dict[str, Any] = {"name": link.name, **robot, **air}
    settings["robots"] = [{"robot": link.robot}, {"robot": int(not link.robot_id), "topics": []}]
    if not link.registry:
        choice = TopicChoice(tuple(link.topics), link.namespace)
        chosen = [name for name in contents.topics if choice.row_name(name) is not None]
        if contents.topics and not chosen:
            raise ConfigError(
                f"{bag}: has nothing of {choice.everything or ', '.join(link.topics) or 'no topics'}; "
                f"it has {', '.join(first(contents.topics))}; set graph.namespace or topics"
            )
        settings["registry"] = find_registry("odom", Path())  # replaced by that of the recording
        settings["topics"] = [AUTO]
    settings |= {"source": f"bag:{bag}", "duration_s": duration_s or 0.0}
    return carrying(scenario_from(settings, link.name), contents, chosen)


@contextmanager
def recorded_graph(values: Mapping[str, Any], seconds: float) -> Iterator[Path]:
    """A recording of what is published now on the link's topics.

    :param values: see :func:`link_values`
    :param seconds: length of the recording, s
    :raises ConfigError: when nothing is published on them
    """
    link = link_from(values)
    choice = TopicChoice(tuple(link.topics), link.namespace)
    if link.registry:
        registry = Registry.from_csv(link.registry).chosen(tuple(link.topics))
        choice = TopicChoice([topic.on_graph(link.namespace) for topic in registry], "")
    with TemporaryDirectory(prefix="gr-ros2-") as folder, ExitStack() as stack:
        graph = stack.enter_context(join(link.graph, "gr_ros2_plan"))
        time.sleep(_LOOK_S)
        seen = [info for info in graph.discover() if info.publishers]
        wanted = [info for info in seen if choice.row_name(info.topic) is not None]
        bag = Path(folder) / "graph"
        received = _record(graph, wanted, bag, seconds)
        if not received:
            there = ", ".join(info.topic for info in seen) or "no topics"
            asked = ", ".join(info.topic for info in wanted) or "a topic of the link"
            raise ConfigError(f"nothing was published on {asked} within {seconds:g} s; seen on the graph: {there}")
        yield bag


def _record(graph: Middleware, wanted: Sequence[TopicInfo], bag: Path, seconds: float) -> int:
    with BagMiddleware(path=bag, mode="write") as recorder:
        received = 0

        def taking(info: TopicInfo) -> Any:
            publisher = recorder.advertise(info.topic, info.type_name, Qos())

            def take(payload: bytes) -> None:
                nonlocal received
                received += 1
                publisher.publish(payload)

            return take

        subscriptions = [
            graph.subscribe(info.topic, info.type_name, Qos("best_effort", None, 1000), taking(info)) for info in wanted
        ]
        time.sleep(seconds)
        for subscription in subscriptions:
            subscription.close()
    return received
