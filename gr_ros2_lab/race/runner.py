"""Runs a race, one cell after another. A cell is one contender under one condition, in new processes.

Invariants: nothing of a cell remains after it, even after an error: its processes end, and its namespaces and
interfaces are removed. The cells measured before Ctrl-C or a failure are kept.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from gr_ros2.core.errors import RunError
from gr_ros2.core.watch import Watch, wait_until
from gr_ros2_lab.race.channel import RaceChannel
from gr_ros2_lab.race.contenders import QUEUE, Contender
from gr_ros2_lab.race.endpoints import Playback, RaceProgram, RaceTopic, Seat
from gr_ros2_lab.race.links import LinkReport, RaceIpLink, RaceRadio, RaceRosLink
from gr_ros2_lab.race.measure import (
    Identity,
    Observed,
    RaceCell,
    RaceSender,
    RaceStream,
    check_outage,
    measure,
)
from gr_ros2_lab.race.namespaces import Namespace, check_means
from gr_ros2_lab.race.race_settings import (
    DRAIN_S,
    MATCH_S,
    Condition,
    RaceRecording,
    RaceSettings,
    beside,
    check,
    conditions,
    racing,
    read_recordings,
)
from gr_ros2_lab.race.rows import ROWS
from gr_ros2_lab.race.slots import run_slots
from gr_ros2_lab.race.tun import QUEUE_BYTES
from gr_ros2_lab.race.workers import PROCESSOR_S, Worker

_POLL_S = 0.05
_LOOK_S = 0.01
"""s between two looks whether the ends have found each other, which the first message waits for."""
_QUIET_S = 3.0
"""s. When no message has arrived for this time, no more are expected."""
_PLAY_SLACK_S = 30.0
_TO_BEGIN_S = 0.2
"""s until all robots of a team have been told when to begin."""


@dataclass
class Race:
    """A race and its results.

    :param recording: of the first robot
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
        recordings = read_recordings(settings, Path(folder))
        senders = [RaceSender(recording, Identity(recording)) for recording in recordings]
        race = Race(settings, recordings[0])
        others: dict[str, list[RaceSender]] = {}
        plan = [
            (condition, name, contender)
            for condition in conditions(settings, recordings)
            for name, contender in racing(settings).items()
        ]
        try:
            for number, (condition, name, contender) in enumerate(plan):
                if on_cell is not None:
                    on_cell(number, len(plan), f"{name}, load {condition.load:.0%}, loss {condition.loss:.0%}")
                if not settings.robots:
                    if contender.stack not in others:
                        found = beside(settings, Path(folder), contender.stack)
                        others[contender.stack] = [RaceSender(each, Identity(each)) for each in found]
                    seen = _run_cell(settings, [senders[0], *others[contender.stack]], condition, contender)
                elif contender.stack == "gr-ros2":
                    seen = run_slots(settings, senders, condition, contender)
                else:
                    seen = _run_team(settings, senders, condition, contender)
                values = {"load": condition.load, "loss": condition.loss, "sample_rate": condition.sample_rate}
                race.cells.append(measure(seen, contender=name, robots=settings.robots, row=settings.row, **values))
        except KeyboardInterrupt:
            race.interrupted = True
        except RunError as error:
            race.error = error
        return race


def _run_cell(
    settings: RaceSettings, senders: Sequence[RaceSender], condition: Condition, contender: Contender
) -> Observed:
    """One robot sends to another one; each direction has its own air.

    :param senders: of the odometry, and of what goes beside it in this row
    """
    row = ROWS[settings.row]
    recordings = [sender.recording for sender in senders]
    radio = RaceRadio(condition.sample_rate, condition.loss, settings.seed)
    timeout_s = MATCH_S + _PLAY_SLACK_S
    with ExitStack() as stack:
        paths = (stack.enter_context(Namespace()).path, stack.enter_context(Namespace()).path)
        topics = [RaceTopic(recording.topic, recording.type_name, recording.qos) for recording in recordings]
        outputs = list(topics)
        plays = [_playback(settings, *pair) for pair in zip(recordings, topics, strict=True)]
        # Processes take seconds to start, in which a link that is already there would send.
        listener = stack.enter_context(Worker("listener", paths[1], RaceProgram, contender, Seat(1)))
        talker = stack.enter_context(Worker("talker", paths[0], RaceProgram, contender, Seat(0), plays))
        if contender.stack == "gr-ros2":
            packet_len = settings.packet_len if contender.compresses else recordings[0].single_packet_len
            rows = [(topic.name, topic.type_name, topic.qos) for topic in topics]
            arguments = (radio, paths, rows, packet_len, contender)
            air = stack.enter_context(Worker("radio", "", RaceRosLink, *arguments))
            outputs = [replace(topic, name=name) for topic, name in zip(topics, air.call("outputs"), strict=True)]
        else:
            air = stack.enter_context(
                Worker("radio", "", RaceIpLink, radio, paths, contender.settings.get(QUEUE, QUEUE_BYTES))
            )
        parts, matched, began = (talker, listener, air), False, 0.0
        for end in (0,) if row.late else (1, 0):  # who receives listens first
            air.call("enter", end)
        if not row.late:
            # The listener joins first, so that the talker can connect to it.
            began = listener.call("connect", outputs, timeout_s=timeout_s)
            talker.call("connect", timeout_s=timeout_s)
            matched = _wait_matched(MATCH_S, *parts)
        else:
            talker.call("connect", timeout_s=timeout_s)
        used = _processor_s(parts)
        begin = time.monotonic()
        found = begin - began if matched else None
        talker.ask("play", begin)
        outage = None
        if row.late:
            time.sleep(max(0.0, begin + row.begin_s - time.monotonic()))
            began = time.monotonic()
            air.call("enter", 1)
            listener.call("connect", outputs, timeout_s=timeout_s)
            matched = _wait_matched(MATCH_S, *parts[1:])
        elif row.outage_s:
            time.sleep(max(0.0, begin + row.begin_s - time.monotonic()))
            outage = _outage(air, row.outage_s, condition.loss)
        firsts = talker.answer(settings.duration_s + _PLAY_SLACK_S)
        used = [after - before for before, after in zip(used, _processor_s(parts), strict=True)]
        sent = [sender.sent(first) for sender, first in zip(senders, firsts, strict=True)]
        _drain(DRAIN_S, [listener], sum(map(len, sent)))
        report: LinkReport = air.call("report")
        streams = [
            RaceStream(sender.identity, t_sent, heard)
            for sender, t_sent, heard in zip(senders, sent, listener.call("heard"), strict=True)
        ]
        if outage is not None:
            check_outage(outage, streams[0], report)
        return Observed(
            began,
            matched,
            streams[:1],
            report,
            _busy(),
            streams[1:],
            outage,
            (used[0] + used[1], used[2]),
            row.late,
            found,
        )


