"""A measurement of the link to another robot, without a radio: who is said to be at fault."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from gr_ros2.core.watch import wait_until
from gr_ros2.gr import throughput
from gr_ros2.gr.throughput import LiveThroughput


def measured(monkeypatch: pytest.MonkeyPatch, steps: Iterator[float]) -> str:
    """What is said of a robot that never answers, by a clock that makes these steps."""
    monkeypatch.setattr(throughput, "_LOOK_S", 0.0)
    now = 0.0

    def clock() -> float:
        nonlocal now
        now += next(steps)
        return now

    calls = SimpleNamespace(link_calls={}, check_heard=lambda _: None, ask=lambda *_: True)
    parts: list[Any] = [SimpleNamespace(sends=True), SimpleNamespace(), calls, SimpleNamespace()]
    of = LiveThroughput(*parts, share=1.0, sends=True, clock=clock)
    monkeypatch.setattr(of, "_drop", lambda _: None)
    of.measure(2, 5)
    assert wait_until(lambda: of.look()["state"] == "failed", 60.0, lambda _: None)
    of.close()
    return str(of.look()["words"])


def steps(*first: float) -> Iterator[float]:
    yield from first
    while True:
        yield 0.5


def test_a_robot_that_does_not_answer_is_at_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    assert measured(monkeypatch, steps()) == "robot 2 has not answered in 30 s: an older gr-ros2 does not"


def test_a_link_that_stood_still_itself_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    words = measured(monkeypatch, steps(0.0, 0.0, *[0.5] * 6, 40.0))
    assert words == "this link stood still for 40 s itself meanwhile; measure again"
