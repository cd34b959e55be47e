"""Who is heard: packets that come before the hello that opens them."""

from __future__ import annotations

import pytest

from tests.link.v1.air import Robot, registry


@pytest.mark.parametrize(("turn_s", "later_s"), [(0.01, 29.0), (1.0, 80.0)])
def test_packets_before_their_first_hello_are_kept_longer_where_packets_take_long(
    turn_s: float, later_s: float
) -> None:
    one = Robot(1, registry(), mode="encrypt", hears=False)
    two = Robot(2, mode="encrypt", packet_s=lambda: turn_s)
    sent = []
    while len(sent) < 5:  # in the first a hello, in the next ones its table
        one.end.messages.submit(1, b"scan", 0.0)
        if (data := one.slot(0.01 * len(sent))) is not None:
            sent.append(data)
    for data in sent[1:]:
        two.receive(data, 0.0)
    assert not two.delivered()
    two.receive(sent[0], later_s)
    assert two.delivered()
