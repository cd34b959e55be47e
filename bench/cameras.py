"""A camera beside odometry and a scan on a narrow link, simulated: encoded on pull, and as image transports do it.

The link has packets of at most 220 bytes, 20 of them headers, losses in one direction, and reports that come back after
80 ms. Odometry (20/s, the newest only) and a scan (5/s) go first. It is not the engine of a link: what is tried is
``gr_ros2.codecs`` and its ``pull``. Peers: JPEG of quality 50 with the newest kept, and H.264 at .8 of the rate that is
free without loss, a key frame each second and a queue of 10. Ages count from when a picture was taken.
"""

from __future__ import annotations

import heapq
import random
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

import av
import numpy as np

from bench.rows import Row
from gr_ros2.codecs import CodedTopic, video
from gr_ros2.codecs.messages import IMAGE, read
from gr_ros2.codecs.pull import FramePull, FreeRate
from tests.codecs import scenes

FPS, SECONDS, JUDGED_FROM_S = 15, 9.0, 2.0
TRUTH = 2
"""Pictures of the scene between two of the camera, to which what is shown is compared."""
BODY, HEAD, FRAGMENT, RTT_S, CODING_S = 200, 20, 4, 0.08, 0.008
ODOMETRY_S, ODOMETRY_BYTES, SCAN_S, SCAN_PART, SCAN_PARTS = 0.05, 52, 0.2, 176, 2
WIDTH, HEIGHT = 640, 480
RATES, LOSSES = (64, 128, 256, 512), (0.0, 0.05, 0.2)
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
    return [scenes.image(scenes.view(n / TRUTH), "rgb8", n) for n in range(int(SECONDS * FPS * TRUTH))]


@cache
def _luma(number: int) -> Any:
    return _grey(read(IMAGE, _pictures()[number]).data.reshape(HEIGHT, WIDTH, 3))


def _grey(pixels: Any) -> Any:
    return pixels.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)


@dataclass
class Frame:
    """:param of: number of the picture; :param left: bytes that have to leave yet"""

    of: int
    data: bytes
    name: int = 0
    left: int = 0
    got: int = 0


class Pull:
    """The codec of cameras, by ``FramePull``. With ``spare``, so many times the loss leave in advance, as a code that
    any bytes of a frame complete."""

    chain = True

    def __init__(self, capacity: float, loss: float, spare: float) -> None:
        self.free = FreeRate(capacity)
        self.more = 1 + spare * loss
        topic = CodedTopic(IMAGE)
        self.encoder, self.decoder = topic.encoder(), topic.decoder()
        self.pull = FramePull(self.free, coding_s=CODING_S)
        self.newest = 0
        self.ready: tuple[float, Frame] | None = None

    def arrive(self, number: int, now: float) -> None:
        self.newest = number
        self.pull.offer(_pictures()[number * TRUTH], now)

    def next(self, now: float, waiting: int) -> Frame | None:
        if self.ready is None and (request := self.pull.pull(now, waiting)) is not None:
            coded = self.encoder.encode(request.message, int(request.budget / self.more), request.key)
            self.ready = now + CODING_S, Frame(self.newest, coded.data, coded.name)
        if self.ready is None or waiting or self.ready[0] > now:
            return None
        frame, self.ready = self.ready[1], None
        frame.left = int(len(frame.data) * self.more)
        self.pull.coded(frame.name, now)
        return frame

    def shown(self, frame: Frame) -> Any:
        out = read(IMAGE, self.decoder.decode(frame.data))
        return _grey(out.data.reshape(out.height, out.width, 3))


