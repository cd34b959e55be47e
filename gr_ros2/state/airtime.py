"""The file that keeps a robot's airtime account from one start to the next.

Two pages of fixed length are written in turn, in place. So a power cut damages one page at most, and leaves the one
before; and a disk that is full takes the page all the same, since the file does not grow.

*Time.* While the computer runs, its time since boot tells how long ago a page was written, whatever happens to the wall
clock. After the computer was off, the wall clock tells, but no less time than since boot. Where neither has advanced,
what was spent counts as spent just now.

Invariants: ``save`` returns after the page is on the disk; one link at a time uses a file.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from zlib import crc32

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import replacing

PAGE = 4096
"""Bytes of a page. 60 bins take less than half of it."""
_LOG = logging.getLogger("gr_ros2.state.airtime")
_UPTIME = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)

Spent = Sequence[tuple[float, float]]
"""Airtime and until when it counts as being sent: (s after the present moment, may be negative; s of airtime)."""


def boot_id() -> str:
    """What Linux calls this boot of the computer; '' where there is no such name, so that the wall clock counts."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""


class AirtimeFile:
    """The account of one transmitter.

    :param path: need not exist; its folder neither
    :param wall: s since 1970
    :param uptime: s since this computer was switched on, suspended time included
    :param boot: name of this boot of the computer
    :raises ConfigError: another link uses the file, it cannot be opened, or it is not such a file
    """

    def __init__(
        self,
        path: str | Path,
        *,
        wall: Callable[[], float] = time.time,
        uptime: Callable[[], float] = lambda: time.clock_gettime(_UPTIME),
        boot: str | None = None,
    ) -> None:
        self._path = Path(path).absolute()
        self._wall, self._uptime = wall, uptime
        self._boot = boot_id() if boot is None else boot
        self._file: int | None = None
        self._turn = 0
        self._said = self._closed = False
        self.spent: Spent = ()
        """What earlier starts have spent or reserved, as of now."""
        try:
            self._open()
            self.spent = self._read()
        except (FileNotFoundError, NotADirectoryError):
            pass  # ``save`` makes it, or says what is wrong
        except BaseException as error:
            self.close()
            if not isinstance(error, OSError):
                raise
            raise ConfigError(
                f"{self._path}: cannot be opened ({error.strerror}), so what was sent would be forgotten; let this "
                "user write it (sudo chown), or run the link as its owner"
            ) from error

    def save(self, spent: Spent) -> None:
        """Store an account.

        :raises ConfigError: it cannot be stored, or this object is closed
        """
        if self._closed:
            raise ConfigError(f"{self._path}: the link that used it is closed")
        page = self._page(self._turn + 1, spent)
        try:
            if self._file is None:
                self._make(page)
            else:
                os.pwrite(self._file, page, (self._turn + 1) % 2 * PAGE)
                os.fdatasync(self._file)
        except OSError as error:
            problem = f"{self._path}: cannot be written ({error.strerror}), so nothing is sent until it can: {_WHY}"
            if not self._said:
                self._said = True
                _LOG.error("%s", problem)
            raise ConfigError(problem) from error
        self._turn += 1
        if self._said:
            self._said = False
            _LOG.warning("%s: can be written again", self._path)

    def close(self) -> None:
        """Let another link use the file. Idempotent."""
        self._closed = True
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _make(self, page: bytes) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(self._path, durable=True) as part:
            pages = (page, bytes(PAGE)) if (self._turn + 1) % 2 == 0 else (bytes(PAGE), page)
            part.write_bytes(b"".join(pages))
        self._open()

    def _open(self) -> None:
        self._file = os.open(self._path, os.O_RDWR | os.O_CLOEXEC)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._file)
            self._file = None
            raise ConfigError(
                f"{self._path}: another link of this robot uses it; end that one, or give this one another robot_id or "
                "state"
            ) from None

    def _page(self, turn: int, spent: Spent) -> bytes:
        values = {
            "turn": turn,
            "boot": self._boot,
            "uptime": round(self._uptime(), 3),
            "wall": round(self._wall(), 3),
            "spent": [[round(until, 3), round(airtime + 5e-7, 6)] for until, airtime in spent],
        }
        text = json.dumps(values, separators=(",", ":")).encode("ascii")
        page = b"%08x %s\n" % (crc32(text), text)
        if len(page) > PAGE:
            raise ConfigError(f"{self._path}: an account of {len(spent)} parts does not fit; report this as a defect")
        return page.ljust(PAGE)

    def _read(self) -> Spent:
        assert self._file is not None
        pages = [values for n in range(2) if (values := _values(os.pread(self._file, PAGE, n * PAGE))) is not None]
        if not pages:
            raise ConfigError(
                f"{self._path}: no airtime account of a link, or a damaged one; delete it when this robot has sent "
                "nothing for airtime.window_s"
            )
        newest = max(pages, key=lambda values: int(values["turn"]))
        self._turn = int(newest["turn"])
        uptime = self._uptime()
        if self._boot and newest["boot"] == self._boot:
            ago = max(uptime - newest["uptime"], 0.0)
        else:
            ago = max(uptime, self._wall() - newest["wall"])
        return [(float(until) - ago, float(airtime)) for until, airtime in newest["spent"]]


_WHY = "a limit that a restart forgets is no limit; make room on the disk"


def _values(page: bytes) -> dict[str, Any] | None:
    """The content of a page, None for one that was never written or not completely."""
    checksum, _, text = page.rstrip(b" \n\0").partition(b" ")
    try:
        if int(checksum, 16) != crc32(text):
            return None
        values = json.loads(text)
        return values if isinstance(values, dict) else None
    except ValueError:
        return None
