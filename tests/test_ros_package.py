"""The tree as a ROS 2 package: what a workspace finds after `colcon build`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

import gr_ros2

ROOT = Path(__file__).resolve().parent.parent
WANTED = (
    "share/ament_index/resource_index/packages/gr_ros2",
    "share/gr_ros2/package.xml",
    "share/gr_ros2/launch/link_launch.py",
    "share/gr_ros2/grc/ros2_source.block.yml",
    "share/gr_ros2/hook/grc_blocks_path.dsv",
    "lib/gr_ros2/link",
)
LEFT_OUT = shutil.ignore_patterns(".*", "build", "results", "__pycache__", "*.egg-info", "tests", "docs")


def test_the_manifest_is_that_of_this_package() -> None:
    root = ET.parse(ROOT / "package.xml").getroot()
    assert root.get("format") == "3"
    assert root.findtext("name") == "gr_ros2"
    assert root.findtext("license") == "GPL-3.0-or-later"
    assert root.findtext("export/build_type") == "ament_python"
    asked = subprocess.run(
        [sys.executable, "setup.py", "-q", "--version"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert root.findtext("version") == asked.stdout.split()[-1] == gr_ros2.__version__


def test_setup_installs_what_a_workspace_looks_for(tmp_path: Path) -> None:
    command = [sys.executable, "setup.py", "-q", "install_data", "--install-dir", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert [name for name in WANTED if not (tmp_path / name).is_file()] == []
    assert os.access(tmp_path / "lib/gr_ros2/link", os.X_OK)
    blocks = {path.name for path in (ROOT / "gr_ros2" / "grc").glob("*.yml")}
    assert {path.name for path in (tmp_path / "share/gr_ros2/grc").iterdir()} == blocks


def has_colcon() -> bool:
    """Whether colcon is here, with what reads colcon.pkg."""
    colcon = shutil.which("colcon")
    return bool(colcon) and "--metas" in subprocess.run([colcon, "build", "-h"], capture_output=True, text=True).stdout


@pytest.mark.skipif(not has_colcon(), reason="no colcon: pip install colcon-common-extensions")
@pytest.mark.parametrize("options", [[], ["--symlink-install"]], ids=["copied", "linked"])
def test_colcon_builds_it(tmp_path: Path, options: list[str]) -> None:
    shutil.copytree(ROOT, tmp_path / "src" / "gr_ros2", ignore=LEFT_OUT)
    done = subprocess.run(["colcon", "build", *options], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "doesn't explicitly install" not in done.stderr
    prefix = tmp_path / "install" / "gr_ros2"
    assert [name for name in WANTED if not (prefix / name).is_file()] == []
    asked = 'unset GRC_BLOCKS_PATH; . install/setup.sh && echo "$GRC_BLOCKS_PATH" && command -v gr-ros2'
    said = subprocess.run(["sh", "-c", asked], cwd=tmp_path, capture_output=True, text=True)
    assert said.stdout.split() == [str(prefix / "share/gr_ros2/grc"), str(prefix / "bin/gr-ros2")], said.stderr
