"""A sweep that needs no flowgraph: the paper's direct loopback with lost packets, on simulated time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from gr_ros2_lab.study.sweep.definition import SweepPlan, load_sweep

DIRECT: Mapping[str, Any] = {
    "scenario": "paper-direct",
    "description": "lost packets",
    "time": "packets",
    "set": {"duration_s": 1},
    "grid": {"channel.packet_loss": [0.0, 0.01, 0.1]},
    "repetitions": 2,
}


def write_sweep_file(folder: Path, **changes: Any) -> Path:
    """``DIRECT`` with some keys changed, as a file; None leaves a key out."""
    values = {key: value for key, value in {**DIRECT, **changes}.items() if value is not None}
    path = folder / "lost.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return path


def plan(folder: Path, **changes: Any) -> SweepPlan:
    return load_sweep(write_sweep_file(folder, **changes))
