"""What repair delivers in a scenario, as `gr-ros2 run` runs it in simulated time: the table of `bench.repair`, on the
air of a radio. A packet leaves as soon as the air is free, and a repair on the air cannot be interrupted.

Odometry comes at 35 Hz from the simulator and from a recording.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from bench.repair import ODOMETRY
from bench.rows import Row, Sense
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.recordings import DRIVES

DRIVE = DRIVES[-1]
SPEED = 3.5
"""Its odometry comes at 10 Hz, and is played at 35 Hz."""


def repair_runs() -> list[Row]:
    """Odometry over the radio of paper-ofdm-paced."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        registry = Path(folder, "odom.csv")
        registry.write_text("odom,nav_msgs/msg/Odometry\n", encoding="utf-8")
        rows += _rows("simulated", {})
        bag = {"source": f"bag:{DRIVE.path}", "bag_speed": SPEED, "registry": str(registry)}
        rows += _rows(f"recorded ({DRIVE.path.name})", bag)
    return rows


def run(settings: dict[str, Any], loss: float, burst: float, repair: str, *, back: bool) -> Result:
    """One run; equal arguments give equal numbers."""
    channel: dict[str, Any] = {"packet_loss": loss}
    if burst > 1:
        leave = 1 / burst
        channel = {"burst_loss": {"p_good_to_bad": leave * loss / (1 - loss), "p_bad_to_good": leave}}
    reports: dict[str, Any] = {"robots": [{}, {"topics": []}]} if back else {}
    options = {**settings, **reports, "time": "packets", "channel": channel}
    return run_scenario(load_scenario("paper-ofdm-paced", [f"repair={repair}"], **options)).result


def _rows(source: str, settings: dict[str, Any]) -> list[Row]:
    rows: list[Row] = []

    def add(name: str, value: float, unit: str, sense: Sense, target: float) -> None:
        form = "{:,.0f}" if unit == "ms" else "{:.4f}"
        rows.append(Row(f"run: {source} odometry, {name}", value, unit, sense, target, form))

    for loss, burst, one_way, reports, _, p99 in ODOMETRY:
        name = f"{loss:.0%} lost" + (" in bursts of 3" if burst > 1 else "")
        for way, least in (("one-way", one_way), ("with reports", reports)):
            (odom,) = run(settings, loss, burst, "idle", back=way != "one-way").topics
            add(f"{name}, {way}: PDR", odom.pdr or 0.0, "", "≥", least)
            if p99 is not None:
                add(f"{name}, {way}: p99", (odom.latency_s.p99 or 0.0) * 1e3, "ms", "≤", p99)
    for loss in (0.0, 0.2):
        result = run(settings, loss, 1.0, "thrifty", back=True)
        (odom,) = result.topics
        repaired = result.packets["air_repair"] / odom.sent
        if not loss:
            add("0% lost, thrifty: repairs a message", repaired, "", "≤", 0.0)
            continue
        packets = result.packets["air_new"] / odom.sent + repaired
        add("20% lost, thrifty: PDR", odom.pdr or 0.0, "", "≥", 0.998)
        add("20% lost, thrifty: p99", (odom.latency_s.p99 or 0.0) * 1e3, "ms", "≤", 250)
        add("20% lost, thrifty: packets a message", packets, "", "≤", 1.65)
    return rows
