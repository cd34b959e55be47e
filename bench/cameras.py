"""A camera beside odometry and a scan on a narrow link, simulated: encoded on pull, and as image transports do it.

The robots have the engine of a link in simulated time: packets of at most 220 bytes, losses in one direction, reports
in the other, 5 ms from the end of a packet to its reception. Coding takes 8 ms. Odometry (20/s, the newest only) and a
scan (5/s) go beside it. Peers over the same engine: JPEG of quality 50 with the newest kept, and H.264 at .8 of the
rate that is free without loss, a key frame each second and a queue of 10. Ages count from when a picture was taken.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

import av
import numpy as np

from bench.rows import Row
from gr_ros2.codecs import h264, video
from gr_ros2.codecs.messages import IMAGE, read
from gr_ros2.settings.config import SendOptions, vars_of
from tests.codecs import scenes
from tests.codecs.camera_link import CAMERA, ODOMETRY, PACKET_LEN, SCAN, Air, Robot, registry

FPS, SECONDS, JUDGED_FROM_S = 15, 10.0, 3.0
TRUTH = 2
"""Pictures of the scene between two of the camera, to which what is shown is compared."""
BODY = 200
ODOMETRY_RATE, ODOMETRY_BYTES, SCAN_RATE, SCAN_BYTES = 20, 52, 5, 352
WIDTH, HEIGHT = 640, 480
RATES, LOSSES = (32, 64, 128, 256, 512, 2000), (0.0, 0.05, 0.2)
OUTAGE = 4.0, 6.0


class Judged(NamedTuple):
    """:param now_db: PSNR of luma against what the camera would see at that instant"""

    per_s: float
    mean_ms: float
    p95_ms: float
    now_db: float
    odometry_ms: float
    back_s: float


@cache
def _pictures() -> list[bytes]:
    return [scenes.image(scenes.view(n / TRUTH), "rgb8", n) for n in range(int(SECONDS * FPS * TRUTH) + TRUTH)]


@cache
def _luma(number: int) -> Any:
    return _grey(read(IMAGE, _pictures()[number]).data.reshape(HEIGHT, WIDTH, 3))


def _grey(pixels: Any) -> Any:
    return pixels.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)


class Scheme:
    """How the camera's pictures are sent; this one is the topic as a link sends it, on pull."""

    options: SendOptions = SendOptions()

    def __init__(self, kbit_s: float) -> None:
        self.kbit_s = kbit_s

    def message(self, number: int) -> bytes:
        """What is handed to the link of a picture."""
        return _pictures()[number * TRUTH]

    def shown(self, message: bytes) -> tuple[int, Any] | None:
        """Number and luma of what is shown; None: nothing is."""
        out = read(IMAGE, message)
        stamp = out.header.stamp
        number = round((stamp.sec - 1_700_000_000) * 10 + stamp.nanosec / 1e8)
        return number // TRUTH, _grey(out.data.reshape(out.height, out.width, 3))


class Jpeg(Scheme):
    """JPEG of quality 50, the newest kept, repaired."""

    options = SendOptions(queue="fifo", queue_depth=1, qos="bulk", codec="none", reliability="reliable")

    def message(self, number: int) -> bytes:
        pixels = read(IMAGE, _pictures()[number * TRUTH]).data.reshape(HEIGHT, -1)
        picture = video.from_rows(pixels, WIDTH, "rgb24").reformat(format="yuvj420p")
        return number.to_bytes(4, "big") + video.packed("mjpeg", picture, 8)

    def shown(self, message: bytes) -> tuple[int, Any] | None:
        pixels = video.still("mjpeg", message[4:]).to_ndarray(format="rgb24")
        return int.from_bytes(message[:4], "big"), _grey(pixels)


