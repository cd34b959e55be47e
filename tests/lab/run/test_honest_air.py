"""On the real flowgraph too, packets take their airtime one after the other, and none is composed before its time."""

from __future__ import annotations

import numpy as np
import pytest

from gr_ros2.core.arrays import Floats
from gr_ros2.link.airtime import LEAD_S, OUTSTANDING
from gr_ros2_lab.run.outcome import Outcome
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario

MEMORY = ("graph.middleware=memory",)
ROUNDING_S = 1e-6


def air(outcome: Outcome) -> tuple[Floats, Floats, Floats]:
    """When each packet left the source, when at the earliest it has been on the air, and when it was received."""
    airtime = outcome.result.phy["airtime_s"]
    sent, received = outcome.trace.packets().times()
    over = np.empty_like(sent)
    free = -np.inf
    for number, t in enumerate(sent):
        free = over[number] = max(t, free) + airtime
    return sent, over, received


@pytest.mark.parametrize("name", ["paper-ofdm", "paper-ofdm-paced", "six-topics-paced"])
def test_messages_take_at_least_the_airtime_of_their_packets(name: str) -> None:
    """However many packets are sent at once: the k-th of them is not received before k airtimes have passed."""
    outcome = run_scenario(load_scenario(name, MEMORY, duration_s=2.0))
    sent, over, received = air(outcome)
    there = ~np.isnan(received)
    assert there.sum() > 10
    assert (received - over)[there].min() >= -ROUNDING_S
    if outcome.result.config["packet_rate"] == "auto":
        waiting = [int((over[:number] > sent[number] + ROUNDING_S).sum()) for number in range(len(sent))]
        assert max(waiting) < OUTSTANDING, "packets before it that were not through when it was composed"
        assert (sent[1:] - over[:-1]).min() >= -LEAD_S - ROUNDING_S, (
            "composed earlier than the air was about to be free"
        )

    packets = outcome.trace.packets()
    last = dict(zip(packets.serial.tolist(), packets.packet.tolist(), strict=True))
    for messages in outcome.trace.messages():
        for serial, done in zip(messages.serial, messages.t_delivered, strict=True):
            if not np.isnan(done):
                assert done >= over[last[int(serial)]] - ROUNDING_S, "delivered before its last packet was through"
