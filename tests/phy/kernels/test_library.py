"""The library of kernels: built where there is a compiler, told about where there is none, harmless to load."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import PHY, configured, kernels
from gr_ros2.phy.kernels import library
from gr_ros2.phy.kernels.modem import CompiledModem
from gr_ros2.settings.config import PhyConfig
from tests.phy.kernels.support import VARIANTS, variant

ROOT = Path(__file__).resolve().parents[3]
DENORMALS = """
import ctypes, sys, threading
import numpy as np
smallest = np.array([1e-40, 1e-310])
for path in sys.argv[1:]:
    ctypes.CDLL(path)
survived = []
def look():
    survived.append(bool(np.all(np.float32(smallest[0]) * np.ones(8, np.float32) > 0)))
    survived.append(bool(np.all(smallest[1] * np.ones(8) > 0)))
look()
thread = threading.Thread(target=look)
thread.start()
thread.join()
print(survived)
"""


@pytest.mark.parametrize("name", VARIANTS)
def test_denormals_survive_loading_it(name: str) -> None:
    variant(name)
    path = library._file(library._FOLDER, name)
    command = [sys.executable, "-W", "error", "-c", DENORMALS, str(path)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said == "[True, True, True, True]\n"


def test_the_best_variant_for_this_processor_is_taken() -> None:
    functions = variant("_baseline")
    assert library.loaded().functions is not None
    newest = functions.kernels_has_avx2() and library._file(library._FOLDER, "_avx2")
    assert library.loaded().about == ("AVX2" if newest else functions.kernels_target().decode())
    assert kernels.which("auto") == f"compiled, {library.loaded().about}"


@pytest.mark.parametrize("name", ["ofdm", "psk", "gfsk", "lora"])
def test_the_setting_chooses(name: str) -> None:
    variant("_baseline")
    fast = configured(PhyConfig(name=name), 64, 1e6)
    slow = configured(PhyConfig(name=name, kernels="numpy"), 64, 1e6)
    assert isinstance(fast.running_modem, CompiledModem)  # type: ignore[attr-defined]
    assert slow.running_modem is slow.modem  # type: ignore[attr-defined]
    assert (fast.runs_on().split(",")[0], slow.runs_on()) == ("compiled", "numpy, as set")


def test_blocks_of_others_say_that_they_run() -> None:
    assert PHY.load("ofdm")(64, 1e6, detection_threshold="stock").runs_on() == "GNU Radio's blocks"
    assert PHY.load("direct")(64).runs_on() == ""


def test_kernels_there_are_none_of_are_refused() -> None:
    with pytest.raises(ConfigError, match="phy psk: kernels = 'fast': write auto or numpy"):
        PHY.load("psk")(64, 1e6, kernels="fast")


def test_without_a_library_numpy_runs_and_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = library.load(tmp_path)
    assert found.functions is None
    monkeypatch.setattr(kernels, "loaded", lambda: found)
    phy: Any = PHY.load("psk")(64, 1e6)
    assert phy.running_modem is phy.modem
    assert phy.runs_on().startswith("numpy, no compiled kernels: they were not built; install a C++ compiler")


def test_a_library_of_another_machine_is_no_error(tmp_path: Path) -> None:
    (tmp_path / f"_baseline{library.EXTENSION_SUFFIXES[0]}").write_bytes(b"\x7fELF, but not from here")
    found = library.load(tmp_path)
    assert found.functions is None
    assert found.about.startswith("they do not load (")


def test_without_a_compiler_the_package_is_built_without_kernels(tmp_path: Path) -> None:
    build = [sys.executable, "setup.py", "-q", "build", f"--build-base={tmp_path}", f"--build-lib={tmp_path / 'lib'}"]
    environment = {**os.environ, "CC": "/bin/false", "CXX": "/bin/false"}
    done = subprocess.run(build, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "gr_ros2.phy.kernels._baseline" in done.stderr
    folder = tmp_path / "lib" / "gr_ros2" / "phy" / "kernels"
    assert (folder / "library.py").is_file()
    assert not list(folder.glob("*.so"))
    asked = "from gr_ros2.phy.kernels import which; print(which('auto'))"
    said = subprocess.run(
        [sys.executable, "-c", asked], cwd=tmp_path / "lib", capture_output=True, text=True, check=True
    )
    assert said.stdout.startswith("numpy, no compiled kernels")


def test_a_source_distribution_has_all_sources(tmp_path: Path) -> None:
    egg = ["egg_info", f"--egg-base={tmp_path}"]
    command = [sys.executable, "setup.py", "-q", *egg, "sdist", f"--dist-dir={tmp_path}"]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (path,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        packed = {Path(name).name for name in archive.getnames() if "/phy/kernels/" in name}
    wanted = {path.name for path in (ROOT / "gr_ros2" / "phy" / "kernels").iterdir() if path.suffix in (".cpp", ".h")}
    assert len(wanted) >= 7
    assert wanted <= packed
