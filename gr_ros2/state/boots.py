"""What a robot keeps from one start to the next: its boot number, and the newest packet heard of each other robot.

A boot number begins with a number that is greater than all earlier ones and at least the wall clock's seconds, so that
it also grows if the file is lost, and if the clock is set back. It ends in random bits, so that two robots which have
one id by mistake, and a robot whose file cannot be written, never repeat a start.

A file that cannot be written (a full disk) does not keep a robot from its link: this is logged once, and each further
call tries again.

Invariants: the file is replaced as a whole, and is on the disk before a call returns, so a power cut leaves the old or
the new file; one process at a time uses a file, as long as a link of it is open; what sealed and other links have heard
is kept apart, because anybody can make a robot hear something on a link without a key.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from weakref import WeakValueDictionary

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import replacing

RANDOM_BITS = 32
"""Random bits at the end of a boot number."""
_LARGEST = (1 << 32) - 1
_LOG = logging.getLogger("gr_ros2.state.boots")


class _Lock:
    """Keeps other processes from a state file as long as this object lives.

    :param path: path of the state file
    :raises ConfigError: another process uses it
    :raises OSError: the lock cannot be made
    """

    def __init__(self, path: Path) -> None:
        self._file = path.with_name(f".{path.name}.lock").open("ab+", buffering=0)
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.seek(0)
            holder = self._file.read().decode("ascii", "replace").strip() or "of another user"
            raise ConfigError(
                f"{path}: process {holder} uses it, so a link of this robot runs already; end that one, or give "
                "this one another robot_id or state"
            ) from None
        self._file.truncate(0)
        with suppress(OSError):  # a full disk: the lock holds all the same
            self._file.write(b"%d\n" % os.getpid())

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            self._file.close()


_LOCKS: WeakValueDictionary[tuple[int, Path], _Lock] = WeakValueDictionary()
"""Locks that this process holds, by process id and file. Links of one process share a lock."""


class BootFile:
    """The state file of one robot.

    :param path: path of the file, which need not exist
    :param wall_clock: seconds since 1970
    :param bits: ``RANDOM_BITS`` random bits
    :param sealed: whether the link is sealed
    :raises ConfigError: another process uses the file, or it cannot be read or understood
    """

    _lock: _Lock | None = None

    def __init__(self, path: str | Path, wall_clock: float, bits: int, *, sealed: bool) -> None:
        self._path = Path(path).absolute()
        self._said = self._closed = False
        with suppress(OSError):  # the attempt to write says what is wrong
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = _LOCKS.get((os.getpid(), self._path)) or _Lock(self._path)
            _LOCKS[os.getpid(), self._path] = self._lock
        self._start, self._all = self._read()
        self._heard = self._all["sealed" if sealed else "open"]
        before, self._start = self._start, min(max(self._start + 1, int(wall_clock)), _LARGEST)
        if self._start <= before:
            raise ConfigError(
                f"{self._path}: boot numbers are used up, since the clock of this robot was wrong once. Delete this "
                "file. Robots that this one hears too take it again by themselves. The others, if they have a key: "
                "delete their state files, and change the key"
            )
        self.boot = self._start << RANDOM_BITS | bits
        """Boot number of this start."""
        with suppress(ConfigError):  # it was logged
            self._write()

    @property
    def heard(self) -> Mapping[int, tuple[int, int]]:
        """By robot id: its newest boot number, and the packet number below which nothing more is accepted."""
        return self._heard

    def save(self, src_id: int, boot: int, floor: int) -> None:
        """Store up to which packet a robot has been heard.

        :raises ConfigError: the file cannot be written, or this object is closed
        """
        if self._closed:
            raise ConfigError(f"{self._path}: the link that used it is closed")
        self._heard[src_id] = (boot, floor)
        self._write()

    def close(self) -> None:
        """Let another process use the file, once all links of this one that use it are closed. Idempotent."""
        self._closed, self._lock = True, None

    def _read(self) -> tuple[int, dict[str, dict[int, tuple[int, int]]]]:
        try:
            values = json.loads(self._path.read_text("ascii"))
            heard = {
                name: {int(src_id): (int(boot), int(floor)) for src_id, (boot, floor) in values.get(name, {}).items()}
                for name in ("sealed", "open")
            }
            return int(values["boot"]), heard
        except FileNotFoundError:
            return 0, {"sealed": {}, "open": {}}
        except OSError as error:
            raise ConfigError(f"{self._path}: cannot be read ({error.strerror})") from error
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise ConfigError(f"{self._path}: no state file of a link ({error}); restore it, or change keys") from error

    def _write(self) -> None:
        text = json.dumps({"boot": self._start, **self._all})
        try:
            with replacing(self._path, durable=True) as part:
                part.write_text(text, encoding="ascii")
        except OSError as error:
            problem = f"{self._path}: cannot be written ({error.strerror})"
            if not self._said:
                self._said = True
                _LOG.warning(
                    "%s; the link runs. Until it can be written, nothing is taken that only this file could tell from "
                    "a replay: with a key, the messages of robots that cannot hear this one",
                    problem,
                )
            raise ConfigError(problem) from error
        if self._said:
            self._said = False
            _LOG.warning("%s: can be written again", self._path)
