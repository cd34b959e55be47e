"""Codecs of topics: bytes over budget, errors and processor time, of generated scenes (tests/codecs/scenes.py).

Figures of real recordings, which are not in the repository, stand in docs/explanation/compression.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from bench.rows import Row
from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.messages import CLOUD, GRID, IMAGE, read
from tests.codecs import scenes

FRAMES = 80
SMALL = (60, 80, 100, 120, 160, 200, 250, 300, 360)
BUDGETS = (400, 800, 1600, 3200, 6400)
"""Bytes of a frame; at 10 frames/s 5 to 29, and 32 to 512 kbit/s."""
DEPTH_BUDGET = 3800


class _Run(NamedTuple):
    """Of each frame but the first: bytes, ms to encode and to decode; and the messages that came out."""

    sizes: np.ndarray[Any, Any]
    encode_ms: float
    decode_ms: float
    out: list[bytes]


def codecs() -> list[Row]:
    """Cameras, depth, clouds and maps."""
    return [*_cameras(), *_depth(), *_clouds(), *_maps()]


def _run(topic: CodedTopic, messages: list[bytes], budget: Callable[[int], int | None]) -> _Run:
    encoder, decoder = topic.encoder(), topic.decoder()
    sizes, encode, decode, out = [], [], [], []
    for number, message in enumerate(messages):
        begin = time.thread_time()
        coded = encoder.encode(message, budget(number))
        middle = time.thread_time()
        out.append(decoder.decode(coded.data))
        encode.append(middle - begin)
        decode.append(time.thread_time() - middle)
        encoder.confirmed(coded.name)
        # Where a size that follows the budget makes a key frame, its budget is another.
        sizes.append(len(coded.data) if coded.before is not None or number == 0 else np.nan)
    kept = np.array(sizes[1:]) if topic.type_name == IMAGE else np.array([len(message) for message in out])
    return _Run(kept, 1e3 * float(np.median(encode)), 1e3 * float(np.median(decode)), out)


@cache
def _views(width: int, height: int) -> list[bytes]:
    return [scenes.image(scenes.view(n, width, height)[..., ::-1], "bgr8", n) for n in range(FRAMES)]


def _psnr(one: bytes, other: bytes) -> float:
    a, b = (read(IMAGE, each).data.astype(np.float32) for each in (one, other))
    return float(10 * np.log10(255**2 / max(1e-5, np.mean((a - b) ** 2)))) if len(a) == len(b) else np.nan


def _cameras() -> list[Row]:
    rows, shares = [], []
    for budget in (*SMALL, *BUDGETS):
        run = _run(CodedTopic(IMAGE), _views(640, 480), lambda _, budget=budget: budget)  # type: ignore[misc]
        share = run.sizes[~np.isnan(run.sizes)] / budget
        shares.append(share)
        width = read(IMAGE, run.out[-1]).width
        quality = np.mean([_psnr(*pair) for pair in zip(run.out[1:], _views(width, width * 3 // 4)[1:], strict=True)])
        what = f"codecs: camera 640 × 480 in {budget} B, sent as {width}"
        note = f"p10 {np.percentile(share, 10):.2f}, p99 {np.percentile(share, 99):.2f}; {quality:.1f} dB"
        rows.append(Row(f"{what}, median of the budget", float(np.median(share)), form="{:.2f}", note=note))
        took = f"{run.encode_ms:.1f} ms to encode, {run.decode_ms:.1f} to decode"
    for which, some in (("of 60 to 360 B", shares[: len(SMALL)]), ("of 400 to 6,400 B", shares[len(SMALL) :])):
        median, most = (_p(np.concatenate(some), percent) for percent in (50, 99))
        rows += [
            Row(f"codecs: camera, budgets {which}, median", median, "", "≥", 0.85, "{:.2f}"),
            Row(f"codecs: camera, budgets {which}, 99 %", most, "", "≤", 1.1, "{:.2f}", took),
        ]
    rng = np.random.default_rng(1)
    budgets = (600 * 8 ** rng.random(FRAMES)).astype(int)
    run = _run(CodedTopic(IMAGE, {"camera": {"size": "full"}}), _views(640, 480), lambda n: int(budgets[n]))
    share = run.sizes / budgets[1:]
    note = f"p50 {np.median(share):.2f}: a greater budget counts from the second frame on"
    rows += [
        Row("codecs: camera, budgets drawn from 600..4800 B, 99 %", _p(share, 99), "", "≤", 1.1, "{:.2f}", note),
        Row("codecs: camera 640 × 480, encode", run.encode_ms, "ms", "≤", 10, "{:.1f}"),
        Row("codecs: camera 640 × 480, decode", run.decode_ms, "ms", "≤", 4, "{:.1f}"),
    ]
    return rows


def _p(values: Any, percent: float) -> float:
    return float(np.percentile(values, percent))


def _depth() -> list[Row]:
    metres = [scenes.room(n) for n in range(FRAMES // 4)]
    messages = [scenes.image(np.rint(each * 1000).astype("<u2"), "16UC1", n) for n, each in enumerate(metres)]
    rows = []
    for mode, budget in (("auto", DEPTH_BUDGET), ("8", None), ("10", None), ("exact", None)):
        run = _run(CodedTopic(IMAGE, {"depth": {"mode": mode}}), messages, lambda _, budget=budget: budget)  # type: ignore[misc]
        errors = []
        for given, out in zip(metres, run.out, strict=True):
            shown = read(IMAGE, out).data.view("<u2").reshape(given.shape) / 1000
            errors.append(np.percentile(np.abs(shown - given)[(given > 0) & (shown > 0)], (50, 90, 99)) * 100)
        p50, p90, p99 = np.mean(errors, 0)
        note = f"p90 {p90:.1f}, p99 {p99:.1f}; {run.encode_ms:.1f} ms to encode, {run.decode_ms:.1f} to decode"
        if budget:
            what = f"codecs: depth 640 × 480 in {budget} B, median error"
            rows += [Row(what, p50, "cm", "≤", 1.2, "{:.2f}", note)]
            share = run.sizes[~np.isnan(run.sizes)] / budget
            rows += [Row("codecs: depth, bytes of the budget, 99 %", _p(share, 99), "", "≤", 1.1, "{:.2f}")]
        else:
            size = np.mean(
                [len(CodedTopic(IMAGE, {"depth": {"mode": mode}}).encoder().encode(m).data) for m in messages[:5]]
            )
            rows += [
                Row(
                    f"codecs: depth, {mode}" + " bits" * mode.isdigit(),
                    float(size),
                    "B",
                    note=f"p50 {p50:.2f} cm, {note}",
                )
            ]
    return rows


def _clouds() -> list[Row]:
    rows = []
    scans = [scenes.cloud(scenes.street(n), number=n) for n in range(5)]
    layout = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7))
    tight = [scenes.cloud(_rounded(scenes.street(n)), layout=layout, step=16, number=n) for n in range(5)]
    for voxel, reach, most in ((0.2, 30.0, 7500), (0.1, 30.0, None), (0.1, np.inf, None), (0.05, np.inf, None)):
        size, took = _cloud({"voxel": voxel, "range": reach}, scans)
        what = f"codecs: 64 beams, voxels of {voxel} m within {reach:g} m"
        if most:
            rows += [Row(what, size, "B", "≤", most), Row(f"{what}, encode", took, "ms", "≤", 10, "{:.1f}")]
        else:
            rows += [Row(what, size, "B", note=f"{took:.1f} ms to encode")]
    size, took = _cloud({}, tight)
    plain = np.mean([len(CodedTopic(CLOUD, {"cloud": "off"}).encoder().encode(scan).data) for scan in tight])
    note = f"{plain:,.0f} B by zstd alone, {len(tight[0]):,} B as it is; {took:.0f} ms to encode"
    return [*rows, Row("codecs: 64 beams in steps of 1 mm, exact", size, "B", note=note)]


def _rounded(points: Any) -> Any:
    """In steps of 1 mm and of 1 % of intensity, as drivers have them; points that hit nothing are left out."""
    flat = points[np.isfinite(points).all(2)]
    return (np.rint(flat * (1000, 1000, 1000, 100)) / (1000, 1000, 1000, 100)).astype(np.float32)[None]


def _cloud(options: dict[str, Any], scans: list[bytes]) -> tuple[float, float]:
    """Mean bytes, and ms to encode."""
    sizes, took = [], []
    encoder = CodedTopic(CLOUD, {"cloud": options}).encoder()
    for scan in [*scans, *scans]:
        begin = time.thread_time()
        sizes.append(len(encoder.encode(scan).data))
        took.append(1e3 * (time.thread_time() - begin))
    return float(np.mean(sizes)), float(np.median(took))


def _maps() -> list[Row]:
    topic = CodedTopic(GRID)
    encoder, decoder, sizes, whole = topic.encoder(), topic.decoder(), [], []
    for message in scenes.exploring(120):
        coded = encoder.encode(message)
        assert decoder.decode(coded.data) == message
        encoder.confirmed(coded.name)
        sizes.append(len(coded.data))
        whole.append(len(topic.encoder().encode(message).data))
    note = f"{np.mean(whole):,.0f} B whole; a robot explores, 1 map/s"
    return [Row("codecs: map of 600 × 600, what changes", float(np.mean(sizes[1:])), "B", "≤", 1750, note=note)]
