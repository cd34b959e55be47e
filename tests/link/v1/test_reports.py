"""Reports take a share of the packets, and losses are reported at once all the same."""

from __future__ import annotations

import pytest

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.events import SentPacket
from gr_ros2.wire.control import MAP
from tests.link.v1.air import SLOT_S, Air, Robot, registry

TUNING = Tuning()


def kinds(robot: Robot) -> list[str]:
    return [event.kind for event in robot.events if isinstance(event, SentPacket)]


@pytest.mark.parametrize(("loss", "share"), [(0.0, 0.2), (0.1, 0.3), (0.2, 0.36)])
def test_reports_take_no_more_than_their_share(loss: float, share: float) -> None:
    """Where the reverse direction carries nothing else, a report could leave for every packet."""
    one, two = Robot(1, registry()), Robot(2)
    air = Air(one, two, loss=loss)
    air.run(1.0)
    begun = len(kinds(one)), kinds(two).count("report")
    for number in range(1500):
        one.end.messages.submit(0, number.to_bytes(46, "big"), air.now)
        air.step()
    heard = len(kinds(one)) - begun[0]
    reports = kinds(two).count("report") - begun[1]
    seconds = 1500 * SLOT_S
    allowed = (1 - loss) / TUNING.report_per_arrived + loss * TUNING.report_per_loss
    assert heard / (MAP / 2) < reports < heard * allowed + 10 * seconds
    assert reports < share * (heard + reports)


def test_a_loss_is_reported_at_once() -> None:
    one, two = Robot(1, registry()), Robot(2)
    air = Air(one, two)
    for number in range(200):
        one.end.messages.submit(0, number.to_bytes(46, "big"), air.now)
        air.step()
    before = kinds(two).count("report")
    for lost in (True, False, False):
        air.lost = lambda sender, _, lost=lost: sender is one and lost
        one.end.messages.submit(0, bytes(46), air.now)
        air.step()
    assert kinds(two).count("report") > before
