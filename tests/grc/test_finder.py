"""Another Python finds gr-ros2 and what it needs of an environment, when it asks for gr-ros2, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gr_ros2.grc import finder as path_finder
from tests.packages import install


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    """A folder with our packages, and an environment with packages it needs, and one that it does not."""
    for ours in path_finder.PACKAGES:
        (tmp_path / ours).mkdir()
        (tmp_path / ours / "__init__.py").write_text("whose = 'ours'\n")
    site = tmp_path / "site"
    (site / "family" / "child").mkdir(parents=True)
    (site / "family" / "child" / "__init__.py").write_text("whose = 'environment'\n")
    for package in ("needed", "too_old", "loaded", "private"):
        install(site, package, {package: "whose = 'environment'\n"}, {})
    system = tmp_path / "system"
    (system / "family" / "other").mkdir(parents=True)
    (system / "family" / "other" / "__init__.py").write_text("whose = 'system'\n")
    for package in ("too_old", "loaded", "fits"):
        install(system, package, {package: "whose = 'system'\n"}, {})
    shutil.copy(path_finder.__file__, system / "_finder.py")
    return tmp_path


def said(environment: Path, program: str) -> str:
    """What a program prints in the other Python."""
    offer = (
        f"import sys; sys.path.insert(0, {str(environment / 'system')!r}); import _finder\n"
        f"_finder.offer({str(environment)!r}, {str(environment / 'site')!r}, "
        "['needed', 'too_old', 'loaded', 'family', 'family.child'], ['needed', 'too-old'])\n"
    )
    done = subprocess.run(
        [sys.executable, "-S", "-E", "-c", offer + program], capture_output=True, text=True, cwd=environment / "system"
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("name", ["needed", "private", "family.child"])
def test_before_gr_ros2_is_imported_nothing_else_is_found(environment: Path, name: str) -> None:
    program = f"try:\n import {name}\nexcept ImportError as error:\n print(error)"
    assert f"No module named '{name}'" in said(environment, program)
    assert said(environment, "import too_old; print(too_old.whose)") == "system"


@pytest.mark.parametrize(
    ("name", "whose"),
    [("needed", "environment"), ("too_old", "environment"), ("fits", "system"), ("family.child", "environment")],
)
def test_what_gr_ros2_needs_is_found_with_it(environment: Path, name: str, whose: str) -> None:
    assert said(environment, f"import gr_ros2, {name}; print(gr_ros2.whose, {name}.whose)") == f"ours {whose}"


def test_the_laboratory_is_found_too(environment: Path) -> None:
    assert said(environment, "import gr_ros2_lab, needed; print(gr_ros2_lab.whose, needed.whose)") == "ours environment"


def test_what_it_does_not_need_is_not_found(environment: Path) -> None:
    program = "import gr_ros2\ntry:\n import private\nexcept ImportError as error:\n print(error)"
    assert said(environment, program) == "No module named 'private'"


def test_what_is_loaded_already_stays(environment: Path) -> None:
    assert said(environment, "import loaded, gr_ros2; import loaded as again; print(again.whose)") == "system"


def test_versions_are_those_of_what_is_found(environment: Path) -> None:
    for package in ("needed", "too_old"):
        metadata = environment / "site" / f"{package}-1.0.dist-info" / "METADATA"
        metadata.write_text(metadata.read_text().replace("1.0", "2.0"))
    program = "import gr_ros2; from importlib.metadata import version as v; print(v('needed'), v('too-old'), v('fits'))"
    assert said(environment, program) == "2.0 2.0 1.0"
    every = (
        "import gr_ros2; from importlib import metadata as m; print({d.metadata['Name'] for d in m.distributions()})"
    )
    assert "needed" in said(environment, every)
    assert "private" not in said(environment, every)


def test_an_environment_that_is_gone_harms_nobody(environment: Path) -> None:
    shutil.rmtree(environment / "gr_ros2")
    program = "import too_old\ntry:\n import gr_ros2\nexcept ImportError as error:\n print(too_old.whose, error)"
    assert said(environment, program) == "system No module named 'gr_ros2'"