def _processor_s(parts: Sequence[Worker]) -> list[float]:
    return [part.call(PROCESSOR_S) for part in parts]


def _outage(air: Worker, length_s: float, loss: float) -> tuple[float, float]:
    """Lose everything for so long; begin and end, s monotonic."""
    air.call("set_loss", 1.0)
    begin = time.monotonic()
    time.sleep(length_s)
    end = time.monotonic()
    air.call("set_loss", loss)
    return begin, end


def _run_team(
    settings: RaceSettings, senders: Sequence[RaceSender], condition: Condition, contender: Contender
) -> Observed:
    """All robots send to all others over IP on one channel."""
    radio = RaceRadio(condition.sample_rate, condition.loss, settings.seed)
    count = len(senders)
    topics = [
        RaceTopic(f"/robot_{number}/race", sender.recording.type_name) for number, sender in enumerate(senders, 1)
    ]
    with ExitStack() as stack:
        paths = [stack.enter_context(Namespace()).path for _ in senders]
        air = stack.enter_context(Worker("channel", "", RaceChannel, radio, paths))
        robots = []
        for number, (path, sender) in enumerate(zip(paths, senders, strict=True)):
            plays = [_playback(settings, sender.recording, topics[number])]
            arguments = (contender, Seat(number, count, shared=True), plays)
            robots.append(stack.enter_context(Worker(f"robot {number + 1}", path, RaceProgram, *arguments)))
        # One after the other, the last one first, to which the others connect. Of Zenoh's multicast the declarations
        # of robots that join at once go round for ever.
        began = 0.0
        for number, robot in reversed([*enumerate(robots)]):
            hears = [topic for topic in topics if topic is not topics[number]]
            began = max(began, robot.call("connect", hears, timeout_s=MATCH_S + _PLAY_SLACK_S))
        matched = _wait_matched(MATCH_S, *robots)
        begin = time.monotonic() + _TO_BEGIN_S
        for robot in robots:
            robot.ask("play", begin)
        firsts = [robot.answer(settings.duration_s + _PLAY_SLACK_S) for robot in robots]
        t_sent = [sender.sent(first) for sender, (first,) in zip(senders, firsts, strict=True)]
        _drain(DRAIN_S, robots, (count - 1) * sum(map(len, t_sent)))
        report: LinkReport = air.call("report")
        streams = []
        for receiver, robot in enumerate(robots):
            others = [number for number in range(count) if number != receiver]
            for number, heard in zip(others, robot.call("heard"), strict=True):
                streams.append(RaceStream(senders[number].identity, t_sent[number], heard))
        return Observed(began, matched, streams, report, _busy())


def _playback(settings: RaceSettings, recording: RaceRecording, topic: RaceTopic) -> Playback:
    messages = len(recording.due)
    return Playback(recording.path, recording.topic, topic, messages, settings.duration_s, recording.phase_s)


def _busy() -> float:
    return os.getloadavg()[0] / (os.cpu_count() or 1)


def _wait_matched(limit_s: float, *parts: Worker) -> bool:
    return wait_until(lambda: all(part.call("matched") for part in parts), limit_s, look_s=_LOOK_S)


def _drain(limit_s: float, listeners: Sequence[Worker], expected: int) -> None:
    """Wait until all messages on their way have arrived, or none has arrived for ``_QUIET_S``; ``limit_s`` at most."""
    quiet = Watch()

    def over() -> bool:
        found = sum(robot.call("count") for robot in listeners)
        return found >= expected or quiet.still_s(found, time.monotonic()) > _QUIET_S

    wait_until(over, limit_s, look_s=_POLL_S)
