"""A condition that holds ends the waiting; one towards which nothing moves fails the test in its own words."""

from __future__ import annotations

import pytest

from tests import waiting
from tests.waiting import wait_for


def test_it_looks_until_the_condition_holds() -> None:
    looks = iter([False, 0, "", [1]])
    wait_for(lambda: next(looks), "the fourth look")
    assert next(looks, "none left") == "none left"


def test_what_never_comes_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "PATIENCE_S", 0.01)
    with pytest.raises(AssertionError, match=r"waited 0\.01 s for the tide"):
        wait_for(lambda: False, "the tide")


def test_patience_begins_anew_with_each_step_of_what_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter(range(1000))
    monkeypatch.setattr(waiting.time, "monotonic", lambda: float(next(now)))
    monkeypatch.setattr(waiting.time, "sleep", lambda _: None)
    monkeypatch.setattr(waiting, "PATIENCE_S", 5.0)
    looks, steps = iter(range(40)), iter(range(40))
    wait_for(lambda: next(looks) == 38, "forty looks", progress=lambda: next(steps))
    with pytest.raises(AssertionError, match="waited 5 s for the tide, the last step of it low"):
        wait_for(lambda: False, "the tide", progress=lambda: "low")
