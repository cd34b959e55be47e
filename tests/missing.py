"""Pytest plugin: a module of tests that imports what is not installed here is skipped, and says what that is.

Modules that import without it, and need it only as their tests run, say so themselves (``pytest.importorskip``).
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

import pytest

OPTIONAL = {"gnuradio": "GNU Radio 3.10", "pmt": "GNU Radio 3.10", "zmq": "pyzmq", "av": "PyAV", "bokeh": "Bokeh"}
OPTIONAL |= {"selenium": "Selenium", "distributed": "Dask"}
"""What tests may be without: the package that is imported, and what it is of."""


class OptionalModule(pytest.Module):
    """A module of tests, which may import what is not there."""

    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        """Its tests."""
        try:
            return super().collect()
        except self.CollectError as error:
            name = (getattr(error.__cause__, "name", None) or "").partition(".")[0]
            if name not in OPTIONAL or find_spec(name) is not None:
                raise
            pytest.skip(f"needs {OPTIONAL[name]}", allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> OptionalModule:
    module: OptionalModule = OptionalModule.from_parent(parent, path=module_path)
    return module