class Fixed(Scheme):
    """H.264 at .8 of the rate that is free without loss, a key frame each second, a queue of 10, repaired in order."""

    options = SendOptions(queue="fifo", queue_depth=10, qos="bulk", codec="none", reliability="reliable")

    def __init__(self, kbit_s: float) -> None:
        super().__init__(kbit_s)
        capacity = 1000 * kbit_s / 8 * BODY / PACKET_LEN
        others = ODOMETRY_BYTES * ODOMETRY_RATE + SCAN_BYTES * SCAN_RATE
        self.rate = int(0.8 * 8 * max(0.1 * capacity, capacity - others))
        halved = self.rate / 8 / FPS < 3 * WIDTH * HEIGHT / 256
        self.size = WIDTH >> halved, HEIGHT >> halved
        made: Any = av.CodecContext.create("libx264", "w")
        made.width, made.height, made.pix_fmt = *self.size, "yuv420p"
        made.time_base, made.framerate, made.thread_count = Fraction(1, FPS), Fraction(FPS), 1
        made.bit_rate, made.gop_size = self.rate, FPS
        made.options = {"preset": "veryfast", "tune": "zerolatency"} | dict.fromkeys(
            ("maxrate", "bufsize"), str(self.rate)
        )
        self.writer, self.reader = made, h264.reader("h264", 1 << 22)
        self.broken, self.last = False, -1

    def message(self, number: int) -> bytes:
        pixels = read(IMAGE, _pictures()[number * TRUTH]).data.reshape(HEIGHT, -1)
        picture = video.from_rows(pixels, WIDTH, "rgb24").reformat(*self.size, "yuv420p", interpolation="AREA")
        picture.pts = number
        return number.to_bytes(4, "big") + b"".join(bytes(packet) for packet in self.writer.encode(picture))

    def shown(self, message: bytes) -> tuple[int, Any] | None:
        """After a frame that the queue dropped, or that cannot be read, nothing until the next key frame."""
        number, data = int.from_bytes(message[:4], "big"), message[4:]
        self.broken = (self.broken or number != self.last + 1) and b"\0\0\1\x65" not in data
        self.last = number
        try:
            found = self.reader.decode(av.Packet(data))
        except av.error.InvalidDataError:  # too much before it is missing
            self.broken, found = True, []
        return None if self.broken or not found else (number, _grey(found[-1].to_ndarray(format="rgb24")))


SCHEMES = {"pull": Scheme, "jpeg": Jpeg, "fixed": Fixed}


@dataclass
class Run:
    """What is shown, as (when, number of the picture, luma), and what odometry arrives, as (when, its time)."""

    shown: list[tuple[float, int, Any]] = field(default_factory=list)
    odometry: list[tuple[float, float]] = field(default_factory=list)


