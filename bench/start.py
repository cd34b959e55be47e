"""What a link costs before it does anything, and how soon commands answer: each in a process of its own."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.rows import Row, median_of

REPEATS = 3
COMMAND = [sys.executable, "-m", "gr_ros2.cli"]
SETTLED_S = 2.0
"""s after its first line at which the memory of a link is read: its diagnostics have been published."""
LINK = """
phy: {name: psk, sample_rate: 1e6}
front_end: {name: zmq, bind: "ipc://FOLDER/1", connect: ["ipc://FOLDER/2"]}
robot: /robot_1
"""


def start() -> list[Row]:
    """A link that nobody hears, and commands that print something."""
    links = [_link() for _ in range(REPEATS)]
    resident_mb, threads, started_s = (sorted(values)[REPEATS // 2] for values in zip(*links, strict=True))
    return [
        Row("link (psk, zmq, dds): resident", resident_mb, "MB", "≤", 90, "{:.0f}"),
        Row("link: threads", threads, "", "≤", 22 + _processors(), note="one for each processor is of OpenBLAS"),
        Row("link: processor until it runs", started_s, "s", "≤", 0.8, "{:.2f}"),
        _answers(("scenarios",), 0.5),
        _answers(("race", "--help"), 0.5),
        Row("plan demo", median_of(REPEATS, _timed(("plan", "demo"))), "s", "≤", 4, "{:.1f}", f"{_processors()} cores"),
    ]


def _answers(words: Sequence[str], most_s: float) -> Row:
    def processor_s() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        _run(words)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    return Row(f"{' '.join(words)}: processor", median_of(REPEATS, processor_s), "s", "≤", most_s, "{:.2f}")


def _timed(words: Sequence[str]) -> Callable[[], float]:
    def wall_s() -> float:
        begin = time.monotonic()
        _run(words)
        return time.monotonic() - begin

    return wall_s


def _run(words: Sequence[str]) -> None:
    subprocess.run([*COMMAND, *words], stdout=subprocess.DEVNULL, check=True)


def _link() -> tuple[float, int, float]:
    """MB and threads of a link some time after its start, and s of processor that it has taken when it says that it
    runs."""
    with TemporaryDirectory() as folder:
        config = Path(folder) / "link.yaml"
        config.write_text(LINK.replace("FOLDER", folder), encoding="utf-8")
        environ = {**os.environ, "ROS_LOCALHOST_ONLY": "1"}
        with subprocess.Popen([*COMMAND, "link", config], env=environ, stdout=subprocess.PIPE, text=True) as link:
            try:
                assert link.stdout is not None
                while "Ctrl-C ends it" not in (line := link.stdout.readline()):
                    assert line, "the link has ended"
                ticks = Path(f"/proc/{link.pid}/stat").read_text("utf-8").rpartition(")")[2].split()[11:13]
                time.sleep(SETTLED_S)
                status = Path(f"/proc/{link.pid}/status").read_text("utf-8")
            finally:
                link.terminate()
    resident_kb, threads = (
        int(line.split()[1]) for line in status.splitlines() if line.startswith(("VmRSS", "Threads"))
    )
    return resident_kb / 1e3, threads, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def _processors() -> int:
    return len(os.sched_getaffinity(0))
