"""One scenario several times, with other seeds each time. In repetition k (from 0) every seed is k higher."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from gr_ros2.run.scenario import Scenario
from gr_ros2.settings.config import ScenarioChannel, replaced


def repetitions(scenario: Scenario) -> Iterator[Scenario]:
    """The scenario once per repetition, each with its own seeds."""
    for k in range(scenario.repetitions):
        yield replace(_reseeded(scenario, k), repetitions=1)


def _reseeded(scenario: Scenario, k: int) -> Scenario:
    """The same scenario with every seed higher by ``k``."""
    sim, channel = replaced(scenario.sim, seed=scenario.sim.seed + k), _reseeded_channel(scenario.channel, k)
    back = scenario.back and replace(scenario.back, channel=_reseeded_channel(scenario.back.channel, k))
    reports = scenario.reports and replace(scenario.reports, channel=_reseeded_channel(scenario.reports.channel, k))
    receivers = tuple(_reseeded_channel(other, k) for other in scenario.receivers)
    seed = scenario.seed + k
    return replace(scenario, seed=seed, sim=sim, channel=channel, back=back, reports=reports, receivers=receivers)


def _reseeded_channel(channel: ScenarioChannel, k: int) -> ScenarioChannel:
    return replaced(channel, seed=channel.seed + k)
