from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gr_ros2.core.errors import RunError
from gr_ros2_lab.race.namespaces import Namespace, enter, inside
from tests.lab.race.support import needs_namespaces
from tests.programs import run_program

OWN = "/proc/thread-self/ns/net"


def where() -> str:
    return str(Path(OWN).readlink())


def interfaces() -> list[str]:
    return [line.split(":")[0].strip() for line in Path("/proc/thread-self/net/dev").read_text().splitlines()[2:]]


@needs_namespaces
def test_only_the_thread_inside_is_in_a_namespace() -> None:
    before = where()
    with Namespace() as one, Namespace() as other:
        places = {inside(one.path, where), inside(other.path, where), before}
        assert len(places) == 3
        assert inside(one.path, interfaces) == ["lo"]
        assert where() == before


@needs_namespaces
def test_what_is_made_inside_stays_inside_and_goes_with_the_namespace() -> None:
    with Namespace() as namespace:
        command = ["ip", "tuntap", "add", "gr_ros2_test", "mode", "tun"]
        inside(namespace.path, lambda: subprocess.run(command, check=True))
        assert sorted(inside(namespace.path, interfaces)) == ["gr_ros2_test", "lo"]
        assert "gr_ros2_test" not in interfaces()
        path = namespace.path
    namespace.close()  # a second time does nothing
    assert not Path(path).exists()


@needs_namespaces
def test_an_error_inside_is_raised_outside() -> None:
    def fail() -> None:
        raise ValueError("inside")

    with Namespace() as namespace, pytest.raises(ValueError, match="inside"):
        inside(namespace.path, fail)


@needs_namespaces
def test_what_is_no_namespace_cannot_be_entered(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="cannot be entered"):
        enter(str(tmp_path / "file"))


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="no setpriv")
def test_without_root_one_line_says_so_with_the_remedy() -> None:
    command = [sys.executable, "-m", "gr_ros2.cli", "race", "--short"]
    if os.geteuid() == 0:
        command = ["setpriv", "--bounding-set=-sys_admin", *command]
    done = run_program(command, capture_output=True, text=True)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "the race needs root" in line
    assert "sudo" in line
