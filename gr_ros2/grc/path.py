"""Where GRC finds our block descriptions, and how to make it look there.

Invariant: GRC has no discovery of its own for Python packages and does not look into a virtual environment; it reads
`local_blocks_path` from section `[grc]` of the user's preferences. ``install`` adds our folder there, keeps every
other line as it is, and does nothing the second time.

GNU Radio up to 3.10.9 reads `~/.gnuradio/config.conf`; later ones prefer `$XDG_CONFIG_HOME/gnuradio` (by default
`~/.config/gnuradio`) where that folder exists (gnuradio#7136); all take `$GR_PREFS_PATH` above both.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

from gr_ros2.core.errors import ConfigError, reason

_PACKAGE = Path(__file__).resolve().parent.parent
_FILE = "config.conf"
_SECTION = re.compile(r"\s*\[\s*([^\]]*?)\s*\]")
_KEY = re.compile(r"\s*local_blocks_path\s*=\s*(.*?)\s*$", re.IGNORECASE)


def grc_path() -> Path:
    """The folder of `*.block.yml` files."""
    return _PACKAGE / "grc"


def example(name: str) -> Path:
    """A file beside the example flowgraphs.

    :raises ConfigError: when there is none of that name
    """
    path = _PACKAGE / "examples" / name
    if not path.is_file():
        raise ConfigError(f"no example {name!r} in {path.parent}")
    return path


def preference_files(environ: Mapping[str, str]) -> list[Path]:
    """The user's GNU Radio preference files that some installed version may read, the one of 3.10 first."""
    if environ.get("GR_PREFS_PATH"):
        return [Path(environ["GR_PREFS_PATH"]) / _FILE]
    home = Path(environ.get("HOME") or Path.home())
    newer = Path(environ.get("XDG_CONFIG_HOME") or home / ".config") / "gnuradio"
    return [home / ".gnuradio" / _FILE, *([newer / _FILE] if newer.is_dir() else [])]


def install(environ: Mapping[str, str] = os.environ) -> Path:
    """Make GRC find the folder from now on.

    :returns: the preference file that GNU Radio 3.10 reads
    :raises ConfigError: when a file cannot be read or written, or the path of our folder cannot be written in one
    """
    folder = str(grc_path())
    if any(letter in folder for letter in '"#\n' + os.pathsep):
        raise ConfigError(f"{folder}: GNU Radio's preferences cannot name this folder; move it or set GRC_BLOCKS_PATH")
    files = preference_files(environ)
    for file in files:
        try:
            before = file.read_text(encoding="utf-8") if file.exists() else ""
            after = with_blocks_path(before, folder)
            if after != before:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(after, encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(
                f"{file}: cannot be changed ({reason(error)}); set GRC_BLOCKS_PATH={folder} instead"
            ) from error
    return files[0]


def uninstall(environ: Mapping[str, str] = os.environ) -> list[Path]:
    """Remove the folder from the preferences; all other lines stay.

    :returns: the files that were changed, or removed because nothing else was in them
    :raises ConfigError: when a file cannot be read or written
    """
    changed = []
    for file in preference_files(environ):
        try:
            before = file.read_text(encoding="utf-8") if file.exists() else ""
            after = without_blocks_path(before, str(grc_path()))
            if after == before:
                continue
            if after:
                file.write_text(after, encoding="utf-8")
            else:
                file.unlink()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{file}: cannot be changed ({reason(error)})") from error
        changed.append(file)
    return changed


def without_blocks_path(text: str, folder: str) -> str:
    """The text of a preference file without a folder in `local_blocks_path`, the rest unchanged.

    A setting and a section that are empty after that are removed too.
    """
    lines = text.splitlines(keepends=True)
    headings = [number for number, line in enumerate(lines) if _SECTION.match(line)]
    for heading, end in zip(headings, [*headings, len(lines)][1:], strict=True):
        section = _SECTION.match(lines[heading])
        if section is None or section[1].lower() != "grc":
            continue
        for number in range(heading + 1, end):
            setting = _KEY.match(lines[number])
            paths = [path for path in setting[1].strip('"').split(os.pathsep) if path] if setting is not None else []
            if folder not in paths:
                continue
            paths.remove(folder)
            lines[number] = _setting(paths) if paths else ""
            if not "".join(lines[heading + 1 : end]).strip():
                # An empty line before the section at the end of the file was ours too.
                before = heading - (end == len(lines) and heading > 0 and not lines[heading - 1].strip())
                del lines[before:end]
            return "".join(lines)
    return text


def with_blocks_path(text: str, folder: str) -> str:
    """The text of a preference file with a folder in `local_blocks_path`, the rest unchanged."""
    lines = text.splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        lines[-1] += "\n"
    heading = None
    in_section = False
    for number, line in enumerate(lines):
        section = _SECTION.match(line)
        if section is not None:
            in_section = section[1].lower() == "grc"
            heading = number if in_section and heading is None else heading
            continue
        setting = _KEY.match(line) if in_section else None
        if setting is not None:
            paths = [path for path in setting[1].strip('"').split(os.pathsep) if path]
            if folder in paths:
                return text
            lines[number] = _setting([*paths, folder])
            return "".join(lines)
    if heading is None:
        return "".join(lines) + ("\n" if lines else "") + "[grc]\n" + _setting([folder])
    lines.insert(heading + 1, _setting([folder]))
    return "".join(lines)


def _setting(paths: list[str]) -> str:
    value = os.pathsep.join(paths)
    # GNU Radio drops the white space of a value unless it stands in quotes.
    return f'local_blocks_path = "{value}"\n' if re.search(r"\s", value) else f"local_blocks_path = {value}\n"
