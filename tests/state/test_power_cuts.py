"""Power cuts at any moment: what a robot has done to its files is recorded by strace, and cut off after each call.

A disk may have lost all that was not synced, kept all of it, or kept names without content and parts of a write.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.state.airtime import AirtimeFile
from gr_ros2.state.boots import BootFile
from gr_ros2.state.keys import new_key_file, read_key_file

ROBOT = """
import json, os, sys
from pathlib import Path
from gr_ros2.state.airtime import AirtimeFile
from gr_ros2.state.boots import BootFile
from gr_ros2.state.keys import new_key_file, read_key_file

def said(**values):
    os.write(1, json.dumps(values).encode())

folder = Path(sys.argv[1])
new_key_file(folder / "key")
said(key=read_key_file(folder / "key")[0].hex())
for start in range(3):
    boots = BootFile(folder / "state", 5.0, start, sealed=True)
    said(start=boots.boot >> 32)
    account = AirtimeFile(folder / "account")
    spent = sum(airtime for _, airtime in account.spent)
    for number in range(1, 4):
        boots.save(3, 77, 10 * start + number)
        said(floor=10 * start + number)
        account.save([(1e6, spent + number)])
        said(spent=spent + number)
    account.close()
"""
CALLS = "openat,write,pwrite64,ftruncate,fsync,fdatasync,rename,unlink"


@dataclass
class File:
    """A file on a disk, with what is there for sure."""

    synced: bytes = b""
    now: bytes = b""

    def after(self, cut: str) -> bytes:
        """What a power cut leaves."""
        if cut != "part":
            return self.now if cut == "kept" else self.synced
        old = self.synced.ljust(len(self.now), b"\0")
        changed = [n for n, byte in enumerate(self.now) if byte != old[n]] or [0]
        middle = (changed[0] + changed[-1]) // 2
        return self.now[:middle] + old[middle:]


@dataclass
class Disk:
    """A folder as calls change it, and what its robot has said that it has stored."""

    folder: str
    synced: dict[str, File] = field(default_factory=dict)
    now: dict[str, File] = field(default_factory=dict)
    places: dict[int, int] = field(default_factory=dict)
    said: dict[str, Any] = field(default_factory=dict)

    def happens(self, call: str, words: str, texts: list[bytes], numbers: list[int]) -> None:
        """One call that succeeded."""
        paths = [text.decode("latin1") for text in texts]
        if call == "write" and numbers[0] == 1:
            self.said |= json.loads(texts[-1])
        elif call == "openat" and paths[1].startswith(self.folder):
            file = self.now.get(paths[1]) if paths[1] != self.folder else File()
            if file is None or "O_TRUNC" in words:
                file = self.now.setdefault(paths[1], File())
                file.now = b""
            self.places[numbers[-1]] = 0
        elif call == "rename" and paths[0].startswith(self.folder):
            self.now[paths[1]] = self.now.pop(paths[0])
        elif call == "unlink" and paths[0].startswith(self.folder):
            del self.now[paths[0]]
        elif paths[0] == self.folder and call == "fsync":
            self.synced = dict(self.now)
        elif (file := self.now.get(paths[0])) is not None:
            if call in ("fsync", "fdatasync"):
                file.synced = file.now
            elif call == "ftruncate":
                file.now = file.now[: numbers[1]].ljust(numbers[1], b"\0")
            else:
                at = numbers[2] if call == "pwrite64" else self.places[numbers[0]]
                file.now = file.now[:at].ljust(at, b"\0") + texts[1] + file.now[at + len(texts[1]) :]
                self.places[numbers[0]] = at + len(texts[1])

    def cut(self, folder: Path, names: dict[str, File], cut: str) -> None:
        """Write what a power cut leaves into a folder."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for path, file in names.items():
            copy = folder / Path(path).name
            copy.write_bytes(file.after(cut))
            copy.chmod(0o600)


def calls(trace: Path) -> Iterator[tuple[str, str, list[bytes], list[int]]]:
    """The calls that succeeded: name, words, texts and paths, numbers."""
    for line in trace.read_text().splitlines():
        match = re.fullmatch(r"\d+ +(\w+)\((.*)\) += (\d+)(<.*>)?", line)
        if match is None:
            continue
        quoted = r'(?:"|<)((?:\\x[0-9a-f]{2})*)(?:"|>)'
        texts = [bytes.fromhex(found.replace("\\x", "")) for found in re.findall(quoted, match[2])]
        bare = re.sub(quoted, "", match[2])
        yield match[1], bare, texts, [*map(int, re.findall(r"(?<![\w])\d+", bare)), int(match[3])]


def check(disk: Disk, folder: Path) -> None:
    """The next start finds what the robot has said, or more."""
    said = disk.said
    try:
        assert read_key_file(folder / "key")[0].hex() == said.get("key", read_key_file(folder / "key")[0].hex())
    except ConfigError:
        assert "key" not in said
    boots = BootFile(folder / "state", 1.0, 0, sealed=True)
    assert boots.boot >> 32 > said.get("start", 0)
    assert boots.heard.get(3, (77, 0))[1] >= said.get("floor", 0)
    account = AirtimeFile(folder / "account")
    assert sum(airtime for _, airtime in account.spent) >= said.get("spent", 0.0)
    account.close()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace")
def test_after_a_power_cut_everything_is_there_that_was_said_to_be_stored(tmp_path: Path) -> None:
    folder, trace = tmp_path / "robot", tmp_path / "trace"
    folder.mkdir()
    strace = ["strace", "-f", "-y", "-xx", "-s", "16384", "-e", f"trace={CALLS}", "-o", str(trace)]
    done = subprocess.run([*strace, sys.executable, "-c", ROBOT, str(folder)], capture_output=True, check=False)
    if b"ptrace" in done.stderr:
        pytest.skip("strace may not trace here")
    assert done.returncode == 0, done.stderr
    disk, cuts = Disk(str(folder)), 0
    for call in calls(trace):
        disk.happens(*call)
        for names in (disk.synced, disk.now):
            for cut in ("lost", "part", "kept"):
                disk.cut(tmp_path / "after", names, cut)
                check(disk, tmp_path / "after")
                cuts += 1
    assert round(disk.said["spent"], 3) == 9
    assert cuts > 500
    assert {path.name for path in folder.iterdir()} == {Path(path).name for path in disk.now} - {folder.name}


def test_a_key_that_was_cut_off_is_said_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "key").touch(0o600)
    with pytest.raises(ConfigError, match=r"no key in it; restore it, or delete it and run gr-ros2 key new .*key"):
        read_key_file(tmp_path / "key")
    (tmp_path / "key").unlink()
    new_key_file(tmp_path / "key")
