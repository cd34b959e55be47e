"""C++ programs and drivers of the tests, compiled once for all processes of a clone."""

from __future__ import annotations

import fcntl
import hashlib
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pytest


def compiled(
    config: pytest.Config, source: Path, name: str, options: Sequence[str], headers: Sequence[Path] = ()
) -> Path:
    """A file that ``g++`` makes of one source, alone in a folder of its own; kept until sources or options change.

    :param name: of the file
    :param headers: which the source includes from other folders
    :param options: of ``g++``; those behind the source are libraries (``-l…``)
    """
    texts = b"".join(each.read_bytes() for each in (source, *headers))
    number = hashlib.sha256(texts + repr(options).encode()).hexdigest()[:16]
    folder = config.rootpath / ".pytest_cache" / "compiled" / f"{source.stem}-{number}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the others wait until one has made it
        if not folder.exists():
            with tempfile.TemporaryDirectory(dir=folder.parent) as fresh:
                made = Path(fresh) / "made"
                made.mkdir()
                libraries = [option for option in options if option.startswith("-l")]
                others = [option for option in options if option not in libraries]
                others += [f"-I{header.parent}" for header in headers]
                command = ["g++", *others, "-O1", "-o", str(made / name), str(source), *libraries]
                done = subprocess.run(command, capture_output=True, text=True)
                assert done.returncode == 0, done.stderr
                made.rename(folder)
    return folder / name
