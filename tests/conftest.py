"""Settings of every test."""

from __future__ import annotations

import os

import pytest
from hypothesis import settings

from gr_ros2.record.result import Result
from tests.record.results import RESULT

# Helpers that assert say what they saw, as tests do.
pytest.register_assert_rewrite("tests.e2e.support", "tests.middleware.support")

# Machines are shared and noisy: no example has a deadline. CI draws the same examples each time, so that a red run
# means a change; `make test` elsewhere draws new ones.
settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")


@pytest.fixture
def result() -> Result:
    """One topic with numbers and one on which nothing was sent."""
    return RESULT
