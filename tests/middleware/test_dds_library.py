"""Where the DDS library comes from, and what is said when it is none."""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest

from gr_ros2 import middleware
from gr_ros2.middleware import dds_library

PYPI = pytest.mark.skipif(sys.version_info >= (3, 14), reason="PyPI has no cyclonedds for this Python: it is built in")


def test_the_python_part_of_its_package_is_not_imported() -> None:
    code = "import sys, gr_ros2.middleware.dds; sys.exit('cyclonedds' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_one_beside_the_module_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / f"libddsc{EXTENSION_SUFFIXES[0]}"  # as setup.py builds it in for a newer Python
    shutil.copyfile(dds_library.load()._name, place)
    monkeypatch.setattr(middleware, "__path__", [str(tmp_path)])
    found = dds_library.load()
    assert found._name == str(place)
    found.dds_strretcode(0)


def test_what_is_no_library_is_an_import_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / f"libddsc{EXTENSION_SUFFIXES[0]}").write_bytes(b"no library")
    monkeypatch.setattr(middleware, "__path__", [str(tmp_path)])
    with pytest.raises(ImportError, match=r"Cyclone DDS does not load.*libddsc"):
        dds_library.load()


@PYPI
def test_another_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dds_library, "version", lambda _: "0.10.5")
    with pytest.raises(ImportError, match=r"cyclonedds 0\.10\.5 is installed"):
        dds_library.load()
