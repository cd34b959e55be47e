"""Ctrl-C and SIGTERM while the program starts: one line and one status, whatever is being loaded."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from gr_ros2.cli.ending import INTERRUPTED
from tests.domains import free_domains
from tests.waiting import PATIENCE_S

PLAN = ("plan", "demo")
GRAPH = ("registry", "from-graph", "--wait", "60")


@pytest.mark.parametrize(
    ("words", "loaded", "number"),
    [
        (PLAN, "click.exceptions", signal.SIGINT),  # before there is a command line
        (PLAN, "click.exceptions", signal.SIGTERM),
        (PLAN, "pydantic_core", signal.SIGINT),  # with the command's own modules
        (PLAN, "pmt", signal.SIGTERM),
        (PLAN, "gr_ros2.phy.ofdm_layout", signal.SIGINT),  # with a PHY
        (GRAPH, "gr_ros2.middleware.cdr_dds", signal.SIGTERM),  # with a middleware
    ],
)
def test_a_signal_while_modules_are_loaded(words: tuple[str, ...], loaded: str, number: signal.Signals) -> None:
    if loaded.startswith(("pmt", "gr_ros2.phy")):
        pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    domain = ("--domain-id", str(free_domains(1)[0])) if words is GRAPH else ()
    # Python names each module on stderr when it has loaded it.
    command = [sys.executable, "-X", "importtime", "-m", "gr_ros2.cli", *words, *domain]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        for line in process.stderr:
            if line.rpartition("|")[2].strip() == loaded:
                break
        else:
            pytest.fail(f"{loaded} was never loaded")
        process.send_signal(number)
        _, rest = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    said = [line for line in rest.splitlines() if line and not line.startswith("import time:")]
    assert said == ["gr-ros2: interrupted"]
    assert process.returncode == INTERRUPTED


def test_what_is_to_be_ignored_stays_ignored() -> None:
    """A shell script's background jobs do not hear Ctrl-C."""
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN);"
        "from gr_ros2.cli.__main__ import main; from gr_ros2.cli import main as command;"
        "command.run = lambda: signal.raise_signal(signal.SIGINT); main()"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
