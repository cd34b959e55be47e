"""What the tools that make packages have in common: the files of this clone, and where packages are put."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DIST = ROOT / "dist"


def version() -> str:
    """The version, from where it stands."""
    (found,) = re.findall(r'^__version__ = "(.+)"$', (ROOT / "gr_ros2" / "__init__.py").read_text("utf-8"), re.M)
    return str(found)


def compiling_for(machine: str) -> dict[str, str]:
    """The environment in which setup.py makes a wheel for an architecture: that of GNU's name, with its compiler."""
    compiler = f"{machine}-linux-gnu-g++"
    tools = {"GR_ROS2_WHEEL": machine, "CC": compiler, "CXX": compiler, "LDSHARED": f"{compiler} -shared"}
    return {**os.environ, **tools, "LDCXXSHARED": f"{compiler} -shared"}


def copy_of_clone(target: Path) -> None:
    """Copy what git knows or does not ignore; without git everything but what is hidden or was built."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        hidden_or_built = shutil.ignore_patterns(".*", "build", "dist", "results", "*.egg-info", "*.so", "__pycache__")
        shutil.copytree(ROOT, target, ignore=hidden_or_built)
        return
    git = ["git", "-c", f"safe.directory={ROOT}", "-C", str(ROOT), "ls-files", "--cached", "--others"]
    listed = subprocess.run([*git, "--exclude-standard"], check=True, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)
