"""Runs one scenario on simulated time: no ROS graph, no waiting, and the same numbers each time.

Invariants: equal scenarios give equal results, except for ``wall_s``; with ``time: samples`` every packet goes through
the scenario's own transmitter, channel and receiver; with ``time: packets`` packets are lost with the probability that
was measured for them (:mod:`gr_ros2.medium`); in both cases a packet arrives when its last sample has been on
the air. While nothing is sent there are no samples, as in a run in real time, so noise and fading do not advance.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from gr_ros2.core.guard import Guard
from gr_ros2.link import Delivered, ReceiverEvent
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.record.recorder import Recorder
from gr_ros2.record.result import Result
from gr_ros2.record.team import TeamRecord
from gr_ros2.run.delivered import DeliveredBag, bag_origin_ns
from gr_ros2.run.load import make_phys, recording, source_names
from gr_ros2.run.observers import LiveRun, RunObservers
from gr_ros2.run.outcome import DELIVERED_BAG, Outcome, Progress, phy_numbers
from gr_ros2.run.recorders import Ear, FurtherRecorders, make_recorder, make_team
from gr_ros2.run.robots import ears_of, recorder_of
from gr_ros2.run.scenario import Scenario, dump
from gr_ros2.run.simulate import Simulation, TimedEvent, pass_on
from gr_ros2.run.task_run import TaskRun
from gr_ros2.settings.registry import Registry

_REPORT_S = 0.05

_log = logging.getLogger(__name__)


def run_simulated(
    scenario: Scenario,
    out: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    run_observers: RunObservers | None = None,
    *,
    registry: Registry | None = None,
    bag: DeliveredBag | None = None,
) -> Outcome:
    """Run a scenario with ``time`` samples or packets to its end.

    :param out: folder for the bag of delivered messages, made if missing; None writes none
    :param on_progress: called about 20 times a second
    :param run_observers: receive all events; there is no flowgraph that they could change
    :param registry: None takes the scenario's
    :param bag: receives the delivered messages instead of a bag in ``out``
    :raises ConfigError: when the scenario cannot be set up
    :raises RunError: when it fails while it runs
    """
    began = time.monotonic()
    registry = registry or scenario.load_registry()
    ways = scenario.directions()
    phys = make_phys(ways, registry)
    with ExitStack() as stack:
        if bag is None and out is not None:
            origin_ns = bag_origin_ns(scenario, source_names(scenario, registry))
            source = recording(scenario)
            for line in source.differences:
                _log.warning(line)
            bag = stack.enter_context(DeliveredBag(out / DELIVERED_BAG, origin_ns, definitions=source.texts))
            for way in ways:
                ids, names = source_names(way, registry).values(), _published_as(way, registry).values()
                bag.add_source(way.ros_source.src_id(), registry, dict(zip(ids, names, strict=True)))
        tasks = TaskRun(scenario, ways, registry) if scenario.task else None
        run = Simulation(scenario, registry, phys, messages=None if tasks is None else tasks.messages())
        ears = ears_of(scenario, run.around)
        heard = [ways[number] for number in ears[0]]
        recorder = make_recorder(registry, heard, None if bag is None else bag.take)
        called = [robot.ros_source.namespace for robot in scenario.robots] if len(ears) == len(ways) else None
        further = FurtherRecorders(registry, ways, ears[1:], called and called[1:])
        run_observers = run_observers or RunObservers(threaded=False)
        link_observers = Observers[LinkObserver]()
        own = recorder if len(ways) < 3 else Ear(recorder, [way.ros_source.src_id() for way in heard])
        recorded = link_observers.add(own, needed=True)
        link_observers.add(further)
        link_observers.add(run_observers)
        clock = _EventClock()
        team = make_team(registry, ways, phys[0])
        run_observers.run_started(_live_run(scenario, registry, recorder, clock, team))
        reported, progress = 0.0, Guard("progress")
        for timed_event in run.events():
            clock.now, robot, event = timed_event
            number = recorder_of(scenario, robot.number) if isinstance(event, ReceiverEvent) else 0
            if tasks is not None and isinstance(event, Delivered):
                tasks.delivered(robot.number, event, clock.now)
            pass_on(further.at(number) if number else link_observers, timed_event)
            if team is not None:
                _follow(team, timed_event)
            recorded.check()
            further.check()
            if on_progress is not None and time.monotonic() > reported + _REPORT_S:
                reported = time.monotonic()
                progress(on_progress, Progress(clock.now, scenario.duration_s, *recorder.progress()))
        recorded.check()
        further.check()
    played = run.duration_s
    topics = recorder.finish(played, played, run.empty)
    there, *others = (_counters(run, number, source_names(way, registry)) for number, way in enumerate(ways))
    back = {"back": others[0]} if len(others) == 1 else {"robots": others} if others else {}
    numbers = partial(phy_numbers, phys[0], 1 if run.medium.shared else len(ways))
    result = Result(
        scenario=scenario.name,
        seed=scenario.seed,
        duration_s=played,
        config=dump(scenario),
        topics=topics,
        receivers=further.finish(played, played, run.empty, numbers),
        packets=recorder.ledger.packets(),
        phy=numbers(recorder),
        wall_s=time.monotonic() - began,
        incomplete=tuple(run_observers.incomplete()),
        task={} if tasks is None else tasks.numbers(),
        counters={**there, **back, "listener": {} if bag is None else dict(bag.written)},
    )
    published_as = {name: other for way in ways for name, other in _published_as(way, registry).items()}
    return Outcome(result, recorder.trace(0.0, played, published_as), team)


def _follow(team: TeamRecord, timed_event: TimedEvent) -> None:
    now, robot, event = timed_event
    if isinstance(event, ReceiverEvent):
        team.receiver_event(robot.src_id, event, now)
    else:
        team.sender_event(robot.src_id, event)


class _EventClock:
    """The run's clock, for observers."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def _counters(run: Simulation, number: int, names: Mapping[str, int]) -> dict[str, Any]:
    """What each part of one direction counted. ``channel``: packets lost in the PHY, and packets dropped by each
    setting.

    :param number: of the robot that sends
    :param names: topic ids by name
    """
    receiver = next(iter(run.around.reached(number)), number)
    sent, got = run.robots[number].endpoint.sent, run.robots[receiver].endpoint.received
    lost = run.medium.lost[number, receiver]
    return {
        "source": {
            "packets": sent.packets,
            "entries": sent.entries,
            "payload_bytes": sent.payload_bytes,
            "repeats": sent.repeats,
            "topics": {
                name: {
                    "submitted": sent.submitted[topic_id],
                    "sent": sent.sent[topic_id],
                    "refused": {reason: count for (key, reason), count in sent.refused.items() if key == topic_id},
                }
                for name, topic_id in names.items()
            },
        },
        "sink": {
            "packets": got.packets,
            "rejected": dict(got.rejected),
            "dropped": dict(got.dropped),
            "repeats": got.repeats,
            "packet_loss_est": got.packet_loss_est,
            "message_loss_est": got.message_loss_est,
        },
        "channel": {"phy": 0, **lost},
    }


def _published_as(way: Scenario, registry: Registry) -> dict[str, str]:
    """Name of every topic at the sink, by its name at the source."""
    format_, src_id = way.ros_sink.namespace_format, way.ros_source.src_id()
    rows = registry.with_options(way.ros_sink.topic_options)
    return {name: rows[topic_id].republished(format_, src_id) for name, topic_id in source_names(way, registry).items()}


def _live_run(
    scenario: Scenario, registry: Registry, recorder: Recorder, clock: Callable[[], float], team: TeamRecord | None
) -> LiveRun:
    topics = {
        (way.ros_source.src_id(), topic_id): name
        for way in scenario.directions()
        for name, topic_id in source_names(way, registry).items()
    }
    return LiveRun(
        name=scenario.name,
        duration_s=scenario.duration_s,
        packet_len=scenario.packet_len,
        registry=registry,
        topics=topics,
        sources={},
        links=(),
        ledger=recorder.ledger,
        clock=clock,
        team=team,
    )
