"""`gr-ros2 link FILE` on a computer whose clock is wrong, with its programs: ``clock_peer.py FILE ROBOT AHEAD_S …``.

Each line of input sets the clock: s by which it is ahead of the true one. Messages that the robot publishes are stamped
by that clock, and say in them what the true time was. ``got TRUE STAMP`` is said of each message that comes out here.
"""

from __future__ import annotations

import sys
import threading
import time


class _Clock:
    """The clock of this computer."""

    true = staticmethod(time.time)

    def __init__(self) -> None:
        self.ahead_s = 0.0

    def now(self) -> float:
        return self.true() + self.ahead_s

    def set(self, ahead_s: str) -> None:
        self.ahead_s = float(ahead_s)


CLOCK = _Clock()
time.time = CLOCK.now
time.time_ns = lambda: round(CLOCK.now() * 1e9)

from gr_ros2.cli.main import run  # noqa: E402 - after the clock is wrong, as in a computer
from gr_ros2.middleware import Qos  # noqa: E402
from gr_ros2.middleware.memory import MemoryMiddleware  # noqa: E402
from gr_ros2.observe.positions import humble_types  # noqa: E402
from tests.said import say  # noqa: E402

POINT = "geometry_msgs/msg/PointStamped"
PERIOD_S = 0.1
KEEPS = Qos("reliable", "volatile", 10)


def main(file: str, number: str, ahead_s: str, *options: str) -> int:
    CLOCK.set(ahead_s)
    store = humble_types()
    types = store.types

    def stamped() -> bytes:
        true = CLOCK.true()
        seconds, rest = divmod(round((true + CLOCK.ahead_s) * 1e9), 10**9)
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
        place = types["geometry_msgs/msg/Point"](x=true, y=0.0, z=0.0)
        return bytes(store.serialize_cdr(types[POINT](header=header, point=place), POINT))

    def hear(payload: bytes) -> None:
        message = store.deserialize_cdr(payload, POINT)
        stamp = message.header.stamp
        say("got", message.point.x, stamp.sec + stamp.nanosec * 1e-9)

    def be_told() -> None:
        for line in sys.stdin:
            CLOCK.set(line)

    over = threading.Event()
    with MemoryMiddleware(domain_id=0) as graph:
        place = graph.advertise(f"/robot_{number}/place", POINT, KEEPS)
        graph.subscribe(f"/rx_robot_{3 - int(number)}/place", POINT, KEEPS, hear)

        def publish() -> None:
            while not over.wait(PERIOD_S):
                place.publish(stamped())

        for work in (publish, be_told):
            threading.Thread(target=work, daemon=True).start()
        try:
            return run(["link", file, *options])
        finally:
            over.set()


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
