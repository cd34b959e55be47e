"""Makes gr-ros2 importable in the Python that GNU Radio Companion and its flowgraphs run in.

Invariants: only two files are written, in the user's site-packages of that Python, and ``withdraw`` removes them; pip
and its database are not touched (PEP 668); no package of that Python is shadowed before a flowgraph imports gr-ros2.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from gr_ros2.core.errors import ConfigError
from gr_ros2.grc import finder as path_finder
from gr_ros2.grc.finder import PACKAGES

MODULE = "_gr_ros2_path_finder"
PATH_FILE = "gr_ros2.pth"
NEEDED = (
    "apsw",
    "backports.zstd",
    "cryptography",
    "cyclonedds",
    "eclipse-zenoh",
    "numpy",
    "pydantic",
    "pyyaml",
    "rosbags",
)
"""Distributions that blocks use. A flowgraph does not need those of reports, tables and the dashboard."""
_ALONE = ("cyclonedds",)
"""Distributions whose Python part is not imported, so that their own requirements are not needed."""
_KEPT = ("PYTHONUSERBASE", "PYTHONNOUSERSITE")
_ASK = """
import json, os, site, sys, sysconfig
from importlib import metadata, util
sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__name__ != "EnvironmentFinder"]
found = util.find_spec("gr_ros2")
has = {}
for one in metadata.distributions():  # the first of a name is the one that is imported
    has.setdefault(one.metadata["Name"], one.version)
