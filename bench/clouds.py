"""Point clouds that fit the air on a narrow link, simulated: beside cells of one size, and beside odometry alone.

The robots have the engine of a link in simulated time, as in ``bench.cameras``, with odometry (20/s) and a scan (5/s).
A scanner of 64 beams turns 10 times a second; cells are of .05 m or more, within 30 m. The peer sends cells of the size
that a user would set who knows the link: the least that is free without loss, the newest kept and repaired.
"""

from __future__ import annotations

import random
from functools import cache
from typing import NamedTuple

import numpy as np

from bench.rows import Row
from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.messages import CLOUD, read
from gr_ros2.settings.config import CloudOptions, SendOptions
from gr_ros2.settings.registry import Registry, Topic
from tests.codecs import scenes
from tests.codecs.camera_link import ODOMETRY, PACKET_LEN, SCAN, Air, Robot

POINTS, TURNS, SECONDS, JUDGED_FROM_S = 0, 10, 8.0, 2.0
FINEST, RANGE = 0.05, 30.0
BODY = 200
ODOMETRY_BYTES, SCAN_BYTES = 52, 352
RATES, LOSSES, SEEDS = (64, 128, 256, 512, 2000), (0.0, 0.2), (1, 2, 3)


class JudgedClouds(NamedTuple):
    """:param cells: of a cloud, mean"""

    per_s: float
    mean_ms: float
    p95_ms: float
    cells: float
    odometry_ms: float


@cache
def _scan(number: int) -> bytes:
    return scenes.cloud(_street(number % 10), number=number)


@cache
def _street(number: int) -> scenes.Array:
    return scenes.street(number)


def _fixed(kbit_s: float) -> float:
    """The size of cells that a user would set, m: the least of which clouds need .8 of what is free without loss."""
    free = 1000 * kbit_s / 8 * BODY / PACKET_LEN - 20 * ODOMETRY_BYTES - 5 * SCAN_BYTES
    edges = (0.05 * 2 ** (step / 4) for step in range(40))
    return next(edge for edge in edges if _bytes(edge) <= 0.8 * free / TURNS)


@cache
def _bytes(edge: float) -> int:
    return len(CodedTopic(CLOUD, {"cloud": {"voxel": edge, "range": RANGE}}).encoder().encode(_scan(0)).data)


def simulate(kind: str, kbit_s: float, loss: float, seed: int) -> JudgedClouds:
    """One link for ``SECONDS``.

    :param kind: fit, fixed, or none: no clouds
    """
    options = SendOptions(cloud=CloudOptions(voxel=FINEST, range=RANGE, fit=True))
    if kind == "fixed":
        edge = round(_fixed(kbit_s), 3)
        options = SendOptions(cloud=CloudOptions(voxel=edge, range=RANGE), queue="fifo", queue_depth=1, qos="bulk")
    newest = SendOptions(queue="latest", codec="none")
    rows = [
        Topic(POINTS, "points", CLOUD, options),
        Topic(ODOMETRY, "odom", "std_msgs/msg/String", newest),
        Topic(SCAN, "scan", "std_msgs/msg/String", newest),
    ]
    sender, receiver = Robot(1, Registry(rows), kbit_s), Robot(2, None, kbit_s)
    rng = random.Random(seed)
    air = Air(sender, receiver)
    air.lost = lambda robot, _: robot is sender and rng.random() < loss
    if kind != "none":
        air.feed(sender, POINTS, TURNS, _scan)
    air.feed(sender, ODOMETRY, 20, lambda number: number.to_bytes(4, "big") * (ODOMETRY_BYTES // 4))
    air.feed(sender, SCAN, 5, lambda number: number.to_bytes(4, "big") * (SCAN_BYTES // 4))
    air.run(SECONDS)
    at = np.arange(JUDGED_FROM_S, SECONDS, 0.005)

    def ages(events: list[tuple[float, float]]) -> scenes.Array:
        when, what = np.array([(0.0, 0.0), *events]).T
        return np.asarray((at - what[np.searchsorted(when, at, "right") - 1]) * 1e3)

    seen, cells = [], []
    for now, message in receiver.of(1, POINTS):
        cloud = read(CLOUD, message)
        seen.append((now, cloud.header.stamp.sec - 1_700_000_000 + cloud.header.stamp.nanosec / 1e9))
        cells.append(cloud.width)
    age = ages(seen)
    heard = [(now, int.from_bytes(message[:4], "big") / 20) for now, message in receiver.of(1, ODOMETRY)]
    return JudgedClouds(
        sum(now > JUDGED_FROM_S for now, _ in seen) / (SECONDS - JUDGED_FROM_S),
        float(age.mean()),
        float(np.percentile(age, 95)),
        float(np.mean(cells)) if cells else 0.0,
        float(ages(heard).mean()),
    )


def _mean(kind: str, kbit_s: float, loss: float) -> JudgedClouds:
    found = [simulate(kind, kbit_s, loss, seed) for seed in SEEDS[: len(SEEDS) if loss else 1]]
    return JudgedClouds(*np.mean(found, 0).tolist())


def clouds() -> list[Row]:
    """Every rate and loss, beside the peer."""
    rows = []
    for kbit_s in RATES:
        for loss in LOSSES:
            fit, fixed, alone = (_mean(kind, kbit_s, loss) for kind in ("fit", "fixed", "none"))
            what = f"clouds: {kbit_s} kbit/s, {loss:.0%} lost"
            note = (
                f"{fit.per_s:.1f}/s, p95 {fit.p95_ms:.0f} ms, {fit.cells:,.0f} cells; cells of {_fixed(kbit_s):.2f} m: "
                f"{fixed.per_s:.1f}/s, {fixed.mean_ms:,.0f} ms, {fixed.cells:,.0f} cells"
            )
            most = 250 if loss else 200
            rows.append(Row(f"{what}, mean age", fit.mean_ms, "ms", "≤", most, note=note))
            older = fit.odometry_ms / alone.odometry_ms
            rows.append(Row(f"{what}, odometry older than alone", older, "times", "≤", 1.5, "{:.2f}"))
    return rows
