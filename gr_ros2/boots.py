"""What a robot keeps from one start to the next: its boot number, and the newest packet heard of each other robot.

A boot number is greater than all earlier ones, and at least the wall clock's seconds. So it also grows if the file is
lost, and if the clock is set back.

Invariants: the file is replaced as a whole, and is on the disk before a call returns, so a power cut leaves the old or
the new file; a boot number is used only after it has been written.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from gr_ros2.errors import ConfigError
from gr_ros2.files import replacing

_LARGEST = (1 << 32) - 1


class BootFile:
    """The state file of one robot.

    :param path: path of the file, which need not exist; its folder must exist
    :param wall_clock: seconds since 1970
    :raises ConfigError: the file cannot be read, written or understood
    """

    def __init__(self, path: str | Path, wall_clock: float) -> None:
        self._path = Path(path)
        before, self._heard = self._read()
        self.boot = min(max(before + 1, int(wall_clock)), _LARGEST)
        """Boot number of this start."""
        if self.boot <= before:
            raise ConfigError(f"{self._path}: boot numbers are used up; make a new key and delete this file")
        self._write()

    @property
    def heard(self) -> Mapping[int, tuple[int, int]]:
        """By robot id: its newest boot number, and the packet number below which nothing more is accepted."""
        return self._heard

    def save(self, src_id: int, boot: int, floor: int) -> None:
        """Store up to which packet a robot has been heard.

        :raises ConfigError: the file cannot be written
        """
        self._heard[src_id] = (boot, floor)
        self._write()

    def _read(self) -> tuple[int, dict[int, tuple[int, int]]]:
        try:
            values = json.loads(self._path.read_text("ascii"))
            heard = {int(name): (int(boot), int(floor)) for name, (boot, floor) in values["heard"].items()}
            return int(values["boot"]), heard
        except FileNotFoundError:
            return 0, {}
        except OSError as error:
            raise ConfigError(f"{self._path}: cannot be read ({error.strerror})") from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"{self._path}: no state file of a link ({error}); restore it, or change keys") from error

    def _write(self) -> None:
        text = json.dumps({"boot": self.boot, "heard": {str(name): value for name, value in self._heard.items()}})
        try:
            with replacing(self._path, durable=True) as part:
                part.write_text(text, encoding="ascii")
        except OSError as error:
            raise ConfigError(f"{self._path}: cannot be written ({error.strerror})") from error
