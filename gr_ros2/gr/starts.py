"""The start of a robot: its number, its keys, and the files in which it keeps what outlives it."""

from __future__ import annotations

import os
import secrets
import time
from dataclasses import replace
from pathlib import Path

from gr_ros2.gr.factory import EndpointSetup, keys_of
from gr_ros2.settings.config import SinkConfig, SourceConfig
from gr_ros2.state.boots import RANDOM_BITS, BootFile


def start_of(config: SourceConfig | SinkConfig, src_id: int, setup: EndpointSetup) -> EndpointSetup:
    """Count this start of a robot in its state file, and read the robot's keys.

    :param src_id: id of the robot, -1 for a robot that sends nothing
    :param setup: what is known of its radio
    :raises ConfigError: for a key file or a state file that cannot be read or understood
    """
    keys = keys_of(config)
    if not config.version:
        return setup
    setup = replace(setup, keys=keys)
    if not config.state and not config.key and src_id < 0:
        return replace(setup, boot=int(time.time()) << RANDOM_BITS | secrets.randbits(RANDOM_BITS))
    file = BootFile(
        _state_file(config.state, src_id), time.time(), secrets.randbits(RANDOM_BITS), sealed=keys is not None
    )
    return replace(setup, boot=file.boot, heard=file.heard, save=file.save, close=file.close)


def account_of(state: str, robot_id: int) -> Path:
    """The file of a robot's airtime account, beside its state file.

    :param state: its state file, '' = the usual one
    """
    return _state_file(state, robot_id).with_suffix(".airtime")


def _state_file(state: str, robot_id: int) -> Path:
    return Path(state).expanduser() if state else state_folder() / f"robot_{robot_id}.json"


def state_folder() -> Path:
    """The folder for the state files of robots, inside the XDG folder for state."""
    base = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return Path(base).expanduser() / "gr_ros2"
