"""Runs one scenario on simulated time: no ROS graph, no waiting, and the same numbers each time.

Invariants: equal scenarios give equal results, except for ``wall_s``; with ``time: samples`` every packet goes through
the scenario's own transmitter, channel and receiver; with ``time: packets`` packets are lost with the probability that
was measured for them (:mod:`gr_ros2_lab.medium`); in both cases a packet arrives when its last sample has been on
the air. While nothing is sent there are no samples, as in a run in real time, so noise and fading do not advance.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gr_ros2.core.guard import Guard
from gr_ros2.observe.observers import RunObservers
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.run.delivered import DeliveredBag, bag_origin_ns
from gr_ros2_lab.run.load import make_phy, published_names, recording, source_names
from gr_ros2_lab.run.outcome import DELIVERED_BAG, Outcome, Progress, by_sender
from gr_ros2_lab.run.recorders import RunRecords
from gr_ros2_lab.run.robot_settings import senders_of
from gr_ros2_lab.run.robots import hearer_of
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.run.simulate import Simulation, pass_on
from gr_ros2_lab.run.task_run import TaskRun

_REPORT_S = 0.05
_CHECKED = 1000
"""Events after which the run looks whether what records it has failed."""

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
    senders = senders_of(scenario.all_robots)
    phy = make_phy(scenario, registry)
    with ExitStack() as stack:
        if bag is None and out is not None:
            origin_ns = bag_origin_ns(scenario, source_names(senders[0], registry))
            contents = recording(scenario)
            for line in contents.differences:
                _log.warning(line)
            bag = stack.enter_context(DeliveredBag(out / DELIVERED_BAG, origin_ns, definitions=contents.texts))
            for sender in senders:
                names = published_names(scenario, sender, registry)
                ids = source_names(sender, registry)
                bag.add_source(sender.robot_id, registry, {ids[name]: other for name, other in names.items()})
        task = TaskRun(scenario, registry) if scenario.task else None
        run = Simulation(scenario, registry, phy, task=task)
        run_observers = run_observers or RunObservers(threaded=False)
        records = RunRecords(
            scenario,
            registry,
            phy,
            run.around,
            run_observers=run_observers,
            task=task,
            on_delivery=None if bag is None else bag.take,
        )
        seen = [records.of(number) for number in range(len(run.robots))]
        clock = _EventClock()
        run_observers.run_started(records.live_run(clock))
        reported, progress = 0.0, Guard("progress")
        for number, timed_event in enumerate(run.events()):
            clock.now, robot, _ = timed_event
            pass_on(seen[robot.number], timed_event)
            if task is not None and task.over and clock.now < run.duration_s:
                run.end(clock.now)
            if not number % _CHECKED:  # every robot has a recorder
                records.check()
            if on_progress is not None and time.monotonic() > reported + _REPORT_S:
                reported = time.monotonic()
                progress(on_progress, Progress(clock.now, scenario.duration_s, *records.progress()))
        records.check()
    counted = [_counters(run, number, source_names(robot, registry)) for number, robot in enumerate(senders)]
    return records.outcome(
        begin=0.0,
        end=run.duration_s,
        played=run.duration_s,
        drained=run.empty,
        channels=1 if run.medium.shared else len(senders),
        began=began,
        incomplete=tuple(run_observers.incomplete()),
        counters={**by_sender(counted), "listener": {} if bag is None else dict(bag.written)},
    )


class _EventClock:
    """The run's clock, for observers."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def _counters(run: Simulation, number: int, names: Mapping[str, int]) -> dict[str, Any]:
    """What a robot that sends and the first that hears it counted. ``channel``: packets lost in the PHY, and packets
    dropped by each setting.

    :param number: of the robot that sends
    :param names: topic ids by name
    """
    receiver = hearer_of(run.around, number)
    sent, end = run.robots[number].endpoint.sent, run.robots[receiver].endpoint
    got = end.received
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
            "no_table": [peer.robot for peer in end.peers(run.duration_s) if peer.no_table],
        },
        "channel": {"phy": 0, **lost},
    }
