"""tools/set-up and tools/install-system: whatever a computer lacks, they end in one line with the remedy."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S, wait_for

ROOT = Path(__file__).resolve().parent.parent
USED = ("sh", "cat", "cut", "date", "dirname", "find", "flock", "grep", "mkdir", "mktemp", "rm", "sed", "tail", "touch")
USED = (*USED, "tr", "wc", "env", "id", "apt-get", "apt-cache", "dpkg", "dpkg-query", "sudo", "true", "c++")
DEBIAN = {
    "dpkg": "echo amd64",
    "dpkg-query": "exit 1",
    "apt-cache": "echo '  Candidate: (none)'",
    "apt-get": "echo 'E: Failed to fetch http://deb.debian.org/debian' >&2; exit 100",
    "c++": "exit 0",
}
"""A Debian on which nothing is installed, and from which no package source can be reached."""


def programs(folder: Path, stand_ins: Mapping[str, str]) -> str:
    """A PATH with what the two scripts use and nothing else; distribution and user are those of the stand-ins."""
    folder.mkdir()
    absent = {"apt-get", "apt-cache", "dpkg", "dpkg-query", "sudo", "c++"}
    for name in USED:
        found = shutil.which(name)
        if name in stand_ins:
            (folder / name).write_text(f"#!/bin/sh\n{stand_ins[name]}\n")
            (folder / name).chmod(0o755)
        elif found is not None and name not in absent:
            (folder / name).symlink_to(found)
    return str(folder)


def install_system(path: str, kind: str = "run", python: str = "/bin/false") -> subprocess.CompletedProcess[str]:
    """Run it without a terminal."""
    command = [str(ROOT / "tools" / "install-system"), kind]
    environment = {"PATH": path, "PYTHON": python}
    return subprocess.run(command, env=environment, capture_output=True, text=True, start_new_session=True)


def line_of(done: subprocess.CompletedProcess[str]) -> str:
    """The only line on stderr of a command that failed."""
    assert done.returncode == 1, done.stderr
    (line,) = done.stderr.splitlines() or [""]
    return line


def test_another_distribution(tmp_path: Path) -> None:
    line = line_of(install_system(programs(tmp_path / "bin", {})))
    assert "neither Debian nor Ubuntu; install GNU Radio 3.10" in line
    there = install_system(programs(tmp_path / "more", {}), python="/bin/true")  # GNU Radio is installed
    assert (there.returncode, there.stderr) == (0, "")
    test = install_system(programs(tmp_path / "test", {}), "test")
    assert test.returncode == 0
    assert "tests whose peers are missing are skipped" in test.stderr


def test_sudo_without_a_terminal(tmp_path: Path) -> None:
    without = {**DEBIAN, "id": "echo 1000", "sudo": "echo 'sudo: a password is required' >&2; exit 1"}
    line = line_of(install_system(programs(tmp_path / "bin", without)))
    assert "has no terminal to ask on; as root, run:" in line
    assert f"{ROOT}/tools/install-system run (it installs gnuradio" in line


def test_package_sources_that_cannot_be_reached(tmp_path: Path) -> None:
    line = line_of(install_system(programs(tmp_path / "bin", {**DEBIAN, "id": "echo 0"})))
    assert "cannot be reached (E: Failed to fetch http://deb.debian.org/debian); connect this computer" in line


def test_packages_that_cannot_be_fetched(tmp_path: Path) -> None:
    known = {**DEBIAN, "id": "echo 0", "apt-cache": "echo '  Candidate: 3.10'"}
    line = line_of(install_system(programs(tmp_path / "bin", known)))
    assert "apt-get could not install gnuradio python3-venv python3-dev (E: Failed to fetch" in line
    assert "connect this computer" in line


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """What set-up reads of a clone, on a computer that has what the distribution has."""
    made = tmp_path / "clone"
    for name in ("tools/set-up", "requirements.txt", "requirements-dev.txt", "setup.py"):
        (made / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, made / name)
    kernels = made / "gr_ros2" / "phy" / "kernels"
    kernels.mkdir(parents=True)
    (kernels / "one.cpp").touch()
    (kernels / "one.h").touch()
    (made / "tools" / "install-system").write_text("#!/bin/sh\n")
    (made / "tools" / "install-system").chmod(0o755)
    return made


@pytest.mark.slow
def test_a_moved_clone_without_a_network(clone: Path) -> None:
    pip = clone / ".venv" / "bin" / "pip"
    pip.parent.mkdir(parents=True)
    pip.write_text("#!/home/before/clone/.venv/bin/python3\n")
    (clone / ".venv" / "stamp-run").touch()
    unreachable = {"PIP_INDEX_URL": "http://127.0.0.1:9/", "PIP_RETRIES": "0", "PIP_CONFIG_FILE": os.devnull}
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PIP_")}
    command = [str(clone / "tools" / "set-up"), "run"]
    environment = {**kept, **unreachable, "PYTHON": getattr(sys, "_base_executable", sys.executable)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert "moved or copied: its environment is made again" in done.stdout
    assert "about 3 minutes and up to 1.7 GB of disk" in done.stdout
    assert str(clone / ".venv") in pip.read_text()
    assert "the Python packages cannot be fetched: no way to PyPI" in line_of(done)
    assert not (clone / ".venv" / "stamp-run").exists()


def test_two_at_once(clone: Path) -> None:
    (clone / ".venv").mkdir()
    for stamp in ("stamp-run", "stamp-dev"):  # everything was done
        (clone / ".venv" / stamp).touch()
    said = clone / "said"
    with (clone / "tools" / "set-up").open() as other, said.open("w") as output:
        fcntl.flock(other, fcntl.LOCK_EX)
        second = subprocess.Popen([str(clone / "tools" / "set-up"), "test"], stdout=output)
        wait_for(lambda: said.read_text() != "", "the second one's line")
        assert second.poll() is None
    assert second.wait(PATIENCE_S) == 0
    assert said.read_text() == "Another make is setting this clone up; waiting for it\n"
