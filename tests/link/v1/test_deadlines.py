"""The deadline of a topic, which its row of the table tells: no robot delivers or sends on what is older."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gr_ros2.link.queues import PublisherQos
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.ages import age_of
from tests.link.v1.air import SLOT_S, Air, Robot, registry
from tests.link.v1.test_ages import MODES, absent
from tests.link.v1.test_relaying import Line, robot
from tests.pairs import pairs

WITHIN_S = 4.0
SCAN = SendOptions(queue="deadline", deadline_s=WITHIN_S)
LATE_S = (1.0, 10.0, 3600.0)


def rows(**options: SendOptions) -> Registry:
    return registry(odom=SendOptions(queue="latest"), **options)


@pytest.mark.parametrize("after_s", LATE_S[:2])
@pytest.mark.parametrize("own_s", [None, 0.0, 20.0])
def test_what_waited_for_a_hello_counts_from_when_it_came(after_s: float, own_s: float | None) -> None:
    sender = Robot(1, rows(scan=SCAN), packet_len=128)
    receiver = Robot(2, packet_len=128, deadlines={} if own_s is None else {"/sc*": own_s})
    sender.end.messages.submit(1, b"scan", 0.0)
    packets = [data for n in range(6) if (data := sender.slot(n * SLOT_S)) is not None]
    hellos = [data for data in packets if Robot(3, packet_len=128).receive(data, 0.0)]
    assert 0 < len(hellos) < len(packets)
    for data in [data for data in packets if data not in hellos]:
        receiver.receive(data, 0.1)
    for data in hellos:
        receiver.receive(data, 0.1 + after_s)
    limit_s = WITHIN_S if own_s is None else own_s  # its own option goes before the row
    assert receiver.delivered() == [b"scan"] * (not limit_s or after_s < limit_s)
    assert receiver.end.received.lost[1, 1, "late"] == (not receiver.delivered())


@pytest.mark.parametrize(("limit_s", "mode"), [(0.3, "none"), (2.0, "encrypt")])
def test_a_rare_message_that_is_repaired_in_time_comes(mode: SealMode, limit_s: float) -> None:
    """Of a robot that says little else: when the packet before it came tells nothing."""
    sender = Robot(1, rows(scan=replace(SCAN, deadline_s=limit_s)), mode=mode)
    air = Air(sender, Robot(2, mode=mode), loss=0.2)
    air.run(5.0)
    ages: list[float] = []
    for number in range(60):
        payload, begin = b"scan %d" % number, air.now
        sender.end.messages.submit(1, payload, begin)
        while payload not in air.robots[1].delivered() and air.now < begin + 2.0:
            air.step()
        ages.append(air.now - begin)
        air.run(begin + 2.0 + number % 3 - air.now)
    came = [age for age in ages if age < 2.0]
    assert len(came) > 0.95 * len(ages), "48 without repair"
    assert max(came) <= 2 * limit_s


@pytest.mark.parametrize("together", [True, False])
def test_what_its_origin_may_repair_for_longer_counts_from_the_packet_before(together: bool) -> None:
    """It is missed 8 s after the packet before it, and also has a message that is never too old, or not."""
    sender, receiver = Robot(1, rows(scan=SCAN, text=SendOptions())), Robot(2)
    air = Air(sender, receiver)
    air.run(3.0)
    now, number = air.now + 2 * WITHIN_S, sender.end.window.packets.newest + 1
    sender.slot(now)
    sender.end.messages.submit(1, b"scan", now)
    if together:
        sender.end.messages.submit(2, b"text", now)
    lost = [sender.slot(now)]
    assert sender.end.window.packets.newest == number
    sender.end.messages.submit(2, b"next", now)
    for data in [sender.slot(now), *lost]:
        assert data is not None
        receiver.receive(data, now)
    assert (b"scan" in receiver.delivered()) != together


@pytest.mark.parametrize("mode", MODES)
def test_a_packet_that_another_radio_overtakes_is_no_older_than_the_last_hello(mode: SealMode) -> None:
    """It also has what is never too old, so that it may be a repeat of one that left right after the one before."""
    sender, receiver = Robot(1, rows(scan=SCAN, text=SendOptions()), mode=mode), Robot(2, mode=mode)
    air = Air(sender, receiver)
    air.run(20 * WITHIN_S)  # hellos say that nothing has left meanwhile
    now, number = air.now, sender.end.window.packets.newest
    sender.end.messages.submit(1, b"scan", now)
    sender.end.messages.submit(2, b"text", now)
    one = sender.slot(now)
    sender.end.messages.submit(2, b"more", now)
    other = sender.slot(now)
    assert sender.end.window.packets.newest == number + 2
    for data in (other, one):
        assert data is not None
        receiver.receive(data, now)
    assert b"scan" in receiver.delivered()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("after_s", LATE_S)
def test_what_repair_brings_counts_from_the_packet_before_it(mode: SealMode, after_s: float) -> None:
    sender, receiver = Robot(1, rows(scan=SCAN, text=SendOptions()), mode=mode), Robot(2, mode=mode)
    air = Air(sender, receiver)
    air.run(3.0)
    held = []
    for topic_id, text in ((2, b"text"), (1, b"scan"), (2, b"text")):
        sender.end.messages.submit(topic_id, text * 8, air.now)
        held.append(sender.slot(air.now))
        air.now += SLOT_S
    assert None not in held
    for data in held[::2]:
        receiver.receive(data or b"", air.now)
    receiver.receive(held[1] or b"", air.now + after_s)
    assert (b"scan" * 8 in receiver.delivered()) == (after_s < WITHIN_S)


@pairs(away_s=LATE_S, mode=MODES, latched=[False, True])
def test_a_relay_hands_nothing_on_that_is_over(mode: SealMode, away_s: float, latched: bool) -> None:
    """Robot 3 is away when robot 1 says it, and comes when robot 1 is off; kept for a late robot or not."""
    scan = SendOptions(queue="deadline", deadline_s=WITHIN_S, durability="transient_local" if latched else "auto")
    line = Line(robot(1, mode, rows(scan=scan)), *(robot(src_id, mode) for src_id in (2, 3)))
    line.run(12)
    absent(line, 3)
    line.run(12)
    line.robots[0].end.messages.submit(1, b"scan", line.now)
    while b"scan" not in line.robots[1].delivered(1):
        line.run(0.1)
    absent(line, 1, 3)
    line.now += away_s
    line._messages = int(line.now / 0.3)
    absent(line, 1)
    line.run(20)
    assert line.robots[2].delivered(2)
    assert (b"scan" in line.robots[2].delivered(1)) == (away_s < WITHIN_S)


@pytest.mark.parametrize("stands_s", [1.0, 3.5])
def test_what_is_sent_again_to_a_late_robot_counts_from_when_it_was_published(stands_s: float) -> None:
    """It is asked for in time; the link stands still then."""
    kept = SendOptions(durability="transient_local", queue="deadline", deadline_s=WITHIN_S)
    sender = Robot(1, rows(map=kept))
    air = Air(sender, Robot(2))
    air.run(3.0)
    sender.end.messages.submit(1, b"map", air.now)
    air.run(1.0)
    sender.end.messages.kept.asked(1, air.now)
    late = Robot(3)
    air.robots = [sender, late]
    air.now += stands_s
    air.run(5.0)
    assert late.end.neighbours.all[1].inbox.announced.topics[1].latched
    assert (b"map" in late.delivered()) == (stands_s + 1.0 < WITHIN_S)


def test_the_row_follows_options_and_publishers() -> None:
    messages = Robot(1, rows(scan=SCAN, free=SendOptions())).end.messages

    def told() -> list[float]:
        return [row.deadline_s for row in messages.sent.table()]

    assert told() == [0.0, WITHIN_S, 0.0]
    messages.follow(2, PublisherQos(lifespan_s=0.123))
    messages.change(1, SendOptions(deadline_s=1.0))
    assert told() == [0.0, 1.0, 0.13], "rounded up"
    messages.follow(2, PublisherQos(lifespan_s=age_of(254) + 1))
    assert told()[2] == 0.0, "longer than a row can say"
