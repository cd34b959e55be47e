"""An hour's outage of a link of which a tenth of the air is free: how long the gap takes to be filled, and how old
odometry is beside it. Where packets are lost, the topics' repairs take their part of that tenth.

One robot sends odometry and a scan to one that reports, one packet per slot and direction. Every message of odometry
that was made is counted at the other end.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from bench.repair import RATE
from bench.rows import Row
from gr_ros2.calls.backfill import Later, read_later
from gr_ros2.gr.backfill import Backfill
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered, SenderEvent
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.settings.robot import BackfillConfig

PACKET_LEN, SIZE = 220, 205
ODOM, SCAN = 0, 1
HZ = {ODOM: 10.0, SCAN: 0.9 * RATE - 10.0}
"""Messages/s, each in a packet of its own: nine tenths of the slots."""
MET_S, OUTAGE_S, ALONE_S = 30.0, 3600.0, 400.0
MOST_S = 3 * OUTAGE_S
"""s after which the filling is given up."""
LOOK_S = 0.1
ROOM = 206
"""bytes of a packet that carry messages."""
LOSS, LOSSY_S = 0.05, 600.0
"""Share of packets lost in a further run, and s of its outage."""
OLDER, LONGER = 1.1, 1.15
"""Age of odometry beside the filling over that without, and its time over that of its bytes, at most."""


@dataclass
class Filled:
    """What became of one outage.

    :ivar took_s: s from the end of the outage until the gap was filled
    :ivar needed_s: s that the bytes of what filled it take of the air that other topics and their repairs leave, with
        repairs of their own
    :ivar age_s: mean age of odometry meanwhile
    :ivar missing: messages of odometry that have not come
    """

    took_s: float
    needed_s: float
    age_s: float
    missing: int


def fill(outage_s: float, loss: float = 0.0) -> Filled:
    """One outage both ways; 0 s for the age without one."""
    queues = {"odom": SendOptions(queue="latest"), "scan": SendOptions(queue="fifo", reliability="best_effort")}
    names = Registry([Topic(n, name, "std_msgs/msg/String", how) for n, (name, how) in enumerate(queues.items())])
    notes: list[Callable[[SenderEvent], None]] = []

    def tell(event: SenderEvent) -> None:
        for note in notes:
            note(event)

    sender = EndpointV1(
        names,
        Settings(1, packet_len=PACKET_LEN, packet_s=lambda: 1 / RATE),
        boot=1000,
        observer=tell,
    )
    receiver = EndpointV1(None, Settings(2, packet_len=PACKET_LEN), boot=2000)
    config = BackfillConfig(topics=("odom",), for_s=2 * OUTAGE_S, memory_mb=100)
    backfill = Backfill(config, sender, share=1.0, chosen=lambda topic: topic == ODOM, wall_ahead=lambda: 0.0)
    notes.append(backfill.note)
    for end in (sender, receiver):
        end.pace.use_credit()
    rng, slot = random.Random(1), 1 / RATE
    made = dict.fromkeys(HZ, 0)
    came: set[int] = set()
    back_at, looked = MET_S + outage_s, 0.0
    newest, area, since, size, index, now = 0.0, 0.0, back_at, 0, 0, 0.0

    def odometry(payload: bytes) -> int:
        number = int.from_bytes(payload[:4], "big")
        came.add(number)
        return number

    end_at = back_at + (MOST_S if outage_s else ALONE_S)
    while now < end_at and not (outage_s and now > back_at + 5 and not len(backfill.kept)):
        now, index = index * slot, index + 1
        for topic, hz in HZ.items():
            while made[topic] / hz <= now:
                payload = made[topic].to_bytes(4, "big") + rng.randbytes(SIZE - 4)
                sender.messages.submit(topic, payload, made[topic] / hz)
                made[topic] += 1
        if now >= looked + LOOK_S:
            backfill.look(now)
            looked = now
        for end in (sender, receiver):
            end.pace.credit(end.pace.out_of_credit)
        sent, answer = sender.next_packet(now), receiver.next_packet(now)
        away = MET_S <= now < back_at
        events = receiver.handle_timeout(now + slot)
        if sent is not None and not away and rng.random() >= loss:
            events += receiver.receive(AirPacket(sent.data), now + slot)
        if answer is not None and not away and rng.random() >= loss:
            sender.receive(AirPacket(answer.data), now + slot)
        sender.handle_timeout(now + slot)
        for event in events:
            if not isinstance(event, Delivered):
                continue
            if event.topic_id == ODOM:
                at = odometry(event.payload) / HZ[ODOM]
                if now > back_at + 5:
                    area += ((now - newest) ** 2 - (since - newest) ** 2) / 2
                    since = now
                newest = max(newest, at)
            elif event.topic_id != SCAN:
                size += len(event.payload)
                for each in read_later(event.payload):
                    if isinstance(each, Later):
                        odometry(each.payload)
        if now <= back_at + 5:
            since, area = now, 0.0
    free = (1 - loss - 0.9) * RATE * ROOM
    lost = made[ODOM] - len(came)
    return Filled(now - back_at, size / free, area / (since - back_at - 5), lost)


def backfill() -> list[Row]:
    """An hour's outage, and none."""
    found = fill(OUTAGE_S)
    without, lossy = fill(0.0), fill(LOSSY_S, LOSS)
    note = f"{found.took_s / 60:.0f} min; {found.age_s * 1e3:.0f} ms beside it, {without.age_s * 1e3:.0f} ms alone"
    return [
        Row("an hour filled, over what its bytes need", found.took_s / found.needed_s, "", "≤", LONGER, "{:.2f}", note),
        Row("age of odometry beside it", found.age_s / without.age_s, "", "≤", OLDER, "{:.2f}"),
        Row("messages of odometry still missing", found.missing, "", "≤", 2),
        Row("10 min at 5 % loss, over what bytes need", lossy.took_s / lossy.needed_s, "", "≤", LONGER, "{:.2f}"),
        Row("messages of odometry missing then", lossy.missing, "", "≤", 2),
    ]
