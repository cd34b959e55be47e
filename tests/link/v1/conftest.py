"""What several modules of tests of version 1 share."""

from __future__ import annotations

import pytest

from tests.link.v1.air import Robot


@pytest.fixture(params=[False, True], ids=["", "relaying"])
def relaying(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Every test twice: nothing reliable is lost with relaying on that is delivered with it off."""
    monkeypatch.setattr(Robot, "relays", request.param)
    return bool(request.param)