class Queue:
    """What image transports do: a queue of coded pictures, the oldest dropped."""

    def __init__(self, capacity: float, *, jpeg: bool) -> None:
        self.jpeg, self.chain = jpeg, not jpeg
        self.free = FreeRate(capacity)
        self.queue: deque[Frame] = deque(maxlen=1 if jpeg else 10)
        others = ODOMETRY_BYTES / ODOMETRY_S + SCAN_PARTS * SCAN_PART / SCAN_S
        self.rate = int(0.8 * 8 * max(0.1 * capacity, capacity - others))
        self.halved = self.rate / 8 / FPS < 3 * WIDTH * HEIGHT / 256
        self.reader, self.writer = video._reader("h264", 1 << 22), None if jpeg else self._made()
        self.broken, self.last = False, -1

    def _made(self) -> Any:
        made: Any = av.CodecContext.create("libx264", "w")
        made.width, made.height, made.pix_fmt = WIDTH >> self.halved, HEIGHT >> self.halved, "yuv420p"
        made.time_base, made.framerate, made.thread_count = Fraction(1, FPS), Fraction(FPS), 1
        made.bit_rate, made.gop_size = self.rate, FPS
        options = {"preset": "veryfast", "tune": "zerolatency", "maxrate": str(self.rate), "bufsize": str(self.rate)}
        made.options = options
        return made

    def arrive(self, number: int, now: float) -> None:  # noqa: ARG002
        pixels = read(IMAGE, _pictures()[number * TRUTH]).data.reshape(HEIGHT, -1)
        picture = video.from_rows(pixels, WIDTH, "rgb24")
        if self.jpeg:
            data = video.packed("mjpeg", picture.reformat(format="yuvj420p"), 8)
        else:
            picture = picture.reformat(WIDTH >> self.halved, HEIGHT >> self.halved, "yuv420p", interpolation="AREA")
            picture.pts = number
            data = b"".join(bytes(packet) for packet in self.writer.encode(picture))
        self.queue.append(Frame(number, data, left=len(data)))

    def next(self, now: float, waiting: int) -> Frame | None:  # noqa: ARG002
        return self.queue.popleft() if self.queue and not waiting else None

    def shown(self, frame: Frame) -> Any | None:
        """What is shown; after a frame that the queue dropped nothing until the next key frame."""
        if self.jpeg:
            return _grey(video.still("mjpeg", frame.data).to_ndarray(format="rgb24"))
        key = b"\0\0\1\x65" in frame.data
        self.broken = (self.broken or frame.of != self.last + 1) and not key
        self.last = frame.of
        found = self.reader.decode(av.Packet(frame.data))
        return None if self.broken or not found else _grey(found[-1].to_ndarray(format="rgb24"))


@dataclass
class Run:
    """What is shown, as (when, number of the picture, luma), and what odometry arrives, as (when, its time)."""

    shown: list[tuple[float, int, Any]] = field(default_factory=list)
    odometry: list[tuple[float, float]] = field(default_factory=list)


def simulate(
    kind: str, kbit_s: float, loss: float, seed: int = 1, *, outage: tuple[float, float] = (0, 0), spare: float = 0.0
) -> Run:
    """One link for ``SECONDS``."""
    rate = 1000 * kbit_s
    capacity = rate / 8 * BODY / (BODY + HEAD)
    scheme: Any = None
    if kind != "none":
        scheme = Pull(capacity, loss, spare) if kind == "pull" else Queue(capacity, jpeg=kind == "jpeg")
    rng, run = random.Random(seed), Run()
    now, arrived, odometry, odometry_due, scan_due = 0.0, -1, None, 0.0, 0.0
    scan: deque[int] = deque()
    sending: Frame | None = None
    known: list[tuple[float, int, str, Any, int]] = []  # when, serial, what, of which, bytes
    again: deque[tuple[str, Any, int]] = deque()
    order: list[Frame] = []
    serial = first = 0
    while now < SECONDS:
        while (arrived + 1) / FPS <= now and (arrived + 1) * TRUTH < len(_pictures()):
            arrived += 1
            if scheme:
                scheme.arrive(arrived, now)
        while odometry_due <= now:
            odometry, odometry_due = odometry_due, odometry_due + ODOMETRY_S
        while scan_due <= now:
            scan, scan_due = deque([SCAN_PART] * SCAN_PARTS), scan_due + SCAN_S
        while known and known[0][0] <= now:
            _, _, what, frame, size = heapq.heappop(known)
            if what == "confirmed":
                scheme.pull.confirmed(frame.name)
            elif what == "scan" or frame.got < len(frame.data):
                again.append((what, frame, size))
        room, packet, others = BODY, [], 0
        if odometry is not None:
            packet.append(("odometry", odometry, ODOMETRY_BYTES))
            room, others, odometry = room - ODOMETRY_BYTES, others + ODOMETRY_BYTES, None
        while again and room > FRAGMENT:
            what, frame, size = again.popleft()
            part = min(size, room - FRAGMENT)
            packet.append((what, frame, part))
            room, others = room - part - FRAGMENT, others + part + FRAGMENT
            if part < size:
                again.appendleft((what, frame, size - part))
        while scan and scan[0] <= room:
            packet.append(("scan", None, scan[0] - FRAGMENT))
            room, others = room - scan[0], others + scan.popleft()
        while scheme and room > FRAGMENT:
            following = scheme.next(now, sending.left if sending else 0)
            if following is not None:
                sending = following
                order.append(sending)
            if sending is None or not sending.left:
                break
            part = min(room - FRAGMENT, sending.left)
            packet.append(("camera", sending, part))
            sending.left -= part
            room -= part + FRAGMENT
            if sending.left:
                break
        if not packet:
            now += 0.001
            continue
        now += (HEAD + BODY - room) * 8 / rate
        if scheme:
            scheme.free.left(now, others)
        lost = rng.random() < loss or outage[0] <= now < outage[1]
        for what, frame, size in packet:
            serial += 1
            if what == "odometry":
                if not lost:
                    run.odometry.append((now, frame))
            elif lost:
                heapq.heappush(known, (now + RTT_S, serial, what, frame, size))
            elif what == "camera":
                before, frame.got = frame.got, frame.got + size
                if before < len(frame.data) <= frame.got and isinstance(scheme, Pull):
                    heapq.heappush(known, (now + RTT_S, serial, "confirmed", frame, 0))
        while first < len(order) and order[first].got >= len(order[first].data):
            if (luma := scheme.shown(order[first])) is not None:
                run.shown.append((now, order[first].of, luma))
            first += 1
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
        float(np.sum(times > JUDGED_FROM_S) / (SECONDS - JUDGED_FROM_S)),
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


