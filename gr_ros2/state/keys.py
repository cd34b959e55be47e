"""The file of a fleet's keys: one key per line, 64 hex digits; the first seals, all are accepted.

Invariants: a key file that other users may read or write is refused; an existing file is never overwritten; a new key
is on the disk before anybody is told that it exists.
"""

from __future__ import annotations

import os
import re
import secrets
import stat
from pathlib import Path

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import sync

_LIKE_A_KEY = re.compile(r"(0[xX])?[0-9a-fA-F:]{32,}")
"""A setting that nobody means as a path. It must not be repeated in an error or a log."""
KEY_LEN = 32
"""Bytes of a key."""


def new_key_file(path: str | Path) -> None:
    """Make a file with one new key, readable and writable by its owner only.

    :raises ConfigError: it exists, or cannot be written
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise ConfigError(f"{path}: exists; a key is never overwritten, so choose another name") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror})") from error
    try:
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(
                "# Key of a gr-ros2 fleet: the first line seals, all are accepted. Keep it secret.\n"
                f"{secrets.token_hex(KEY_LEN)}\n"
            )
            file.flush()
            os.fsync(file.fileno())
        sync(Path(path).absolute().parent)
    except OSError as error:
        Path(path).unlink()  # nobody has seen the key
        raise ConfigError(f"{path}: cannot be written ({error.strerror})") from error


def checked_key_file(path: str) -> str:
    """The path, if it is not a key by mistake.

    :raises ValueError: it looks like a key, which the message does not repeat
    """
    if _LIKE_A_KEY.fullmatch(Path(path.strip()).name):
        raise ValueError("must be the path of a key file, and is a key itself; make a file with gr-ros2 key new FILE")
    return path


def read_key_file(path: str | Path) -> tuple[bytes, ...]:
    """The keys of a file, at least one.

    :raises ConfigError: the file cannot be read, other users may read it, or it holds something other than keys
    """
    try:
        checked_key_file(str(path))
    except ValueError as error:
        raise ConfigError(f"key: {error}") from None
    try:
        with open(path, encoding="ascii") as file:
            others = stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o077
            lines = [line.split("#")[0].strip() for line in file]
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: no key file; make one with gr-ros2 key new FILE") from None
    if others:
        raise ConfigError(f"{path}: other users may read or write it; run chmod 600 {path}")
    keys: list[bytes] = []
    for number, line in enumerate(lines, 1):
        if line:
            try:
                keys.append(bytes.fromhex(line))
            except ValueError:
                keys.append(b"")
            if len(keys[-1]) != KEY_LEN:
                raise ConfigError(f"{path}:{number}: not {2 * KEY_LEN} hex digits; make one with gr-ros2 key new FILE")
    if not keys:
        raise ConfigError(f"{path}: no key in it; restore it, or delete it and run gr-ros2 key new {path}")
    return tuple(keys)
