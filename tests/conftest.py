"""Settings of every test."""

from __future__ import annotations

import os

from hypothesis import settings

# Machines are shared and noisy: no example has a deadline. CI draws the same examples each time, so that a red run
# means a change; `make test` elsewhere draws new ones.
settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")
