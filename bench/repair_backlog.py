"""Long messages of a reliable topic back to back: do all arrive, and how old is odometry beside them?

With reports and one way. One packet per slot and direction, as in :mod:`bench.repair`. The case "1 MB, then 1 B" has a
message before a backlog that takes longer than any timer; the case "five of 200 kB" has several.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from math import inf

from bench.repair import RATE, losses, quantile
from bench.rows import Row
from gr_ros2.core.tuning import Tuning
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic

CASES = {"1 MB, then 1 B": (1_000_000, 1), "five of 200 kB": (200_000,) * 5}
LOSSES = (0.0, 0.05, 0.2)
OLDER = 1.3
"""Mean age of odometry beside the long messages over that without them, at most, where there are reports."""
SEEDS = (1, 2, 3)
HZ, SIZE, PACKET_LEN = 35.0, 45, 1500
BEGIN_S, END_S = 4.0, 30.0
"""s at which the long messages are submitted, and at which a run is given up."""


@dataclass
class Beside:
    """What became of the messages.

    :ivar done: s until all long messages were delivered, from their submission on
    :ivar delivered: sizes of the long messages delivered
    :ivar waits: s from submission to delivery, per message of odometry submitted meanwhile
    :ivar age: mean age of odometry meanwhile, s
    """

    done: float = inf
    delivered: list[int] = field(default_factory=list)
    waits: list[float] = field(default_factory=list)
    age: float = 0.0
    submitted: int = 0


@lru_cache
def run(
    sizes: tuple[int, ...],
    loss: float,
    *,
    odometry: bool = True,
    reports: bool = True,
    seed: int = 1,
    tuning: Tuning = Tuning(),
) -> Beside:
    """One robot that sends to one that reports, or that only listens."""
    options = SendOptions(queue="fifo", reliability="reliable")
    names = Registry([Topic(n, name, "std_msgs/msg/String", options) for n, name in enumerate(("odom", "long"))])
    sender = EndpointV1(names, Settings(1, packet_len=PACKET_LEN, hears=reports, tuning=tuning), boot=1000)
    receiver = EndpointV1(None, Settings(2, packet_len=PACKET_LEN, hears=reports, tuning=tuning), boot=2000)
    sender.pace.use_credit()
    receiver.pace.use_credit()
    forward, backward = losses(seed * 1000, loss, 1.0), losses(seed * 1000 + 500, loss, 1.0)
    outcome, slot, index, number, newest, area, now = Beside(), 1 / RATE, 0, 0, -1, 0.0, 0.0
    while now < END_S and not (sizes and outcome.done < inf):
        now, index = index * slot, index + 1
        while odometry and number / HZ <= now:
            sender.messages.submit(0, number.to_bytes(4, "big").ljust(SIZE, b"."), number / HZ)
            number += 1
        if sizes and not outcome.submitted and now >= BEGIN_S:
            outcome.submitted = len(sizes)
            for size in sizes:
                sender.messages.submit(1, size.to_bytes(4, "big").ljust(size, b".")[:size], now)
        sender.pace.credit(sender.pace.out_of_credit)
        receiver.pace.credit(receiver.pace.out_of_credit)
        sent, answer = sender.next_packet(now), receiver.next_packet(now)
        events = receiver.handle_timeout(now + slot)
        if not next(forward) and sent is not None:
            events += receiver.receive(AirPacket(sent.data), now + slot)
        if not next(backward) and answer is not None:
            sender.receive(AirPacket(answer.data), now + slot)
        sender.handle_timeout(now + slot)
        for event in events:
            if isinstance(event, Delivered) and event.topic_id:
                outcome.delivered.append(len(event.payload))
            elif isinstance(event, Delivered):
                newest = int.from_bytes(event.payload[:4], "big")
                outcome.waits += [now + slot - newest / HZ] if now >= BEGIN_S else []
        area += (now + slot - newest / HZ) * (now >= BEGIN_S)
        if len(outcome.delivered) == len(sizes):
            outcome.done = min(outcome.done, now + slot - BEGIN_S)
    outcome.age = area * slot / (now + slot - BEGIN_S)
    return outcome


def repair_backlog() -> list[Row]:
    """Every long message arrives, and odometry beside them is hardly older."""
    rows: list[Row] = []
    for reports, loss in product((True, False), LOSSES):
        alone = sum(run((), loss, reports=reports, seed=seed).age for seed in SEEDS)
        for name, sizes in CASES.items():
            what = f"repair: {name}, {loss:.0%} lost" + ("" if reports else ", one way")
            besides = [run(sizes, loss, reports=reports, seed=seed) for seed in SEEDS]
            withouts = [run(sizes, loss, odometry=False, reports=reports, seed=seed) for seed in SEEDS]
            for odometry, outcomes in (("", withouts), (" beside odometry", besides)):
                count = min(len(outcome.delivered) for outcome in outcomes)
                rows.append(Row(f"{what}{odometry}: delivered", count, "messages", "≥", len(sizes)))
                rows.append(Row(f"{what}{odometry}: after", max(o.done for o in outcomes), "s", form="{:.1f}"))
            age = sum(outcome.age for outcome in besides)
            p99 = quantile([wait for outcome in besides for wait in outcome.waits], 0.99)
            note = f"{age / len(SEEDS) * 1e3:.1f} ms, p99 {p99 * 1e3:.0f} ms"
            ratio = Row(f"{what}: age of odometry over that without", age / alone, form="{:.2f}", note=note)
            rows.append(replace(ratio, sense="≤", target=OLDER) if reports else ratio)
    return rows
