"""Faults of a link: ends that restart and reports that are lost. What comes back, how soon, and which counters tell."""

from __future__ import annotations

import pytest

from gr_ros2.link.events import Delivered, Gone, Lost, Met
from gr_ros2.link.fates import Fate
from gr_ros2.link.v1.sealing import SealMode
from tests.link.v1.air import Air, Robot, registry

ODOM = 0
RECOVERED_S = 2.0
EVERY_S = 0.03


class Traffic:
    """Numbered messages of one topic, from one robot to the other over a channel that loses a fifth."""

    def __init__(self, mode: SealMode = "none") -> None:
        self.one, self.two = Robot(1, registry(), mode=mode), Robot(2, mode=mode)
        self.air = Air(self.one, self.two, loss=0.2)
        self.count = 0

    def run(self, seconds: float) -> None:
        """So long, with messages."""
        begin = self.air.now
        while self.air.now - begin < seconds:
            self.one.end.messages.submit(ODOM, b"%d" % self.count, self.air.now)
            self.count += 1
            self.air.run(EVERY_S)

    def here(self) -> list[int]:
        """The messages that arrived, in their order."""
        found = [int(event.payload) for event in self.two.events if isinstance(event, Delivered)]
        assert found == sorted(set(found)), "no message arrives twice, or after a later one"
        return found

    def recovers(self) -> None:
        """Of the messages submitted from a moment within two seconds on, every one arrives."""
        self.run(RECOVERED_S)
        first = self.count
        self.run(2.0)
        self.air.run(2.0)
        assert set(range(first, self.count)) <= set(self.here())


@pytest.mark.parametrize("mode", ["none", "encrypt"])
@pytest.mark.parametrize("who", ["sender", "receiver", "both"])
def test_twenty_restarts_in_a_row(mode: SealMode, who: str) -> None:
    traffic = Traffic(mode)
    one, two = traffic.one, traffic.two
    traffic.run(1.0)
    met = len([event for event in two.events if isinstance(event, Met)])
    assert met == 1
    for _ in range(20):
        if who != "receiver":
            one.start()
        if who != "sender":
            two.start()
        traffic.run(0.3)
    traffic.recovers()
    boots = [event.boot for event in two.events if isinstance(event, Met)]
    assert boots == sorted(boots)
    assert boots[-1] == one.boot
    least = 10 if mode != "none" else 4  # without a key, another start is taken once a second
    assert len(set(boots)) > least if who != "receiver" else set(boots) == {one.boot}
    # Packets of a start whose hello was lost cannot be opened, nor those of a start that is not taken yet.
    early = {"replayed"} if mode == "none" and who == "sender" else set()
    assert set(two.end.received.rejected) <= {"crc" if mode == "none" else "tag"} | early


def test_what_was_on_its_way_when_a_sender_restarts_is_named() -> None:
    traffic = Traffic()
    one, two = traffic.one, traffic.two
    traffic.run(1.0)
    usual = traffic.air.lost
    traffic.air.lost = lambda sender, receiver: sender is one or usual(sender, receiver)
    one.end.messages.submit(2, bytes(400), traffic.air.now)  # a map of ten packets
    traffic.air.run(0.02)
    traffic.air.lost = lambda sender, _: sender is two
    traffic.air.run(0.06)
    one.start()
    traffic.air.lost = usual
    traffic.recovers()
    lost = [event for event in two.events if isinstance(event, Lost)]
    assert [event.topic_id for event in lost if event.reason is Fate.SENDER_RESTARTED] == [2]
    assert two.end.received.lost[1, 2, Fate.SENDER_RESTARTED.value] == 1


def test_reports_that_are_lost_for_a_minute() -> None:
    """The sender takes its receiver for gone, repairs as one-way, and is told as soon as reports come again."""
    traffic = Traffic()
    one, two, air = traffic.one, traffic.two, traffic.air
    traffic.run(2.0)
    usual = air.lost
    air.lost = lambda sender, receiver: sender is two or usual(sender, receiver)
    traffic.run(60.0)
    gone = [event for event in one.events if isinstance(event, Gone)]
    assert [event.src_id for event in gone] == [2]
    assert not one.end.window.peers
    first = traffic.count
    air.lost = usual
    traffic.recovers()
    assert one.end.window.peers
    assert [event.src_id for event in one.events if isinstance(event, Met)] == [2, 2]
    air.run(2.0)
    assert len(traffic.here()) >= 0.998 * traffic.count
    assert set(range(first, traffic.count)) <= set(traffic.here())