def linked(scheme: Scheme | None, kbit_s: float, loss: float, seed: int, outage: tuple[float, float] = (0, 0)) -> Robot:
    """The robot that hears another one for ``SECONDS``."""
    topics = registry(options={} if scheme is None else vars_of(scheme.options))
    sender, receiver = Robot(1, topics, kbit_s), Robot(2, None, kbit_s)
    rng = random.Random(seed)
    air = Air(sender, receiver)
    air.lost = lambda robot, _: robot is sender and (rng.random() < loss or outage[0] <= air.now < outage[1])
    if scheme is not None:
        air.feed(sender, CAMERA, FPS, scheme.message)
    air.feed(sender, ODOMETRY, ODOMETRY_RATE, lambda number: number.to_bytes(4, "big") * (ODOMETRY_BYTES // 4))
    air.feed(sender, SCAN, SCAN_RATE, lambda number: number.to_bytes(4, "big") * (SCAN_BYTES // 4))
    air.run(SECONDS)
    return receiver


def simulate(kind: str, kbit_s: float, loss: float, seed: int = 1, *, outage: tuple[float, float] = (0, 0)) -> Run:
    """One link."""
    scheme = None if kind == "none" else SCHEMES[kind](kbit_s)
    receiver, run = linked(scheme, kbit_s, loss, seed, outage), Run()
    for now, message in receiver.of(1) if scheme is not None else ():
        if (found := scheme.shown(message)) is not None:  # type: ignore[union-attr]
            run.shown.append((now, *found))
    for now, message in receiver.of(1, ODOMETRY):
        run.odometry.append((now, int.from_bytes(message[:4], "big") / ODOMETRY_RATE))
    return run


def judged(run: Run) -> Judged:
    """What a watcher has of it, from ``JUDGED_FROM_S`` on."""
    at = np.arange(JUDGED_FROM_S, SECONDS - 0.5, 0.005)

    def ages(events: list[tuple[float, float]]) -> Any:
        when, what = np.array([(0.0, 0.0), *events]).T
        return (at - what[np.searchsorted(when, at, "right") - 1]) * 1e3

    shown = [(when, number / FPS) for when, number, _ in run.shown]
    age = ages(shown)
    times = np.array([when for when, _ in shown] or [np.inf])
    quality = list(_qualities(run, times))
    after = at > OUTAGE[1]
    fresh = at[after][age[after] < 200]
    return Judged(
        float(np.sum((times > JUDGED_FROM_S) & (times < np.inf)) / (SECONDS - JUDGED_FROM_S)),
        float(age.mean()),
        float(np.percentile(age, 95)),
        float(np.mean(quality)) if quality else 0.0,
        float(ages(run.odometry).mean()),
        float(fresh[0] - OUTAGE[1]) if len(fresh) else np.inf,
    )


def _qualities(run: Run, times: Any) -> Iterator[float]:
    for number in range(int(JUDGED_FROM_S * FPS * TRUTH), len(_pictures()) - FPS, 3):
        which = int(np.searchsorted(times, number / FPS / TRUTH, "right")) - 1
        if which >= 0:
            luma = run.shown[which][2]
            times_larger = HEIGHT // len(luma)
            large = np.kron(luma, np.ones((times_larger, times_larger), np.float32)) if times_larger > 1 else luma
            yield float(10 * np.log10(255**2 / np.mean((large - _luma(number)) ** 2)))


def _joins(kbit_s: float, loss: float, seed: int) -> float:
    """s until a robot that joins two others sees a picture."""
    sender, late = Robot(1, registry(), kbit_s), Robot(3, None, kbit_s)
    air = Air(sender, Robot(2, None, kbit_s), late, loss=loss, seed=seed)
    air.feed(sender, CAMERA, FPS, Scheme(kbit_s).message)
    late.on = False
    air.run(5 + 0.13 * seed)
    late.on, begin = True, air.now
    air.run(SECONDS)
    return late.of(1)[0][0] - begin


SEEDS = (1, 2, 3)
"""Draws of losses, of which each figure is the mean."""
BEHIND, BEHIND_LOST = 5, 1
"""% by which the best peer may be better in age, pictures/s or PSNR; the second where packets are lost, for a picture
that is on its way when the count ends."""
MOST_MS: dict[tuple[int, float], tuple[int, int | None]] = {
    **{(64, 0.0): (130, None), (64, 0.2): (180, None), (512, 0.2): (150, None)},
    **{(128, 0.0): (120, 160), (128, 0.2): (200, 350)},
}
"""Mean and p95 of the age."""


def _mean(kind: str, kbit_s: float, loss: float) -> Judged:
    found = [judged(simulate(kind, kbit_s, loss, seed)) for seed in SEEDS[: len(SEEDS) if loss else 1]]
    return Judged(*np.mean(found, 0).tolist())


def _behind(pull: Judged, peer: Judged) -> float:
    """The part by which a peer is better, in what it is better most; below 0 where it is worse in everything, or shows
    nothing at all."""
    if not peer.per_s:
        return -1.0
    per_s = pull.per_s / min(peer.per_s, FPS)
    return max(pull.mean_ms / peer.mean_ms - 1, 1 - per_s, 1 - pull.now_db / peer.now_db)


def cameras() -> list[Row]:
    """Every rate and loss, beside the peers."""
    rows = []
    for kbit_s in RATES:
        for loss in LOSSES:
            pull, jpeg, fixed, alone = (_mean(kind, kbit_s, loss) for kind in ("pull", "jpeg", "fixed", "none"))
            what = f"cameras: {kbit_s} kbit/s, {loss:.0%} lost"
            mean, p95 = MOST_MS.get((kbit_s, loss), (0, None))
            others = "; ".join(
                f"{name} {peer.per_s:.1f}/s, {peer.mean_ms:,.0f} ms, {peer.now_db:.1f} dB"
                for name, peer in (("JPEG", jpeg), ("fixed", fixed))
            )
            note = f"{pull.per_s:.1f}/s, p95 {pull.p95_ms:.0f} ms, {pull.now_db:.1f} dB; {others}"
            rows.append(Row(f"{what}, mean age", pull.mean_ms, "ms", "≤" if mean else None, mean or 0, note=note))
            if p95:
                rows.append(Row(f"{what}, p95 of the age", pull.p95_ms, "ms", "≤", p95))
                rows.append(Row(f"{what}, frames", pull.per_s, "/s", "≥", 14, "{:.1f}"))
            behind = 100 * max(_behind(pull, peer) for peer in (jpeg, fixed))
            rows.append(Row(f"{what}, worse than a peer by", behind, "%", "≤", BEHIND_LOST if loss else BEHIND))
            older = pull.odometry_ms / alone.odometry_ms
            rows.append(Row(f"{what}, odometry older than alone", older, "times", "≤", 1.5, "{:.2f}"))
    joined = np.mean([_joins(128, loss, seed) for loss in (0.0, 0.2) for seed in SEEDS])
    back = np.mean([judged(simulate("pull", 128, 0.05, seed, outage=OUTAGE)).back_s for seed in SEEDS])
    return [
        *rows,
        Row("cameras: who joins (128 kbit/s, 0 and 20 %) sees one within", float(joined), "s", "≤", 0.75, "{:.2f}"),
        Row("cameras: after 2 s of outage, a picture < .2 s old within", float(back), "s", "≤", 0.3, "{:.2f}"),
    ]
