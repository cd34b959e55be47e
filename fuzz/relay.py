"""Relaying: whatever messages of other robots are heard, choosing goes on, and each costs a bounded work."""

from __future__ import annotations

from collections import Counter
from functools import partial

from fuzz.loop import main, within, work
from gr_ros2.core.errors import WireError
from gr_ros2.link.v1.custody import MOST_HELD, Custody
from gr_ros2.link.v1.repair import RepairWindow
from gr_ros2.link.v1.sent_topics import SentTopics
from gr_ros2.relay.gain import Gains, Stream
from gr_ros2.relay.memory import Memory
from gr_ros2.relay.robots import OtherRobots
from gr_ros2.relay.routes import Routes
from gr_ros2.wire.control import Newest
from gr_ros2.wire.relayed import Receipt, Relayed, read_carried, read_relayed, write_carried, write_relayed

MOST_LINES = 12_000
"""Lines of Python for a message heard, and for a choice among 40 streams for 40 neighbours."""
_STEP = 20
"""Bytes that make a packet: sender, time, two robots that it hears, a number told, message."""


def relay(data: bytes) -> None:
    """Take the bytes as packets heard, and choose in between."""
    gains, dropped = Gains(1, OtherRobots()), Counter[str]()
    now = 0.0
    topics, window = SentTopics(None, ()), RepairWindow("off", 200)
    topics.relay()
    custody = Custody(
        (1, 1),
        topics,
        window.packets,
        window.peers,
        gains=gains,
        routes=Routes(gains.robots),
        room=200,
        most=10_000,
        share=Memory(10_000).share(),
        dropped=dropped,
        drop=lambda _: None,
        ended=lambda *_: None,
    )
    for start in range(0, min(len(data), 40 * _STEP), _STEP):
        src_id, later, *names = (data[start : start + 4] + bytes(4))[:4]
        now += later / 256
        try:
            message = read_relayed(data[start + 6 : start + _STEP])
        except WireError:
            continue
        assert write_relayed(message) == data[start + 6 : start + _STEP]
        stream = Stream(message.origin, message.start, message.topic_id)
        told = Newest(message.origin, message.start & 0xFF, message.topic_id, data[start + 4])
        gains.neighbour(src_id, now, names, 2)
        within(MOST_LINES, partial(gains.message, src_id, stream, message.number, now))
        within(MOST_LINES, partial(gains.told, src_id, told))
        _, (best, _) = work(partial(gains.best, now), MOST_LINES)
        if best is not None:
            assert gains.has(best) >= 0
            gains.sent(best, gains.has(best), now)
        assert len(gains.tells()) <= 2
        carry(custody, dropped, data[start + 5 : start + _STEP], src_id, now)


def carry(custody: Custody, dropped: Counter[str], data: bytes, src_id: int, now: float) -> None:
    """Take the bytes as a message that a robot hands over."""
    try:
        taker, message = read_carried(data)
    except WireError:
        return
    assert write_carried(taker, message) == data
    held = len(custody) + dropped["custody_full"]
    custody.routes.note(message.origin, src_id, message.hops, now)
    within(MOST_LINES, partial(custody.take, message, src_id, now, made=now))
    within(MOST_LINES, partial(custody.receipt, message.origin, Receipt(message.start, message.topic_id, 0, 0)))
    within(MOST_LINES, partial(custody.offer, now, now))
    assert held <= len(custody) + dropped["custody_full"], "what is not held any more is counted"
    assert len(custody) <= MOST_HELD


def corpus() -> list[bytes]:
    """Robots of which each sends on what the one before has said."""
    heard = b""
    for n in range(40):
        message = write_relayed(Relayed(n % 7, 1, n, 0, 0, n % 4, b"odom"))
        heard += bytes((2 + n % 3, 64, 1, 3, n, 0)) + message
    carried = b"".join(
        bytes((2 + n % 3, 64, 1, 3, n)) + write_carried(1, Relayed(n % 7, 1, n, 128, 0, n % 4, b"", dst_id=9))
        for n in range(40)
    )
    return [b"", heard[:_STEP], heard, carried]


if __name__ == "__main__":
    main(relay, corpus())
