"""The wheels that `make wheel` has put into dist/: they install without a compiler, for every Python at once.

Building them takes minutes. So these tests look at what is there, and are skipped where nothing is.
"""

from __future__ import annotations

import os
import subprocess
import sysconfig
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

from gr_ros2 import __version__

DIST = Path(__file__).resolve().parent.parent / "dist"
MACHINES = {"x86_64": 62, "aarch64": 183}
"""Number of each architecture in an ELF file (e_machine)."""
PROGRAM = """
from gr_ros2.middleware.dds_library import load
from gr_ros2.phy.kernels.library import loaded
print(load()._name, loaded().functions is not None)
"""


def wheel(machine: str) -> Path:
    found = sorted(DIST.glob(f"gr_ros2-{__version__}-cp310-abi3-manylinux_*_{machine}.whl"))
    if not found:
        pytest.skip(f"no wheel for {machine} in dist: make wheel")
    return found[-1]


@pytest.mark.parametrize("machine", MACHINES)
def test_the_kernels_inside_are_for_its_processor_and_for_every_python(machine: str) -> None:
    with ZipFile(wheel(machine)) as files:
        libraries = {name: files.read(name)[:20] for name in files.namelist() if name.endswith(".so")}
    kernels = [name for name in libraries if "phy/kernels/_baseline" in name]
    assert kernels == ["gr_ros2/phy/kernels/_baseline.abi3.so"]
    assert {int.from_bytes(head[18:20], "little") for head in libraries.values()} == {MACHINES[machine]}
    assert any("libddsc" in name for name in libraries) == (machine == "x86_64")


@pytest.mark.slow
def test_it_installs_and_works_where_there_is_no_compiler(tmp_path: Path) -> None:
    if sysconfig.get_platform() != "linux-x86_64":
        pytest.skip("needs x86-64")
    environment = tmp_path / "environment"
    venv.create(environment, with_pip=False, system_site_packages=True)
    python, programs = environment / "bin" / "python", environment / "bin"
    (site,) = environment.glob("lib/python3*/site-packages")
    alone = {**os.environ, "PATH": str(programs)}
    # pip and what gr-ros2 depends on come from this environment, after its own packages.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    install = [python, "-m", "pip", "install", "--quiet", "--no-deps", "--ignore-installed", str(wheel("x86_64"))]
    subprocess.run(install, env=alone, check=True, capture_output=True)
    done = subprocess.run([python, "-I", "-c", PROGRAM], cwd=tmp_path, env=alone, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    library, kernels = done.stdout.split()
    assert library.startswith(str(environment))
    assert kernels == "True"
