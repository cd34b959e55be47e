"""What signals do to `gr-ros2 link` in a process of its own: SIGUSR1 and SIGUSR2 switch sending, SIGTERM and SIGINT
end it."""

from __future__ import annotations

import json
import signal
import subprocess
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from tests.cli.test_status import Ends, ends
from tests.waiting import PATIENCE_S, wait_for

pytestmark = pytest.mark.slow
__all__ = ["ends"]  # the fixture


def status(ends: Ends, link: subprocess.Popen[str]) -> dict[str, Any]:
    answer = ends.run("status", "--json", "--pid", str(link.pid))
    told: dict[str, Any] = json.loads(answer.stdout) if answer.returncode == 0 else {}
    return told


def log(ends: Ends, number: int = 1) -> str:
    return (ends.folder / f"log-{number}").read_text()


def test_sending_stops_and_begins_again_by_signals_and_the_link_goes_on_hearing(ends: Ends) -> None:
    first = ends.link(1)
    ends.link(2)
    wait_for(ends.heard, "the other end")
    first.send_signal(signal.SIGUSR1)
    wait_for(lambda: "sending is off" in log(ends), "the word that sending is off")
    before = status(ends, first)
    assert before["airtime"]["transmits"] is False
    wait_for(lambda: status(ends, first)["packets"]["in"] > before["packets"]["in"] + 3, "what the other end says")
    assert status(ends, first)["packets"]["out"] == before["packets"]["out"]
    first.send_signal(signal.SIGUSR2)
    wait_for(lambda: status(ends, first)["packets"]["out"] > before["packets"]["out"], "packets again")
    assert first.poll() is None


def test_a_link_that_only_receives_refuses_to_send_and_goes_on(ends: Ends) -> None:
    link = ends.link(1, "--listen-only")
    ends.link(2)
    wait_for(ends.heard, "the other end")
    link.send_signal(signal.SIGUSR2)
    wait_for(lambda: "it only receives, and has no open transmitter" in log(ends), "the refusal")
    told = status(ends, link)
    assert (told["packets"]["out"], told["airtime"]["transmits"]) == (0, False)
    assert link.poll() is None


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_link_with_its_last_line_and_it_starts_again(ends: Ends, number: signal.Signals) -> None:
    for _ in range(2):  # the second one finds the state file free
        link = ends.link(1)
        wait_for(lambda link=link: status(ends, link), "an answer")
        link.send_signal(number)
        assert link.wait(PATIENCE_S) == 0
        last = log(ends).splitlines()[-1]
        assert "nobody heard" in last
        assert "Traceback" not in log(ends)
        assert not status(ends, link)
