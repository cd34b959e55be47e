"""A condition that holds ends the waiting; one that never does fails the test in its own words."""

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
