"""A peer in another process: ``dds_peer.py DOMAIN TOPIC TYPE pub|sub RELIABILITY DURABILITY DEPTH``; see Peer."""

from __future__ import annotations

import sys
import threading
from typing import Any

from gr_ros2.middleware import Publisher, Qos, Subscription
from gr_ros2.middleware.dds import DdsMiddleware


def report_matches(endpoint: Publisher | Subscription, stop: threading.Event) -> None:
    last = -1
    while not stop.wait(0.01):
        matched = endpoint.matched()
        if matched != last:
            print("matched", matched, flush=True)
            last = matched


def main(domain: str, topic: str, type_name: str, role: str, *qos_words: str) -> None:
    words: Any = [None if word == "adapt" else word for word in qos_words[:2]]
    qos = Qos(*words, int(qos_words[2]))
    middleware = DdsMiddleware(domain_id=int(domain), node_name=f"peer_{role}")
    endpoint: Publisher | Subscription
    if role == "pub":
        endpoint = middleware.advertise(topic, type_name, qos)
    else:
        endpoint = middleware.subscribe(topic, type_name, qos, lambda data: print("data", data.hex(), flush=True))
    stop = threading.Event()
    reporter = threading.Thread(target=report_matches, args=(endpoint, stop))
    reporter.start()
    print("ready", flush=True)
    for line in sys.stdin:
        if isinstance(endpoint, Publisher):
            endpoint.publish(bytes.fromhex(line.strip()))
    stop.set()
    reporter.join()
    middleware.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
