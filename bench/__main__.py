"""`python -m bench [NAME …]`: measure, print a table, exit with 1 if a target was missed.

Without names everything but what takes very long.
"""

from __future__ import annotations

import sys
import time
from importlib import import_module

from rich.console import Console

from bench.rows import Row, table

BENCHMARKS = {
    "gate": "bench.gate",
    "codec": "bench.codec",
    "repair": "bench.repair",
    "repair_backlog": "bench.repair_backlog",
    "repair_runs": "bench.repair_runs",
    "saturated": "bench.saturated",
    "bound": "bench.bound",
    "endpoint": "bench.endpoint",
    "hostile": "bench.hostile",
    "port": "bench.port",
    "live": "bench.live",
    "live_image": "bench.live_image",
    "radios": "bench.radios",
    "constants": "bench.constants",
    "direct": "bench.runs",
    "fast": "bench.runs",
    "ofdm": "bench.runs",
    "recording": "bench.runs",
    "links": "bench.links",
    "rate": "bench.rate",
    "rate_rules": "bench.rate_rules",
    "receivers": "bench.receivers",
    "half_points": "bench.receivers",
    "rates": "bench.rates",
    "kernels": "bench.phys",
    "drive": "bench.phys",
    "beside": "bench.phys",
    "start": "bench.start",
    "stop": "bench.stop",
    "reopen": "bench.reopen",
    "slow_computer": "bench.slow_computer",
    "compression": "bench.compression",
    "codecs": "bench.codecs",
    "cameras": "bench.cameras",
    "clouds": "bench.clouds",
    "maps": "bench.maps",
    "sweep": "bench.sweep",
    "mac": "bench.mac",
    "cells": "bench.mac",
    "first": "bench.mac",
    "hidden": "bench.mac",
    "changes": "bench.mac",
    "scale": "bench.mac",
    "crowd": "bench.mac",
    "energy": "bench.mac",
    "shared": "bench.shared",
    "relay": "bench.relay",
    "carried": "bench.relay",
    "reliable": "bench.reliable",
    "sound": "bench.sound",
    "sound_beside": "bench.sound",
    "sound_recorded": "bench.sound_recorded",
    "sound_live": "bench.sound_live",
    "backfill": "bench.backfill",
    "race_profiles": "bench.race_profiles",
}
"""Name of each benchmark, which is a function of the module it stands in."""
LONG = (
    *("half_points", "rate", "drive", "sweep", "hostile", "live_image", "constants", "mac", "relay", "reliable"),
    *("gate", "rate_rules", "cells", "first", "hidden", "changes", "scale", "crowd", "energy", "cameras", "clouds"),
    *("sound", "sound_beside", "sound_recorded", "sound_live", "backfill", "race_profiles"),
)
"""Many minutes, or parts of ``mac``: only when named."""


def main(names: list[str]) -> int:
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        print(f"bench: no {unknown[0]!r}; known are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=160)
    rows: list[Row] = []
    for name in names or [name for name in BENCHMARKS if name not in LONG]:
        begin = time.monotonic()
        with console.status(f"{name} …"):
            rows += getattr(import_module(BENCHMARKS[name]), name)()
        console.print(f"{name}: {time.monotonic() - begin:.0f} s")
    console.print(table(rows))
    return 0 if all(row.met for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
