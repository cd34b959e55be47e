"""What an endpoint of version 1 costs: sealing, opening, repairing and decoding, beside plain Python."""

from __future__ import annotations

import random
import time

from bench.rows import Row
from bench.yardstick import cost
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered, SentPacket
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.sealing import Keys
from gr_ros2.settings.registry import Registry

PACKET_LEN, MESSAGES, REPEATS, LOSS = 64, 10_000, 5, 0.2
MOST = {"sending": 800, "receiving": 600}
"""Turns of plain Python that a packet may take at each end."""
PACKETS_S = 20_000.0


def endpoint() -> list[Row]:
    """Encrypted messages of one packet each, half of the slots idle, 20 % lost, with reports: each end's own time."""
    rows = []
    for place, (end, most) in enumerate(MOST.items()):
        took = cost(REPEATS, lambda place=place: 1 / transfer()[place])  # type: ignore[misc]
        what = f"endpoint: a packet of the {end} end, over a turn of plain Python"
        rows.append(Row(what, took.turns, "", "≤", most, "{:.0f}", took.note))
    return rows


def transfer() -> tuple[float, float]:
    """Packets/s of processor time of the sending and of the receiving end."""
    keys = Keys((bytes(32),), "encrypt")
    topics = Registry.from_rows({"odom": "nav_msgs/Odometry"})
    sender = EndpointV1(topics, Settings(1, packet_len=PACKET_LEN, repair="idle"), boot=5, keys=keys)
    receiver = EndpointV1(None, Settings(2, packet_len=PACKET_LEN), boot=6, keys=keys)
    sender.pace.use_credit()
    receiver.pace.use_credit()
    rng = random.Random(1)
    payloads = [rng.randbytes(45) for _ in range(256)]
    clock = time.thread_time
    spent = [0.0, 0.0]
    packets = [0, 0]
    delivered = submitted = 0
    now = 0.0
    while submitted < MESSAGES:
        # Slots are done in turns of 50 so that reading the clock costs nothing beside them.
        outgoing: list[tuple[SentPacket, float]] = []
        begin = clock()
        for slot in range(50):
            now += 1 / PACKETS_S
            if slot % 2:
                sender.messages.submit(0, payloads[submitted & 255], now)
                submitted += 1
            sender.pace.credit()
            sent = sender.next_packet(now)
            if sent is not None:
                outgoing.append((sent, now))
        packets[0] += len(outgoing)
        spent[0] += clock() - begin
        heard = [(AirPacket(sent.data, at), at) for sent, at in outgoing if rng.random() >= LOSS]
        begin = clock()
        for arrival, at in heard:
            delivered += sum(isinstance(event, Delivered) for event in receiver.receive(arrival, at))
        answers = []
        for _ in range(12):
            receiver.pace.credit()
            answer = receiver.next_packet(now)
            if answer is not None:
                answers.append(answer)
        receiver.handle_timeout(now)
        packets[1] += len(heard) + len(answers)
        spent[1] += clock() - begin
        begin = clock()
        for answer in answers:
            sender.receive(AirPacket(answer.data), now)
        sender.handle_timeout(now)
        packets[0] += len(answers)
        spent[0] += clock() - begin
    assert delivered > 0.99 * MESSAGES
    return packets[0] / spent[0], packets[1] / spent[1]
