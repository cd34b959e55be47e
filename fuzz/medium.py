"""A medium process takes whatever a robot's address sends; each message costs bounded work, and counts once."""

from __future__ import annotations

import tempfile
from functools import cache
from math import inf, nan

import numpy as np

from fuzz.loop import KEPT, main, within
from gr_ros2.radio.zmq import HEADER, MAGIC
from gr_ros2.settings.config import build
from gr_ros2_lab.medium.process import STEP_S, MediumConfig, MediumProcess

RATE = 1e6
MOST_LINES = 2_000


@cache
def process() -> MediumProcess:
    """A process without links."""
    folder = KEPT.enter_context(tempfile.TemporaryDirectory())
    robots = [{"connect": f"ipc://{folder}/{n}", "bind": f"ipc://{folder}/{n}b"} for n in (1, 2)]
    phy = {"name": "psk", "sample_rate": RATE}
    made = MediumProcess(build(MediumConfig, {"phy": phy, "robots": robots, "channel": {"snr_db": 20.0}}))
    KEPT.callback(made.close)
    KEPT.callback(process.cache_clear)
    return made


def medium(data: bytes) -> None:
    """One message of robot 1, and what comes of it in the next step."""
    running = process()
    before = running.counted.total() - running.counted["overlapping"]

    def take() -> None:
        running._arrived(0, data)
        running._now += STEP_S
        running._hand_over()

    within(MOST_LINES, take)
    assert running.counted.total() - running.counted["overlapping"] - before <= 1


def corpus() -> list[bytes]:
    """Bursts and answers as links send them, and at odd times."""
    samples = np.ones(40, "<c8").tobytes()
    times = (0.0, 1.0, nan, inf, -inf, -1e300, 1e300)
    return [HEADER.pack(MAGIC, 7, n, RATE, at) + part for n, at in enumerate(times) for part in (b"", samples)]


if __name__ == "__main__":
    main(medium, corpus())
