"""Files that are written completely or not at all.

Invariants: a file under its final name is always complete, the old one or the new one; after an error no partial file
is left behind.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gr_ros2.core.errors import ConfigError


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A temporary path next to ``path`` to write to; at the end of the ``with`` statement it replaces ``path``.

    :param durable: also wait until the new file is on the disk, so that it survives a power cut
    :raises OSError: the file cannot be written
    """
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        if durable:
            sync(part)
        part.replace(path)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise
    if durable:
        sync(path.parent)


def write_whole(path: Path, content: Any, write: Callable[[Any, Path], object]) -> Path:
    """Write a table or text to a file; its folder is made if missing.

    :param write: called with the content and the path to write to
    :raises ConfigError: the file cannot be written
    """
    make_folder(path.parent)
    try:
        with replacing(path) as part:
            write(content, part)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
    return path


def write_text(text: str, path: Path) -> None:
    """Write a text in UTF-8; for :func:`write_whole`."""
    path.write_text(text, encoding="utf-8")


def make_folder(path: Path) -> Path:
    """Make the folder if it is missing, and return it.

    :raises ConfigError: when it cannot be made
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error}); choose another folder") from error
    return path


def check_folder(path: Path) -> None:
    """Whether files can be written there later; nothing is left.

    :raises ConfigError: they cannot
    """
    there = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
    try:
        with TemporaryDirectory(dir=there):
            pass
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error}); choose another folder") from error


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk.

    :raises OSError: they cannot be written
    """
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
