"""tools/try-distributions: what it refuses before it makes anything, and the table it writes."""

from __future__ import annotations

import hashlib
import importlib.util
import shutil
import subprocess
import sys
from functools import partial
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
TOOL = ROOT / "tools" / "try-distributions"
CONTROL = "Package: keys\nVersion: 1\nArchitecture: all\nMaintainer: Test <test@test.example>\nDescription: keys\n"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    """The tool as a module."""
    spec = importlib.util.spec_from_loader("try_distributions", SourceFileLoader("try_distributions", str(TOOL)))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["debian-1"], "no 'debian-1'; known are debian-12"),
        (["--steps", "setup,fly"], "no 'fly'; known are setup"),
        (["--folder", str(ROOT / "build")], "lies in the repository"),
        (["--mirror", "gentoo=here"], "families are debian, ubuntu"),
    ],
)
def test_what_it_refuses(words: list[str], said: str) -> None:
    done = subprocess.run([sys.executable, str(TOOL), *words], capture_output=True, text=True)
    assert done.returncode != 0
    assert said in done.stderr


def test_the_clone_is_copied_without_what_git_ignores(tool: ModuleType, tmp_path: Path) -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("needs a clone: this is no git repository")
    kept, built = (tmp_path / tool.CLONE / ".venv" / name for name in ("kept", "stamp-run"))
    old = tmp_path / tool.CLONE / "old" / "file"
    for path in (kept, built, old):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    tool.copy_in(tmp_path)
    assert (tmp_path / tool.CLONE / "setup.py").read_bytes() == (ROOT / "setup.py").read_bytes()
    assert kept.exists()
    assert not built.exists(), "what was built into the clone is gone, so make must build it again"
    assert not old.exists()
    assert not list((tmp_path / tool.CLONE).rglob("__pycache__"))


def test_a_table_says_what_passed_failed_and_was_not_run(tool: ModuleType, tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text("...\n==== 2 failed, 7 passed, 1 skipped in 3.21s ====\nmake: *** [test] Error 1\n")
    failed = tool.Done(2, 3.4, tool.summary("test", log))
    rows = [("debian-13", "3.13.5, 3.10.12.0, 2.3.5", {"setup": tool.Done(0, 61.0, ""), "test": failed})]
    assert tool.table(("setup", "demo", "test"), rows).splitlines()[2:] == [
        "| debian-13 | 3.13.5, 3.10.12.0, 2.3.5 | passed, 61 s | not run | "
        "failed (2), 3 s: 2 failed, 7 passed, 1 skipped in 3.21s |"
    ]


def test_a_keyring_that_this_machine_lacks_comes_from_the_archive_by_its_checksum(
    tool: ModuleType, tmp_path: Path
) -> None:
    if shutil.which("dpkg-deb") is None:
        pytest.skip("needs dpkg-deb")
    keyring = Path("/usr/share/keyrings/of-the-test.gpg")
    tree = tmp_path / "tree"
    for name, text in ((str(keyring)[1:], "keys"), ("DEBIAN/control", CONTROL)):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        (tree / name).write_text(text)
    package = tmp_path / "keyring.deb"
    subprocess.run(["dpkg-deb", "--build", str(tree), str(package)], check=True, capture_output=True)
    family = partial(tool.Family, "sid", "main", str(keyring), package.as_uri())
    good = family(hashlib.sha256(package.read_bytes()).hexdigest())
    assert Path(tool.keyring_of(good, tmp_path / "kept")).read_text() == "keys"
    package.unlink()  # it is kept
    assert Path(tool.keyring_of(good, tmp_path / "kept")).read_text() == "keys"
    package.write_bytes(b"other bytes")
    with pytest.raises(SystemExit, match=r"has the SHA-256 .*, not "):
        tool.keyring_of(good, tmp_path / "other")
    with pytest.raises(SystemExit, match=r"is missing; apt install of-the-test"):
        tool.keyring_of(tool.Family("sid", "main", str(keyring)), tmp_path / "third")
