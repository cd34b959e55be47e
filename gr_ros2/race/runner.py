"""Runs the race, one cell after another. A cell is one contender under one condition, in new processes.

Invariants: nothing of a cell remains after it, even after an error: its processes end, and its namespaces and
interfaces are removed. The cells measured before Ctrl-C or a failure are kept.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from gr_ros2.core.errors import RunError
from gr_ros2.race.contenders import Contender, chosen
from gr_ros2.race.endpoints import RacePublisher, RaceSubscriber, RaceTopic
from gr_ros2.race.links import LinkReport, RaceIpLink, RaceRadio, RaceRosLink
from gr_ros2.race.measure import Identity, Observed, RaceCell, measure
from gr_ros2.race.namespaces import Namespace, check_means
from gr_ros2.race.race_settings import (
    PHY_NAME,
    Condition,
    RaceRecording,
    RaceSettings,
    check,
    conditions,
    read_recording,
)
from gr_ros2.race.workers import Worker

_POLL_S = 0.05
_QUIET_S = 3.0
"""s. When no message has arrived for this time, no more are expected."""
_PLAY_SLACK_S = 30.0


@dataclass
class Race:
    """A race and its results.

    :param interrupted: Ctrl-C ended it before all cells were run
    :param error: the error that ended it, None without one
    """

    settings: RaceSettings
    recording: RaceRecording
    cells: list[RaceCell] = field(default_factory=list)
    interrupted: bool = False
    error: RunError | None = None


def run_race(settings: RaceSettings, on_cell: Callable[[int, int, str], None] | None = None) -> Race:
    """Run all cells, or until KeyboardInterrupt.

    :param on_cell: called before each cell with its number from 0, the number of cells, and a description of the cell
    :raises ConfigError: when the race cannot be set up
    :raises RunError: without root
    """
    check(settings)
    check_means()
    with tempfile.TemporaryDirectory(prefix="gr-ros2-race-") as folder:
        recording = read_recording(settings, Path(folder))
        identity = Identity(recording)
        race = Race(settings, recording)
        plan = [
            (condition, name, contender)
            for condition in conditions(settings, recording)
            for name, contender in chosen(settings.peers).items()
        ]
        try:
            for number, (condition, name, contender) in enumerate(plan):
                if on_cell is not None:
                    on_cell(number, len(plan), f"{name}, load {condition.load:.0%}, loss {condition.loss:.0%}")
                seen = _run_cell(settings, recording, condition, contender)
                race.cells.append(
                    measure(
                        seen,
                        identity,
                        contender=name,
                        load=condition.load,
                        loss=condition.loss,
                        sample_rate=condition.sample_rate,
                    )
                )
        except KeyboardInterrupt:
            race.interrupted = True
        except RunError as error:
            race.error = error
        return race


def _run_cell(settings: RaceSettings, recording: RaceRecording, condition: Condition, contender: Contender) -> Observed:
    radio = RaceRadio(PHY_NAME, condition.sample_rate, condition.loss, settings.seed)
    with ExitStack() as stack:
        spaces = (stack.enter_context(Namespace()), stack.enter_context(Namespace()))
        paths = (spaces[0].path, spaces[1].path)
        topic = RaceTopic(recording.topic, recording.type_name, recording.topic)
        if contender.stack == "gr-ros2":
            packet_len = settings.packet_len if contender.settings["compression"] else recording.single_packet_len
            arguments = (radio, paths, (topic.name, topic.type_name), packet_len, contender)
            air = stack.enter_context(Worker("radio", "", RaceRosLink, *arguments))
            topic = RaceTopic(topic.name, topic.type_name, air.call("output_topic"))
        else:
            air = stack.enter_context(Worker("radio", "", RaceIpLink, radio, paths))
        listener = stack.enter_context(Worker("listener", paths[1], RaceSubscriber, contender, topic))
        talker = stack.enter_context(
            Worker(
                "talker",
                paths[0],
                RacePublisher,
                contender,
                topic,
                recording.path,
                len(recording.due),
                settings.duration_s,
            )
        )
        # The listener joins first, so that the talker can connect to it.
        timeout_s = settings.match_s + _PLAY_SLACK_S
        began = listener.call("connect", timeout_s=timeout_s)
        talker.call("connect", timeout_s=timeout_s)
        matched = _wait_matched(settings.match_s, talker, listener, air)
        t_first = talker.call("play", timeout_s=settings.duration_s + _PLAY_SLACK_S)
        t_sent = [t_first + due for due in recording.due]
        _drain(settings.drain_s, listener, len(t_sent))
        report: LinkReport = air.call("report")
        busy = os.getloadavg()[0] / (os.cpu_count() or 1)
        return Observed(began, matched, t_sent, listener.call("heard"), report, busy)


def _wait_matched(limit_s: float, *parts: Worker) -> bool:
    limit = time.monotonic() + limit_s
    while not (matched := all(part.call("matched") for part in parts)) and time.monotonic() < limit:
        time.sleep(_POLL_S)
    return matched


def _drain(limit_s: float, listener: Worker, expected: int) -> None:
    """Wait until all messages on their way have arrived, or none has arrived for ``_QUIET_S``; ``limit_s`` at most."""
    limit = time.monotonic() + limit_s
    count, quiet = -1, 0.0
    while (found := listener.call("count")) < expected and time.monotonic() < limit:
        now = time.monotonic()
        if found != count:
            count, quiet = found, now + _QUIET_S
        if now > quiet:
            return
        time.sleep(_POLL_S)
