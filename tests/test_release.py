"""tools/release: the version stands once, its copies follow it, and what is not ready is named."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from datetime import date
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest

import gr_ros2

ROOT = Path(__file__).resolve().parent.parent
FILES = ("gr_ros2/__init__.py", "package.xml", "CHANGELOG.md", "packaging/conda/meta.yaml")


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    """The tool as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        spec = importlib.util.spec_from_loader("release", SourceFileLoader("release", str(ROOT / "tools" / "release")))
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    sys.modules.pop("clone", None)
    return module


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tmp_path / name)
    return tmp_path


def test_a_version_is_written_where_it_stands_and_to_its_copies(tool: ModuleType, root: Path) -> None:
    tool.write_version(root, "9.8.7")
    assert '__version__ = "9.8.7"' in (root / FILES[0]).read_text()
    assert "<version>9.8.7</version>" in (root / FILES[1]).read_text()
    assert f"## 9.8.7 ({date.today()})" in (root / FILES[2]).read_text()
    assert '{% set version = "9.8.7" %}' in (root / FILES[3]).read_text()
    assert tool.problems(root, "9.8.7") == []


def test_what_is_not_ready_is_named_with_the_remedy(tool: ModuleType, root: Path) -> None:
    (root / "CHANGELOG.md").write_text("# Changes\n\n## 1.2.3 (not released)\n")
    *_, unreleased = tool.problems(root, "1.2.3")
    assert unreleased == "CHANGELOG.md calls 1.2.3 not released; run: tools/release 1.2.3"
    copies, recipe, absent = tool.problems(root, "1.2.4")
    assert "packaging/conda/meta.yaml has another version than 1.2.4" in recipe
    assert "package.xml has another version than 1.2.4; run: tools/release 1.2.4" in copies
    assert "no heading `## 1.2.4 (DATE)`" in absent


def test_no_other_file_of_the_package_names_the_version() -> None:
    quoted = f'"{gr_ros2.__version__}"'
    named = [path for path in (ROOT / "setup.py", ROOT / "pyproject.toml") if quoted in path.read_text()]
    assert named == []
