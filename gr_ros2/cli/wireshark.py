"""`gr-ros2 wireshark`: print the path of the dissector, or install it for Wireshark."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import click

from gr_ros2.core.errors import ConfigError

DISSECTOR = Path(__file__).resolve().parent.parent / "wireshark" / "gr_ros2.lua"


def plugin_folder() -> Path:
    """Folder in which Wireshark and tshark 2.6 and later look for a user's own Lua plugins."""
    return Path(os.environ.get("HOME") or Path.home()) / ".local" / "lib" / "wireshark" / "plugins"


@click.command("wireshark")
@click.option("--install", is_flag=True, help="Copy it to where Wireshark looks for your plugins.")
def wireshark(install: bool) -> None:
    """Print the path of the Wireshark dissector for captures made with --pcap."""
    if not install:
        print(DISSECTOR)
        return
    target = plugin_folder() / DISSECTOR.name
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(DISSECTOR, target)
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written ({error.strerror}); copy {DISSECTOR} by hand") from error
    print(target)
