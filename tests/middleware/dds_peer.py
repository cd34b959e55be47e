"""A peer in another process: ``dds_peer.py DOMAIN TOPIC TYPE pub|sub RELIABILITY DURABILITY DEPTH``; see Peer."""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

from gr_ros2.middleware import Middleware, Publisher, Qos, Subscription
from gr_ros2.middleware.dds import DdsMiddleware
from tests.said import say


def report(middleware: Middleware, endpoint: Publisher | Subscription, stop: threading.Event) -> None:
    """Say whenever the number of matches or a counter changes."""
    last: tuple[int, str] | None = None
    while not stop.wait(0.01):
        now = endpoint.matched(), json.dumps(middleware.counters)
        if now != last:
            say("matched", now[0])
            say("counters", now[1])
            last = now


def main(domain: str, topic: str, type_name: str, role: str, *qos_words: str) -> None:
    words: Any = [None if word == "adapt" else word for word in qos_words[:2]]
    qos = Qos(*words, int(qos_words[2]))
    middleware = DdsMiddleware(domain_id=int(domain), node_name=f"peer_{role}")
    endpoint: Publisher | Subscription
    if role == "pub":
        endpoint = middleware.advertise(topic, type_name, qos)
    else:
        endpoint = middleware.subscribe(topic, type_name, qos, lambda data: say("data", data.hex()))
    stop = threading.Event()
    reporter = threading.Thread(target=report, args=(middleware, endpoint, stop))
    reporter.start()
    say("ready")
    for line in sys.stdin:
        if isinstance(endpoint, Publisher):
            endpoint.publish(bytes.fromhex(line.strip()))
    stop.set()
    reporter.join()
    middleware.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
