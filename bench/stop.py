"""From Ctrl-C to the end of a real run, with its result written, beside the start of a command."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from bench.rows import Row
from bench.runs import DOMAINS
from gr_ros2_lab.record.result import read_result

REPEATS, PATIENCE_S = 3, 60.0
MOST = 2.0
"""Time from Ctrl-C to the end over that of a command that only starts and prints something."""
_DELIVERED = re.compile(rb"([1-9][0-9]*) delivered")


def stop() -> list[Row]:
    rows = []
    for name in ("paper-direct", "paper-ofdm", "demo"):
        pairs = [(_stop_time(name), _start_time()) for _ in range(REPEATS)]
        times, starts = zip(*pairs, strict=True)
        note = f"{min(times):.2f} to {max(times):.2f} s; a start takes {median(starts):.2f} s"
        ratio = median(stop / start for stop, start in pairs)
        rows.append(Row(f"{name}: stop after Ctrl-C over a start", ratio, "", "≤", MOST, "{:.2f}", note))
    return rows


def _start_time() -> float:
    """Seconds of a command that starts and says what it is, the yardstick."""
    begin = time.monotonic()
    subprocess.run([sys.executable, "-m", "gr_ros2.cli", "scenarios"], stdout=subprocess.DEVNULL, check=True)
    return time.monotonic() - begin


def _stop_time(name: str) -> float:
    """Seconds from the signal, sent once messages arrive, to the end of the process."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = [word for override in DOMAINS for word in ("--set", override)]
        command = [
            sys.executable,
            "-m",
            "gr_ros2.cli",
            "run",
            name,
            "--duration",
            "600",
            "--out",
            str(out),
            *words,
        ]
        terminal, end = pty.openpty()
        process = subprocess.Popen(command, stdout=end, stdin=subprocess.DEVNULL)
        os.close(end)
        try:
            _read_until_delivered(terminal, process)
            begin = time.monotonic()
            process.send_signal(signal.SIGINT)
            _read_rest(terminal)
            process.wait(PATIENCE_S)
            took = time.monotonic() - begin
        finally:
            process.kill()
            process.wait()
            os.close(terminal)
        if process.returncode or not read_result(out).interrupted:
            raise SystemExit(f"bench stop: {name} ended with status {process.returncode}")
        return took


def _read_until_delivered(terminal: int, process: subprocess.Popen[bytes]) -> None:
    shown = b""
    deadline = time.monotonic() + PATIENCE_S
    while not _DELIVERED.search(shown):
        if process.poll() is not None or time.monotonic() > deadline:
            raise SystemExit(f"bench stop: nothing was delivered: {shown[-500:]!r}")
        shown += os.read(terminal, 4096)


def _read_rest(terminal: int) -> None:
    """Until the process closes its end, which Linux tells by an error."""
    try:
        while os.read(terminal, 4096):
            pass
    except OSError:
        return
