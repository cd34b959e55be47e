"""Which packets somebody has, by reports that come late, out of order, and of more than one robot."""

from __future__ import annotations

from gr_ros2.link.v1.receipts import Receipts
from gr_ros2.wire.control import MAP
from gr_ros2.wire.v1 import SPAN

ALL = (1 << MAP) - 1


def report(
    receipts: Receipts, number: int, *missing: int, robot: int = 2, repaired: bool = True, told: int = -1
) -> None:
    receipts.report(robot, number, ALL & ~sum(1 << number - one for one in missing), lambda _: repaired, told)


def test_a_packet_has_come_if_the_first_report_says_so_or_one_while_it_is_repaired() -> None:
    receipts = Receipts()
    assert not receipts.have(0, 0)
    report(receipts, 100, 90, 91)
    assert receipts.newest == 100
    assert receipts.have(92, 100)
    assert not receipts.have(90, 90)
    assert not receipts.have(100, 101)
    report(receipts, 110, 91, repaired=False)
    assert not receipts.have(90, 91), "nobody waits for it any more"
    assert receipts.have(92, 110)
    report(receipts, 95)
    assert receipts.have(37, 110), "an older report"


def test_who_was_told_not_to_wait_says_nothing_of_what_was_not_repaired_any_more() -> None:
    receipts = Receipts()
    report(receipts, 100, told=98, repaired=False)
    assert receipts.have(99, 100)
    assert not receipts.have(98, 98)
    report(receipts, 101, told=98)
    assert receipts.have(98, 101), "it was repaired all the time"


def test_packets_that_no_report_covers_have_not_come() -> None:
    receipts = Receipts()
    report(receipts, 100)
    report(receipts, 100 + 2 * MAP)
    assert receipts.have(100 + MAP + 1, 100 + 2 * MAP)
    assert not receipts.have(100, 101)
    report(receipts, 100 + 2 * SPAN)
    assert not receipts.have(100, 100)


def test_what_another_robot_lacks_has_come_if_one_has_it() -> None:
    receipts = Receipts()
    report(receipts, 100)
    report(receipts, 100, 95, 96)
    assert receipts.have(95, 96)


def test_robots_that_do_not_count_tell_nothing() -> None:
    receipts = Receipts((3, 4))
    report(receipts, 100)
    assert receipts.newest == -1
    report(receipts, 50, 40, robot=3)
    report(receipts, 50, 41, robot=4)
    report(receipts, 100)
    assert receipts.newest == 50
    assert receipts.have(41, 50)
