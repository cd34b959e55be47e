"""60 cells of 38 s each on two processes: by samples, with the flowgraph, and by packets, with its table of losses."""

from __future__ import annotations

import time
from math import sqrt
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

from bench.rows import Row
from gr_ros2_lab.medium.loss_table import PACKETS
from gr_ros2_lab.study.sweep.definition import load_sweep
from gr_ros2_lab.study.sweep.run import run_sweep
from gr_ros2_lab.study.sweep.summaries import ALL, Summary, rows_of, summaries

WORKERS = 2
MOST = 0.4
"""Time by packets over that by samples."""
CELLS = {
    "scenario": "paper-ofdm-paced",
    "grid": {
        "channel.snr_db": [10.0 + 0.5 * step for step in range(12)],
        "sim.odom_rate": [15, 20, 25, 30, 35],
    },
}
_FAR = 2.58
"""Standard deviations within which 99 of 100 differences by chance lie."""


def sweep() -> list[Row]:
    """How long 60 cells take, and whether both ways of running them say the same."""
    with TemporaryDirectory() as folder:
        first_s, _ = _run(Path(folder), "packets", "first")
        packets_s, packets = _run(Path(folder), "packets", "packets")
        samples_s, samples = _run(Path(folder), "samples", "samples")
    apart = [_difference(*pair) for pair in zip(packets, samples, strict=True)]
    deviations = [_deviations(*pair) for pair in zip(packets, samples, strict=True)]
    mean = sum(apart) / len(apart)
    note = f"largest {max(apart, key=abs):+.3f}"
    return [
        Row(f"{len(samples)} cells of 38 s by samples", samples_s, "s"),
        Row(
            f"{len(packets)} cells of 38 s: time by packets over that by samples",
            packets_s / samples_s,
            "",
            "≤",
            MOST,
            "{:.2f}",
            f"{packets_s:.0f} s, the first time {first_s:.0f} s",
        ),
        Row("PDR by packets less that by samples, mean", mean, "", form="{:+.4f}", note=note),
        Row("cells that differ by more than chance (99 %)", sum(one > _FAR for one in deviations), "", "≤", 3),
    ]


def _run(folder: Path, clock: str, name: str) -> tuple[float, list[Summary]]:
    """Seconds it took, and what all topics together say of each cell."""
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump({**CELLS, "time": clock}), encoding="utf-8")
    begin = time.monotonic()
    plan = load_sweep(file)
    results = run_sweep(plan, folder / name, workers=WORKERS).results
    took = time.monotonic() - begin
    return took, [one for one in summaries(plan, rows_of(plan, results)) if one.topic == ALL]


def _difference(one: Summary, other: Summary) -> float:
    return one.delivered / one.sent - other.delivered / other.sent


def _deviations(packets: Summary, samples: Summary) -> float:
    """How many standard deviations of their difference two PDRs are apart; the table of losses has one too."""
    pooled = (packets.delivered + samples.delivered + 1) / (packets.sent + samples.sent + 2)
    spread = sqrt(pooled * (1 - pooled) * (1 / packets.sent + 1 / samples.sent + 1 / PACKETS))
    return abs(_difference(packets, samples)) / spread
