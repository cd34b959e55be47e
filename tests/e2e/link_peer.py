"""A robot's own programs, in another process: ``link_peer.py ROBOT OTHER``, until its input ends.

Publishes a numbered message on ``/robot_ROBOT/chat`` twenty times a second and says ``sent N`` and, of what comes from
the other robot, ``got N``.
"""

from __future__ import annotations

import sys
import threading

from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from tests.middleware.support import BEST_EFFORT, CUSTOM, message
from tests.said import say

DOMAIN = 7
PERIOD_S = 0.05
CHAT = Qos("reliable", "volatile", 10)
"""Bounded, as ROS's default is: a publisher that keeps everything waits for a link that was killed."""


def main(robot: str, other: str) -> None:
    graph = DdsMiddleware(domain_id=DOMAIN, node_name=f"programs_{robot}", localhost_only=True)
    graph.subscribe(
        f"/rx_robot_{other}/chat",
        CUSTOM,
        BEST_EFFORT,
        lambda data: say("got", int.from_bytes(data[4:8], "little")),
    )
    chat = graph.advertise(f"/robot_{robot}/chat", CUSTOM, CHAT)
    over = threading.Event()

    def talk() -> None:
        number = 0
        while not over.wait(PERIOD_S):
            chat.publish(message(number, 200))
            say("sent", number)
            number += 1

    talker = threading.Thread(target=talk)
    talker.start()
    sys.stdin.read()
    over.set()
    talker.join()
    graph.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
