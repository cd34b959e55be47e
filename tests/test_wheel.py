"""A wheel of the tree, in an environment of its own: everything that is no Python came along and is found."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROGRAM = """
import json, sys
from pathlib import Path
import gr_ros2
from gr_ros2.cli.wireshark import DISSECTOR
from gr_ros2.compression.dictionary import shipped
from gr_ros2.settings.files import REGISTRY_DIR
from gr_ros2_lab.run.builtin import SCENARIO_DIR
from gr_ros2.grc.path import example, grc_path
from gr_ros2.middleware.dds_library import load
from gr_ros2.phy.kernels.library import loaded
print(json.dumps({
    "package": str(Path(gr_ros2.__file__).parent),
    "blocks": sorted(path.name for path in grc_path().iterdir() if path.name != "__pycache__"),
    "examples": sorted(path.name for path in example("topics.csv").parent.iterdir()),
    "registries": sorted(path.name for path in REGISTRY_DIR.iterdir()),
    "scenarios": sorted(path.name for path in SCENARIO_DIR.iterdir()),
    "dissector": DISSECTOR.read_text(),
    "dictionary": shipped().number,
    "kernels": loaded().functions is not None,
    "dds": load()._name,
}))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an environment with the wheel in it; what it depends on comes from this environment."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(".*", "build", "results", "__pycache__", "*.egg-info"))
    # Kernels compiled without optimisation, for one kind of processor, come along as all do and take little time.
    setup = source / "setup.py"
    text = setup.read_text(encoding="utf-8")
    assert '"-O3"' in text
    assert '("x86_64", "AMD64")' in text
    setup.write_text(text.replace('"-O3"', '"-O0"').replace('("x86_64", "AMD64")', "()"), encoding="utf-8")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    subprocess.run([*build, str(source)], check=True, capture_output=True)
    (wheel,) = folder.glob("gr_ros2-*.whl")
    environment = folder / "environment"
    venv.create(environment, with_pip=False, system_site_packages=True)
    python = environment / "bin" / "python"
    site = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    # After its own packages, so that ours is the wheel's and not the tree's.
    (Path(site) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    install = [python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-compile", "--ignore-installed", str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    return environment


@pytest.mark.slow
def test_it_finds_what_is_no_python(installed: Path, tmp_path: Path) -> None:
    python = installed / "bin" / "python"
    # Isolated and elsewhere: the tree is not on its path.
    done = subprocess.run([python, "-I", "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found["package"].startswith(str(installed))

    def tracked(folder: str) -> list[str]:
        return sorted(path.name for path in (ROOT / folder).iterdir() if path.name != "__pycache__")

    for name, package in {"blocks": "gr_ros2/grc", "scenarios": "gr_ros2_lab/scenarios"}.items():
        assert found[name] == tracked(package), package
    for name in ("examples", "registries"):
        assert found[name] == tracked(f"gr_ros2/{name}"), name
    assert found["dissector"] == (ROOT / "gr_ros2" / "wireshark" / "gr_ros2.lua").read_text()
    assert found["dictionary"] > 0
    assert found["kernels"] == bool(shutil.which("g++"))
    if sys.version_info >= (3, 14):  # before, it comes from a package of its own
        assert found["dds"].startswith(str(installed))


@pytest.mark.slow
def test_its_command_runs(installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)  # a tree on it would come before the wheel
    command = [installed / "bin" / "gr-ros2"]
    listed = subprocess.run([*command, "scenarios"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert "paper-ofdm-paced" in listed
    path = subprocess.run([*command, "grc-path"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert path.strip().startswith(str(installed))
