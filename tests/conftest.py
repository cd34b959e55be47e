"""Settings of every test."""

from __future__ import annotations

import os

import pytest
from hypothesis import settings

# Helpers that assert say what they saw, as tests do.
pytest.register_assert_rewrite("tests.e2e.support", "tests.middleware.support")

# Machines are shared and noisy: no example has a deadline. CI draws the same examples each time, so that a red run
# means a change; `make test` elsewhere draws new ones.
settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")
