"""A computer that is too slow: the demo with a third of the processor time that it needs. Its packets are those of a
modem as quick as its radio, and follow the wall clock; in lock step, as with a radio, everything would wait.

First the demo runs free, and its processor time is measured while messages are sent. Then it runs with a third of that.
Where the kernel does not give processor time by quota without rights, SIGSTOP and SIGCONT do, in periods of
``PERIOD_S`` as the kernel's: the process is stopped once it has used its share, and goes on when it has half of a
period's again. With stops as short as they can be, its 50 threads would be woken three times as often for them.
It starts free, since loading a program is not what is measured.

Ages are those of the receiving robot's ROS graph, from the stamp that the simulated robot gives a message when it is
due, so that they hold whatever waits, the simulator's own messages in its thread too.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from bench.rows import Row
from gr_ros2.gr.latency import CLOCK_TYPE, has_header, leading_time
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2_lab.record.metrics import age
from gr_ros2_lab.record.result import Result, read_result
from gr_ros2_lab.run.runner import DELIVERED_BAG

MODEM = "phy={name: modem, options: {bit_rate: 6e5}}"
SHARE = 1 / 3
DURATION_S = 20.0
TICK_S, PERIOD_S = 0.005, 0.1
MOST_AGE_S, MOST_PAUSE_S, MOST_REPORTS = 1.0, 2.0, 0.3


class _Run(NamedTuple):
    """One run.

    :param cores: processor time over time while messages were sent
    :param ages: mean age in s of each topic whose messages tell when they were due
    :param pauses: longest time in s in which nothing of a topic came out
    """

    result: Result
    cores: float
    ages: dict[str, float]
    pauses: dict[str, float]

    @property
    def reports(self) -> float:
        """Their share of the packets."""
        sent = {name: count for name, count in self.result.packets.items() if name.startswith("air_")}
        return float(sent["air_report"] / sum(sent.values()))


def slow_computer() -> list[Row]:
    """Ages and pauses of the topics, and the share of reports, at a third of the processor time."""
    free = _run(None)
    slow = _run(SHARE * free.cores)
    dropped: Counter[str] = Counter()
    for topic in slow.result.topics:
        dropped.update(topic.ledger)
    fates = ", ".join(f"{count} {fate}" for fate, count in dropped.most_common())
    inside = max(topic.age_s.mean or 0.0 for topic in slow.result.topics if topic.sent > 1)
    had = f"in the link alone {inside:.2f} s; {slow.cores:.2f} of a core, {free.cores:.2f} are needed"
    what = "a third of the processor: "
    return [
        _worst(f"{what}oldest mean age", slow.ages, free.ages, MOST_AGE_S, had),
        _worst(f"{what}longest pause of a topic", slow.pauses, free.pauses, MOST_PAUSE_S, fates),
        Row(
            f"{what}reports", slow.reports, "", "≤", MOST_REPORTS, "{:.0%}", f"of the packets; free {free.reports:.0%}"
        ),
    ]


def _worst(what: str, slow: Mapping[str, float], free: Mapping[str, float], most: float, note: str) -> Row:
    name = max(slow, key=lambda topic: slow[topic])
    return Row(what, slow[name], "s", "≤", most, "{:.2f}", f"{name}; free {max(free.values()):.2f} s; {note}")


def _run(cores: float | None) -> _Run:
    """Run the demo.

    :param cores: processor time over time that it gets from the first message on, None for as much as it wants
    """
    with TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "gr_ros2.cli", "demo", "--no-report", "--out", str(out)]
        command += ["--duration", f"{DURATION_S}", "--set", MODEM]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            while "ROS_DOMAIN_ID" not in process.stdout.readline():  # then the first messages leave
                if process.poll() is not None:
                    raise SystemExit("bench slow_computer: the demo did not start")
            used = _hold(process, cores, DURATION_S)
            process.communicate(timeout=120)
        finally:
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()
        return _Run(read_result(out), used, *_times(out))


def _hold(process: subprocess.Popen[str], cores: float | None, seconds: float) -> float:
    """Give a process so much processor time for some seconds; returns how much it used, over the time."""
    spent = _clock_of(process.pid)
    begin, first = time.monotonic(), spent()
    last, left, stopped = begin, 0.0, False
    before = first
    while (now := time.monotonic()) < begin + seconds and process.poll() is None:
        used = spent()
        if cores is not None:
            left = min(left + cores * (now - last) - (used - before), cores * PERIOD_S)
            if (left >= cores * PERIOD_S / 2) if stopped else (left < 0):
                stopped = not stopped
                process.send_signal(signal.SIGSTOP if stopped else signal.SIGCONT)
        last, before = now, used
        time.sleep(TICK_S)
    process.send_signal(signal.SIGCONT)
    return (before - first) / (last - begin)


def _clock_of(pid: int) -> Callable[[], float]:
    """Processor time that a process has used with all its threads, s: the clock of clock_getcpuclockid(3)."""
    return lambda: time.clock_gettime((~pid << 3) | 2)


def _times(out: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Mean age of each topic that tells when a message was due, and longest pause of each topic, s. A map that is sent
    once has neither."""
    came: dict[str, list[float]] = {}
    due: dict[str, list[float]] = {}
    for message in read_bag(out / DELIVERED_BAG):
        came.setdefault(message.topic, []).append(message.stamp_ns * 1e-9)
        if message.type_name == CLOCK_TYPE or has_header(message.type_name):
            due.setdefault(message.topic, []).append(leading_time(message.payload) or nan)
    end = max(map(max, came.values()))
    often = {name: np.array(times) for name, times in came.items() if len(times) > 1}
    ages = {name: age(np.array(due[name]), times, end) for name, times in often.items() if name in due}
    pauses = {name: float(np.diff(times, append=end).max()) for name, times in often.items()}
    return {name: one.mean for name, one in ages.items() if one is not None}, pauses
