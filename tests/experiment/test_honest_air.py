"""On the real flowgraph too, no message completes before its packets have been on the air."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.experiment.runner import run_scenario
from gr_ros2.experiment.scenario import load_scenario

MEMORY = ("ros_source.middleware=memory", "ros_sink.middleware=memory")


@pytest.mark.parametrize("name", ["paper-ofdm", "paper-ofdm-paced"])
def test_messages_take_at_least_the_airtime_of_their_packets(name: str) -> None:
    outcome = run_scenario(load_scenario(name, MEMORY, duration_s=2.0))
    airtime = outcome.result.phy["airtime_s"]
    packets = outcome.trace.packets()
    sent, received = packets.times()
    there = ~np.isnan(received)
    assert there.any()
    assert (received - sent)[there].min() >= airtime
    (messages,) = outcome.trace.messages()
    fragments = dict(zip(packets.serial.tolist(), packets.total.tolist(), strict=True))
    for serial, begun, done in zip(messages.serial, messages.t_sent, messages.t_delivered, strict=True):
        if not np.isnan(done):
            assert done - begun >= fragments[serial] * airtime
