"""A node of rclpy in a process of its own: `rclpy_peer.py DOMAIN NAME talk|listen TOPIC TYPE [TOPIC TYPE …]`.

``talk`` publishes on each topic every 50 ms; ``listen`` subscribes them. Out: ``ready``, and ``heard TOPIC`` with the
first message of each. End of input ends it.
"""

from __future__ import annotations

import sys
import threading
from functools import partial
from importlib import import_module

import rclpy
from rclpy.node import Node


def main(domain: str, name: str, role: str, *topics: str) -> None:
    rclpy.init(domain_id=int(domain))
    node: Node = rclpy.create_node(name)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    heard: set[str] = set()

    def hear(topic: str, _: object) -> None:
        if topic not in heard:
            heard.add(topic)
            print("heard", topic, flush=True)

    publishers = []
    for topic, kind in zip(topics[::2], topics[1::2], strict=True):
        package, _, word = kind.partition("/msg/")
        message = getattr(import_module(f"{package}.msg"), word)
        if role == "talk":
            publishers.append((node.create_publisher(message, topic, 10), message()))
        else:
            node.create_subscription(message, topic, partial(hear, topic), 10)
    print("ready", flush=True)
    while not ended.is_set():
        rclpy.spin_once(node, timeout_sec=0.05)
        for publisher, message in publishers:
            publisher.publish(message)
    rclpy.shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
