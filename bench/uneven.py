"""Messages that do not come evenly, over a channel of one packet at a time: at random, in pairs, or as a command before
silence.

As on the air of a radio, a packet leaves as soon as the one before has ended, so that a repair that has begun delays
the message that comes.
"""

from __future__ import annotations

import random
from collections import deque
from itertools import count

from bench.repair import losses
from gr_ros2.core.tuning import Tuning
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered, ReceiverEvent
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic

_STEPS = 12
"""Looks at an end per airtime."""
_TOPICS = Registry(
    [
        Topic(0, "odom", "nav_msgs/msg/Odometry", SendOptions(queue="latest", reliability="best_effort")),
        Topic(1, "cmd", "std_msgs/msg/String", SendOptions(queue="fifo", reliability="reliable")),
    ]
)


def random_times(seed: int, hz: float, seconds: float) -> list[tuple[float, int]]:
    """Times and topics of messages that come at random (a Poisson process)."""
    rng, at = random.Random(seed), 0.0
    found: list[tuple[float, int]] = []
    while at < seconds:
        at += rng.expovariate(hz)
        found.append((at, 1))
    return found


def pairs(seed: int, hz: float, seconds: float) -> list[tuple[float, int]]:
    """Times and topics of messages in pairs, 2 to 10 ms apart."""
    rng = random.Random(seed)
    firsts = [2 * n / hz for n in range(int(seconds * hz / 2))]
    return [(at, 1) for first in firsts for at in (first, first + rng.uniform(0.002, 0.01))]


def commands(seed: int, airtime: float, seconds: float) -> list[tuple[float, int]]:
    """Times and topics of some odometry, then a command, then nothing for 1 to 4 s."""
    rng, at = random.Random(seed), 3.0
    found: list[tuple[float, int]] = []
    while at < seconds:
        burst = rng.randint(1, 6)
        found += [(at + n * airtime * rng.choice((1, 2)), 0) for n in range(burst)]
        found.append((at + 2 * burst * airtime, 1))
        at += rng.uniform(1.0, 4.0)
    return sorted(found)


def waits(
    messages: list[tuple[float, int]],
    loss: float,
    airtime: float,
    *,
    back: bool,
    seed: int,
    tail: float = 20.0,
    tuning: Tuning = Tuning(),
) -> list[float]:
    """s from submission to delivery of each reliable message that arrives.

    :param messages: times (s) and topics
    :param back: whether the receiver reports, over a reverse direction of the same loss
    """
    sender = EndpointV1(_TOPICS, Settings(1, packet_len=64, hears=back, tuning=tuning), boot=1000)
    receiver = EndpointV1(None, Settings(2, packet_len=64, hears=back, tuning=tuning), boot=2000)
    ways = [
        (sender, receiver, losses(seed * 1000, loss, 1.0)),
        (receiver, sender, losses(seed * 1000 + 500, loss, 1.0)),
    ][: 1 + back]
    for end in (sender, receiver):
        end.pace.use_credit()
    free = [0.0, 0.0]
    under_way: list[deque[tuple[float, bytes]]] = [deque(), deque()]
    coming = deque(enumerate(messages))
    found: list[float] = []
    for step in count():
        now = step * airtime / _STEPS
        if now > messages[-1][0] + tail:
            return found
        while coming and coming[0][1][0] <= now:
            number, (at, topic) = coming.popleft()
            sender.messages.submit(topic, number.to_bytes(4, "big").ljust(40, b"."), at)
        for way, (end, other, lost) in enumerate(ways):
            if now >= free[way]:
                end.pace.credit(end.pace.out_of_credit)
                packet = end.next_packet(now)
                if packet is not None:
                    free[way] = now + airtime
                    if not next(lost):
                        under_way[way].append((free[way], packet.data))
            events: list[ReceiverEvent] = []
            while under_way[way] and under_way[way][0][0] <= now:
                events += other.receive(AirPacket(under_way[way].popleft()[1]), now)
            if not step % _STEPS:
                events += other.handle_timeout(now)
            for event in events:
                if isinstance(event, Delivered) and event.topic_id:
                    found.append(now - messages[int.from_bytes(event.payload[:4], "big")][0])
    raise AssertionError
