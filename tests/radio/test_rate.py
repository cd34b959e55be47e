"""Robots whose links have an adaptive rate: it follows the SNR of real samples, and of a robot in another process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.link import SenderEvent
from gr_ros2.link.events import ReceiverEvent, SentPacket
from tests.radio.robot_process import RobotProcess
from tests.radio.robots import RATE, Robot
from tests.waiting import wait_for

ADAPTIVE = {"phy": {"name": "ofdm", "sample_rate": RATE, "options": {"rate": "adaptive"}}}


class Rates:
    """The rates of the packets that carried messages."""

    def __init__(self) -> None:
        self.sent: list[int] = []

    def sender_event(self, _src_id: int, event: SenderEvent) -> None:
        if isinstance(event, SentPacket) and event.kind == "new":
            self.sent.append(event.mcs)

    def receiver_event(self, _event: ReceiverEvent, _now: float) -> None:
        pass


@pytest.fixture
def ends(tmp_path: Path) -> list[dict[str, Any]]:
    """Front end settings of robots 1 and 2."""
    addresses = [f"ipc://{tmp_path}/{number}" for number in (1, 2)]
    return [{"name": "zmq", "bind": own, "connect": [other]} for own, other in (addresses, reversed(addresses))]


@pytest.mark.slow
@pytest.mark.parametrize(("snr_db", "least", "most"), [(9.0, 2, 3), (35.0, 6, 6)])
def test_the_rate_is_what_the_noise_of_the_samples_allows(
    ends: list[dict[str, Any]], snr_db: float, least: int, most: int
) -> None:
    rates = Rates()
    channel = {"snr_db": snr_db}
    with (
        Robot(1, ends[0], observer=rates, **ADAPTIVE) as one,
        Robot(2, ends[1], hears=(1,), channel=channel, **ADAPTIVE) as two,
    ):

        def risen() -> bool:
            one.say(len(rates.sent))
            return max(rates.sent, default=0) >= least

        wait_for(risen, "the rate to rise")
        heard = len(two.heard)

        def delivered() -> bool:
            one.say(0)
            return len(two.heard) > heard + 20

        wait_for(delivered, "messages at that rate")
        assert one.link.stats()["phy"]["mcs"] in [mcs.name for mcs in one.link.phy.mcs_table]
    assert max(rates.sent) <= most
    assert rates.sent[0] == 0


@pytest.mark.slow
def test_the_rate_rises_when_a_robot_in_another_process_reports(ends: list[dict[str, Any]]) -> None:
    rates = Rates()
    with Robot(1, ends[0], hears=(2,), observer=rates, **ADAPTIVE) as one:
        one.say(1)
        other = RobotProcess(2, ends[1], first=1, **ADAPTIVE)
        try:

            def risen() -> bool:
                one.say(2)
                return max(rates.sent, default=0) == len(one.link.phy.mcs_table) - 1

            wait_for(risen, "the rate to rise")
            wait_for(lambda: bool(one.heard), "the other robot's messages")
        finally:
            other.kill()
    assert rates.sent[0] == 0


def test_a_robot_that_hears_itself_alone_is_served_at_the_most_robust_rate() -> None:
    rates = Rates()
    with Robot(1, {"name": "sim"}, hears=(1,), observer=rates, **ADAPTIVE) as robot:
        said = robot.say(*range(5))
        wait_for(lambda: robot.heard == said, "every message")
    assert set(rates.sent) == {0}
