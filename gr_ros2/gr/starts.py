"""The files in which a robot keeps what outlives it."""

from __future__ import annotations

import os
from pathlib import Path


def account_of(state: str, robot_id: int, radio: int = 0) -> Path:
    """The file of a robot's airtime account, beside its state file.

    :param state: its state file, '' = the usual one
    :param radio: which of its radios, from 0 on
    """
    return state_file(state, robot_id).with_suffix(f".{radio + 1}.airtime" if radio else ".airtime")


def bound_state_file(state: str, robot_id: int, radio: int) -> Path:
    """The file that counts the starts of the endpoint that has one radio alone, beside that of its robot.

    :param state: state file of the robot, '' = the usual one
    :param radio: which of its radios, from 0 on
    """
    return state_file(state, robot_id).with_suffix(f".{radio + 1}.bound.json")


def state_file(state: str, robot_id: int) -> Path:
    """The file that counts a robot's starts.

    :param state: as its settings name it, '' = the usual one
    """
    return Path(state).expanduser() if state else state_folder() / f"robot_{robot_id}.json"


def state_folder() -> Path:
    """The folder for the state files of robots, inside the XDG folder for state."""
    base = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return Path(base).expanduser() / "gr_ros2"
