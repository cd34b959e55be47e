"""Pytest plugin: a module of tests that needs what is not installed here is skipped, and says what that is.

It needs what it imports, and in some folders GNU Radio as its tests run. Other modules that import without what they
need say so themselves (``pytest.importorskip``).
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

import pytest

from gr_ros2.core.errors import BackendMissingError

OPTIONAL = {"gnuradio": "GNU Radio 3.10", "pmt": "GNU Radio 3.10", "zmq": "pyzmq", "av": "PyAV", "bokeh": "Bokeh"}
OPTIONAL |= {"selenium": "Selenium", "distributed": "Dask"}
"""What tests may be without: the package that is imported, and what it is of."""
TESTS = Path(__file__).parent
WITH_GNU_RADIO = ("e2e", "lab/medium", "lab/run", "lab/study", "phy/kernels")
"""Folders whose tests need GNU Radio, whatever they import."""


class OptionalModule(pytest.Module):
    """A module of tests, which may need what is not there."""

    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        """Its tests."""
        if any(self.path.parent == TESTS / folder for folder in WITH_GNU_RADIO) and find_spec("gnuradio") is None:
            pytest.skip(f"needs {OPTIONAL['gnuradio']}", allow_module_level=True)
        try:
            return super().collect()
        except (self.CollectError, BackendMissingError) as error:
            cause: BaseException | None = error
            while cause is not None:
                name = (getattr(cause, "name", None) or "").partition(".")[0]
                if name in OPTIONAL and find_spec(name) is None:
                    pytest.skip(f"needs {OPTIONAL[name]}", allow_module_level=True)
                cause = cause.__cause__
            raise


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> OptionalModule:
    module: OptionalModule = OptionalModule.from_parent(parent, path=module_path)
    return module
