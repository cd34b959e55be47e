"""The engine of calls: whatever frames come, from whomever, it never raises, executes nothing twice, and its memory is
bounded."""

from __future__ import annotations

from collections.abc import Iterator

from fuzz.loop import main
from gr_ros2.calls import Calls, Offer, Request, Service
from gr_ros2.calls.engine import MAX_CALLS
from gr_ros2.calls.frames import CallFrame, read_frame, write_frame

_OWN, _BOOT = 2, 20
_OFFERS = {5: Offer("/robot_2/add", 1.0), 6: Offer("/robot_2/map")}
_STEP = 24
_ROBOTS = 3


def calls(data: bytes) -> None:
    """A script of frames: each a byte that says who sends it and what happens here, then its bytes."""
    engine = Calls(_OWN, _BOOT)
    taken: set[tuple[int, int]] = set()
    for number, (head, frame) in enumerate(steps(data)):
        robot, now = head % _ROBOTS + 10, number * 0.1
        found = engine.receive((robot, 1), frame, _OFFERS, now)
        if isinstance(found, Request):
            name = robot, read_frame(frame).number
            assert name not in taken
            taken.add(name)
            if head & 64:
                engine.reply(found.ticket, frame, now)
        if head & 128:
            engine.call(Service(robot, 1, 5, "/rx/add"), number, frame, deadline_s=head & 7, now=now)
        made, served = engine.waiting
        assert made <= MAX_CALLS and served <= MAX_CALLS * _ROBOTS


def steps(data: bytes) -> Iterator[tuple[int, bytes]]:
    for start in range(0, len(data), _STEP):
        yield data[start], data[start + 1 : start + _STEP]


def corpus() -> list[bytes]:
    """Scripts of requests, of replies, and of both."""
    requests = [write_frame(CallFrame(_OWN, _BOOT, n + 1, b"payload", 5 + n % 3, n % 4)) for n in range(40)]
    replies = [write_frame(CallFrame(_OWN, _BOOT, n // 2 + 1, b"payload")) for n in range(40)]
    scripts = []
    for frames in (requests, replies, [*requests[:20], *replies], requests * 2):
        heads = [bytes((n * 37 % 256,)) for n in range(len(frames))]
        scripts.append(b"".join((head + frame).ljust(_STEP, b"\0") for head, frame in zip(heads, frames, strict=True)))
    return scripts


if __name__ == "__main__":
    main(calls, corpus())