SEEDS = (1, 2, 3)
"""Draws of losses, of which each figure is the mean."""
MOST_MS = {(64, 0.0): (130, None), (64, 0.2): (180, None), (128, 0.0): (120, 160), (128, 0.2): (200, 350)}
"""Mean and p95 of the age."""
WITH_SPARE_MS = 150


def _mean(kind: str, kbit_s: float, loss: float, spare: float = 0.0) -> Judged:
    found = [judged(simulate(kind, kbit_s, loss, seed, spare=spare)) for seed in SEEDS[: len(SEEDS) if loss else 1]]
    return Judged(*np.mean(found, 0).tolist())


def cameras() -> list[Row]:
    """Every rate and loss, beside the peers."""
    rows = []
    for kbit_s in RATES:
        for loss in LOSSES:
            pull, jpeg, fixed, alone = (_mean(kind, kbit_s, loss) for kind in ("pull", "jpeg", "fixed", "none"))
            what = f"cameras: {kbit_s} kbit/s, {loss:.0%} lost"
            mean, p95 = MOST_MS.get((kbit_s, loss), (None, None))
            others = "; ".join(
                f"{name} {peer.per_s:.1f}/s, {peer.mean_ms:,.0f} ms, {peer.now_db:.1f} dB"
                for name, peer in (("JPEG", jpeg), ("fixed", fixed))
            )
            note = f"{pull.per_s:.1f}/s, p95 {pull.p95_ms:.0f} ms, {pull.now_db:.1f} dB; {others}"
            rows.append(Row(f"{what}, mean age", pull.mean_ms, "ms", "≤" if mean else None, mean or 0, note=note))
            if p95:
                rows.append(Row(f"{what}, p95 of the age", pull.p95_ms, "ms", "≤", p95))
                rows.append(Row(f"{what}, frames", pull.per_s, "/s", "≥", 14, "{:.1f}"))
            older = pull.odometry_ms / alone.odometry_ms
            rows.append(Row(f"{what}, odometry older than alone", older, "times", "≤", 1.5, "{:.2f}"))
    for spare in (1.0, 1.5, 2.0):
        ahead = _mean("pull", 512, 0.2, spare)
        note = f"{ahead.per_s:.1f}/s, p95 {ahead.p95_ms:.0f} ms, {ahead.now_db:.1f} dB"
        what = f"cameras: 512 kbit/s, 20 % lost, {spare:g} × the loss ahead"
        rows.append(Row(what, ahead.mean_ms, "ms", "≤", WITH_SPARE_MS, note=note))
    back = np.mean([judged(simulate("pull", 128, 0.05, seed, outage=OUTAGE)).back_s for seed in SEEDS])
    return [
        *rows,
        Row("cameras: after 2 s of outage, a picture < .2 s old within", float(back), "s", "≤", 0.3, "{:.2f}"),
    ]
