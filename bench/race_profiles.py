"""The search for the profiles of the race's peers: one setting at a time around what they race with.

Each row is the 95th percentile of the age of odometry at 35 Hz, at a load of 50 % and with a fifth of all frames lost,
6 s each; the note has PDR, mean age and bytes on the air per message. Needs root.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import median
from typing import Any

from bench.rows import Row
from gr_ros2_lab.race.contenders import CONTENDERS
from gr_ros2_lab.race.measure import RaceCell
from gr_ros2_lab.race.race_settings import RaceSettings
from gr_ros2_lab.race.runner import run_race

LOSS, LOAD, SECONDS, SEEDS = 0.2, 0.5, 6.0, (0,)
_BUFFER = 'Internal/SocketSendBufferSize min="8kB" max="8kB"'
_DROP = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
TRIED: dict[str, list[dict[str, Any]]] = {
    "cyclone-reliable": [
        {},
        {"Internal/HeartbeatInterval": "20ms"},
        {"Internal/HeartbeatInterval": "50ms"},
        {"Internal/HeartbeatInterval": "100ms"},
        {"Internal/NackDelay": "0s"},
        {"Internal/NackDelay": "30ms"},
        {"Internal/NackDelay": "100ms"},
        {"Internal/RetransmitMerging": "adaptive"},
        {_BUFFER: "", "queue_bytes": 4000},
        {"depth": 1},
        {"depth": 50},
    ],
    "fast-reliable": [
        {},
        {"heartbeat": 0.02},
        {"heartbeat": 0.1},
        {"heartbeat": 0.3},
        {"nack": 0.0},
        {"response": 0.0},
        {"publish": "ASYNCHRONOUS"},
        {"send_buffer": 8192, "queue_bytes": 64_000},
        {"depth": 1},
    ],
    "zenoh-tcp-drop": [
        {},
        {"transport/unicast/compression/enabled": False},
        {"transport/link/tx/batch_size": 65535},
        {_DROP: 20_000},
        {_DROP: 100_000},
        {"transport/link/tcp/so_sndbuf": 4096, "transport/link/tcp/so_rcvbuf": 4096},
        {"transport/link/tcp/so_sndbuf": 32768, "transport/link/tcp/so_rcvbuf": 32768},
        {"transport/link/tx/queue/batching/enabled": False},
        {"priority": "REAL_TIME"},
        {"queue_bytes": 64_000},
    ],
}


def race_profiles() -> list[Row]:
    """As they come, as they race, and with each setting."""
    rows = []
    for base, tries in TRIED.items():
        stock = f"{base.partition('-')[0]}-stock"
        rows.append(_row(stock, _cells(stock)))
        print(rows[-1].what, round(rows[-1].value), rows[-1].note, flush=True)
        for change in tries:
            contender = CONTENDERS[base]
            changes = ", ".join(f"{key.rpartition('/')[2]} {value}" for key, value in change.items())
            name = f"{base}: {changes or 'as it races'}"
            CONTENDERS[name] = replace(contender, settings={**contender.settings, **change})
            rows.append(_row(name, _cells(name)))
            print(rows[-1].what, round(rows[-1].value), rows[-1].note, flush=True)
            del CONTENDERS[name]
    return rows


def _cells(name: str) -> list[RaceCell]:
    found = []
    for seed in SEEDS:
        settings = RaceSettings(peers=(name,), loss=(LOSS,), load=(LOAD,), duration_s=SECONDS, seed=seed)
        race = run_race(settings)
        if race.error is not None:
            raise race.error
        found += race.cells
    return found


def _row(name: str, cells: list[RaceCell]) -> Row:
    def middle(field: str) -> float:
        return median(getattr(cell, field) or 0.0 for cell in cells)

    note = f"PDR {middle('pdr'):.3f}, mean {1e3 * middle('age_mean'):.0f} ms, {middle('air_bytes_per_message'):.0f} B"
    return Row(name, 1e3 * middle("age_p95"), "ms", note=note)
