"""Who fails is left out, named once, and counted."""

from __future__ import annotations

import logging

import pytest

from gr_ros2.core.errors import BagError, RunError
from gr_ros2.core.guard import Guard, one_line


def fails(error: Exception) -> None:
    raise error


def test_the_first_failure_ends_it_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    guard, heard = Guard("capture x"), list[int]()
    guard(heard.append, 1)
    assert guard.incomplete() == []
    guard(fails, OSError(28, "No space left on device"))
    for number in range(5):
        guard(heard.append, number)
    assert heard == [1]
    assert [record.message for record in caplog.records] == [
        "capture x: ended (No space left on device); the link goes on without it"
    ]
    assert guard.incomplete() == ["capture x: ended (No space left on device); 6 events missed"]


def test_who_falls_behind_is_named_once_and_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    guard, heard = Guard("dashboard"), list[int]()
    guard.miss()
    guard.miss(2)
    guard(heard.append, 1)
    assert heard == [1]
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert guard.incomplete() == ["dashboard: slower than the link; 3 events missed"]


def test_what_a_result_needs_is_raised_and_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    guard = Guard("recorder", needed=True)
    guard.check()
    guard(fails, KeyError("x"))
    guard(fails, ValueError("later"))
    with pytest.raises(RunError, match=r"^recorder: failed \(KeyError: 'x'\)$"):
        guard.check()
    own = Guard("recorder", needed=True)
    own(fails, BagError("bag x: full"))
    with pytest.raises(BagError, match=r"^bag x: full$"):
        own.check()
    assert not caplog.records


def test_the_last_call_reaches_it_all_the_same() -> None:
    guard, heard = Guard("x"), list[str]()
    guard.last(heard.append, "one")
    guard(fails, ValueError())
    guard.last(heard.append, "two")
    guard.last(fails, ValueError("another"))
    assert heard == ["one", "two"]
    assert guard.incomplete() == ["x: ended (ValueError); 1 events missed"]


def test_ctrl_c_is_no_failure_of_an_observer() -> None:
    guard = Guard("x")

    def interrupted() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        guard(interrupted)
    assert guard.incomplete() == []


def test_errors_in_one_line() -> None:
    assert one_line(OSError(28, "No space left on device", "/x")) == "/x: No space left on device"
    assert one_line(RunError("two\nlines")) == "two lines"
    assert one_line(RecursionError("too\ndeep")) == "RecursionError: too deep"
