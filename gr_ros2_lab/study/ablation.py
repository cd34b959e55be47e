"""Ablation: measures the effect of each part of a link. A scenario runs as it is, and then without one part at a time.

Invariants: a variant differs from the scenario in the settings of one part and in nothing else, so the messages and the
radio are the same; a part that is off in the scenario has no variant; the settings are those that `--set` takes, so any
variant can be run by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.queues import queue_for
from gr_ros2.settings.config import CloudOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.robot import RobotConfig
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.report.page import Run, read_runs
from gr_ros2_lab.report.table import Grid, milliseconds, number, whose_view
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import Scenario, load_scenario

WHOLE = "whole"
"""Name of the unchanged scenario, for its folder and in tables."""


@dataclass(frozen=True)
class Variant:
    """The scenario with one part switched off.

    :param name: folder, and name in tables
    :param settings: `key=value`, as `--set` takes them
    """

    name: str
    settings: tuple[str, ...] = ()


def variants(scenario: Scenario) -> list[Variant]:
    """The scenario itself, and then one variant without each part that it uses.

    :raises ConfigError: for a scenario in which all of these parts are off
    """
    robot, of_link = scenario.first, scenario.paper is None
    found = [Variant(WHOLE)]
    if scenario.compresses:
        details = []
        for name, options in robot.topics.items():
            details += [f"topics.{name}.codec=auto"] * (options.codec != AUTO)
            details += [f"topics.{name}.quantize=''"] * bool(options.quantize)
            details += [f"topics.{name}.cloud={{}}"] * (options.cloud != CloudOptions())
        where = "" if scenario.paper is None else "paper."
        found.append(Variant("no-compression", (f"{where}compression=false", *details)))
    if robot.packet_rate != 0:
        found.append(Variant("no-pull", ("packet_rate=0",)))
    if of_link and robot.repair != "off":
        expected = RobotConfig.expected_loss
        details = [f"expected_loss={expected}"] * (robot.expected_loss != expected)
        found.append(Variant("no-repair", ("repair='off'", *details)))
    silent = [number for number, one in enumerate(scenario.robots) if not one.sends and one.direction == "both"]
    if silent:
        found.append(Variant("no-reports", tuple(f"robots.{number}.direction=receive" for number in silent)))
    registry = scenario.load_registry().with_options(robot.options)
    latest = [topic.name for topic in registry if of_link and queue_for(topic.options)[0] == "latest"]
    if latest:
        found.append(Variant("no-latest", tuple(f"topics.{name}.queue=fifo" for name in latest)))
    if len(found) == 1:
        raise ConfigError(
            f"scenario {scenario.name}: nothing to switch off; it has no compression, pull, repair, reports or queue "
            "latest"
        )
    return found


def run_variants(
    name: str,
    out: Path,
    overrides: Sequence[str] = (),
    on_run: Callable[[Variant], None] = lambda _: None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
) -> list[Run]:
    """Run a scenario and its variants one after the other, each into its own folder.

    :param name: as `load_scenario` takes it, likewise ``overrides``, ``seed`` and ``duration_s``
    :param out: folder in which each run has its folder
    :param on_run: called before each run
    :raises ConfigError: when a scenario cannot be set up, has nothing to switch off, or asks for repetitions
    :raises RunError: when a run fails
    :raises KeyboardInterrupt: when a run is interrupted; the results of earlier runs are kept
    """
    whole = load_scenario(name, overrides, seed=seed, duration_s=duration_s)
    if whole.repetitions > 1:
        raise ConfigError(f"repetitions = {whole.repetitions}: each part is off once; set 1, or write a sweep")
    chosen = variants(whole)
    for variant in chosen:
        on_run(variant)
        settings = [*overrides, *variant.settings]
        scenario = load_scenario(name, settings, seed=seed, duration_s=duration_s)
        if run_scenario(scenario, out / variant.name).result.interrupted:
            raise KeyboardInterrupt
    return [replace(run, label=run.directory.name) for run in read_runs([out / variant.name for variant in chosen])]


def worth_grid(runs: Sequence[Run]) -> Grid:
    """Delivery and age of each topic, with a column per run. The last line is the number of bytes on the air per
    message."""
    sections = []
    for index, topic in enumerate(runs[0].result.topics):
        found = [(run.result, run.result.topics[index]) for run in runs]
        lines = {
            "messages/s": [f"{one.delivered / result.duration_s:.2f}" for result, one in found],
            "PDR": [number(one.pdr, "{:.2f}") for _, one in found],
            "mean age [ms]": [milliseconds(one.age_s.mean) for _, one in found],
            "latency p99 [ms]": [milliseconds(one.latency_s.p99) for _, one in found],
        }
        sections.append(tuple((topic.topic, what, *values) for what, values in lines.items()))
    cost = tuple(number(air_bytes(run.result), "{:.0f}") for run in runs)
    sections.append((("link", "air bytes per message", *cost),))
    headings = ("Topic", "Number", *(run.label for run in runs))
    title = ", ".join(filter(None, ("What each part is worth", whose_view(runs[0].result))))
    return Grid(title, headings, tuple(sections), texts=2)


def air_bytes(result: Result) -> float | None:
    """Bytes of all packets sent, PAD and headers included, per message delivered; None if none was."""
    found: float | None = result.phy.get("bytes_per_message")
    return found
