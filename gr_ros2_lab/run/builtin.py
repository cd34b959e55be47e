"""The scenarios that come with gr-ros2, by name."""

from __future__ import annotations

from pathlib import Path

SCENARIO_DIR = Path(__file__).resolve().parent.parent / "scenarios"


def builtin_scenarios() -> list[str]:
    """Their names, sorted."""
    return sorted(path.stem for path in SCENARIO_DIR.glob("*.yaml"))