print(json.dumps({
    "version": list(sys.version_info[:2]),
    "abi": sysconfig.get_config_var("SOABI"),
    "user": site.getusersitepackages(),
    "enabled": bool(site.ENABLE_USER_SITE),
    "where": os.path.dirname(os.path.dirname(os.path.realpath(found.origin))) if found and found.origin else "",
    "has": {name: version for name, version in has.items() if name and version},
}))
"""


@dataclass(frozen=True)
class OtherPython:
    """The Python of GNU Radio's programs.

    :param program: its path
    :param version: major and minor
    :param abi: ABI of the compiled modules that it can load
    :param user: site-packages of the user
    :param enabled: whether it reads the user's site-packages
    :param where: folder from which it imports gr_ros2 without our path file; '' = it does not
    :param has: version of each distribution that it finds, by normalised name
    """

    program: str
    version: tuple[int, int]
    abi: str
    user: Path
    enabled: bool
    where: str
    has: Mapping[str, str]


def grc_program(search: str | None = None) -> str:
    """The Python that GRC runs in: the one in the first line of ``gnuradio-companion`` or ``grcc``.

    :param search: folders, in the form of PATH; None for PATH itself
    """
    for name in ("gnuradio-companion", "grcc"):
        script = shutil.which(name, path=search)
        if script is not None:
            with open(script, "rb") as file:
                line = file.readline().decode("utf-8", "replace")
            words = line[2:].split() if line.startswith("#!") else []
            if words and Path(words[0]).name != "env" and Path(words[0]).is_file():
                return words[0]
    return "/usr/bin/python3"


def ask(program: str, environ: Mapping[str, str] = os.environ) -> OtherPython:
    """Ask a Python for its properties, without our path file.

    :raises ConfigError: it does not run
    """
    try:
        done = subprocess.run(
            [program, "-c", _ASK], env=_clean(environ), capture_output=True, text=True, cwd="/", check=True
        )
        answer = json.loads(done.stdout.splitlines()[-1])
    except (OSError, subprocess.CalledProcessError, ValueError, IndexError) as error:
        raise ConfigError(f"{program}: the Python of GNU Radio Companion does not run ({error})") from error
    return OtherPython(
        program,
        (answer["version"][0], answer["version"][1]),
        answer["abi"] or "",
        Path(answer["user"]),
        answer["enabled"],
        answer["where"],
        {_plain(name): version for name, version in answer["has"].items()},
    )


def finds_us(program: str, environ: Mapping[str, str] = os.environ) -> bool:
    """Whether a Python, started as from a desktop menu, imports gr-ros2 with its blocks."""
    command = [program, "-c", "import gr_ros2.gr"]
    try:
        return not subprocess.run(command, env=_clean(environ), capture_output=True, cwd="/", check=False).returncode
    except OSError:
        return False


def provide(other: OtherPython) -> Path | None:
    """Let that Python import gr-ros2 and the requirements of its blocks from the environment that this program runs in.

    :returns: the path file; None if that Python finds this gr-ros2 by itself
    :raises ConfigError: it is of another version, does not read the user's site-packages, or these cannot be written
    """
    folder = Path(path_finder.__file__).resolve().parent.parent.parent
    if other.where == str(folder):
        return None
    if (other.version, other.abi) != (sys.version_info[:2], sysconfig.get_config_var("SOABI") or ""):
        wanted, have = (".".join(map(str, version)) for version in (other.version, sys.version_info[:2]))
        raise ConfigError(
            f"GNU Radio Companion runs in Python {wanted} ({other.program}), gr-ros2 is installed in Python {have} "
            f"({sys.executable}); make its environment by {other.program} -m venv --system-site-packages .venv"
        )
    if not other.enabled:
        raise ConfigError(
            f"{other.program} does not look into {other.user}; set PYTHONPATH={folder} where you start GRC"
        )
    offered = _offered(other.has)
    call = ", ".join(map(repr, (str(folder), *offered)))
    try:
        other.user.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path_finder.__file__, other.user / f"{MODULE}.py")
        path_file = other.user / PATH_FILE
        path_file.write_text(f"import {MODULE}; {MODULE}.offer({call})\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{other.user}: cannot be written ({error.strerror})") from error
    return path_file


def withdraw(other: OtherPython) -> list[Path]:
    """Remove what :func:`provide` wrote; returns the files that existed.

    :raises ConfigError: a file cannot be removed
    """
    cached = [*(other.user / "__pycache__").glob(f"{MODULE}.*.pyc")]
    there = [path for path in (other.user / PATH_FILE, other.user / f"{MODULE}.py", *cached) if path.is_file()]
    try:
        for path in there:
            path.unlink()
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be removed ({error.strerror})") from error
    return there


def _clean(environ: Mapping[str, str]) -> dict[str, str]:
    """An environment without variables that change where a Python finds its modules."""
    return {name: value for name, value in environ.items() if name in _KEPT or not name.startswith("PYTHON")}


def _offered(theirs: Mapping[str, str]) -> tuple[str, list[str], list[str]]:
    """The environment's site-packages, and its modules and distributions that the other Python lacks or has too old.

    :param theirs: version of each distribution the other Python has
    """
    environment = Path(sysconfig.get_path("purelib")).resolve()
    modules: set[str] = set()
    packages = []
    for name, specifiers in _requirements():
        found = _distribution(name, environment)
        if found is not None and not (name in theirs and _fits(theirs[name], specifiers)):
            modules |= _modules(found)
            packages.append(name)
    return str(environment), sorted(modules), sorted(packages)


def _requirements() -> Iterator[tuple[str, list[str]]]:
    """Each distribution that blocks need, directly or indirectly, and the requirements on its version."""
    from packaging.requirements import Requirement

    asked: dict[str, list[str]] = {}
    own = [Requirement(text) for text in metadata.requires("gr-ros2") or ()]
    waiting = [item for item in own if _plain(item.name) in map(_plain, NEEDED)]
    while waiting:
        item = waiting.pop()
        if item.marker is not None and not any(item.marker.evaluate({"extra": extra}) for extra in ("", "zenoh")):
            continue
        name = _plain(item.name)
        new = name not in asked
        asked.setdefault(name, []).append(str(item.specifier))
        if new and name not in _ALONE:
            try:
                waiting += [Requirement(text) for text in metadata.requires(name) or ()]
            except metadata.PackageNotFoundError:
                continue
    yield from asked.items()


def _fits(version: str, specifiers: Iterable[str]) -> bool:
    from packaging.specifiers import SpecifierSet

    return all(SpecifierSet(text).contains(version, prereleases=True) for text in specifiers)


def _distribution(name: str, environment: Path) -> metadata.Distribution | None:
    """A distribution, if it belongs to the environment itself and not to the system behind it."""
    try:
        found = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return None
    return found if Path(str(found.locate_file(""))).resolve() == environment else None


def _modules(found: metadata.Distribution) -> set[str]:
    """The modules of a distribution, by dotted names; for a namespace package also its parts."""
    files = [file for file in found.files or () if file.suffix in (".py", ".so")]
    regular = {file.parts[:-1] for file in files if file.name.partition(".")[0] == "__init__"}
    names = set()
    for file in files:
        top = (file.parts[0],)
        if len(file.parts) == 1:
            names.add(file.name.partition(".")[0])
        elif top in regular:
            names.add(top[0])
        elif file.parts[:2] in regular:
            names |= {top[0], ".".join(file.parts[:2])}
    return {name for name in names if name.replace(".", "").isidentifier() and name not in PACKAGES}


def _plain(name: str) -> str:
    """A name in the normalised form in which PEP 503 compares names."""
    return name.lower().replace("_", "-").replace(".", "-")
