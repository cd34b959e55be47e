"""What is kept for later: gaps, what was heard, bounds, and bytes from strangers."""

from __future__ import annotations

import random

import pytest

from gr_ros2.calls.backfill import (
    NO_PLACE,
    PIECE,
    REPAIRED,
    Account,
    Later,
    MessagesForLater,
    read_later,
    write_later,
)
from gr_ros2.core.errors import WireError

HEARS_S = 0.1


def later(serial: int, size: int = 100, at: tuple[int, int] = (0, NO_PLACE)) -> Later:
    return Later(3, serial, 0, bytes(size), at)


def accept(kept: MessagesForLater, serial: int, now: float, size: int = 100) -> None:
    kept.accepted(3, serial, bytes(size), now)


def take(kept: MessagesForLater) -> list[Later]:
    return [each._replace(made_us=0) for each in kept.take(0.0)]


class Heard(set[int]):
    """The packets that others have."""

    newest = -1

    def have(self, first: int, last: int) -> bool:
        return self.issuperset(range(first, last + 1))

    def report(self, number: int, *missing: int) -> Heard:
        """A report covers all packets up to one."""
        self |= set(range(self.newest + 1, number + 1)) - set(missing)
        self.newest = number
        return self


class Sent:
    """Messages of one packet each; a report of the newest packet follows while somebody hears."""

    def __init__(self, for_s: float = 600.0, most_bytes: int = 1_000_000) -> None:
        self.kept = MessagesForLater(for_s, most_bytes)
        self.now, self.number, self.serial = 0.0, -1, -1
        self.receipts = Heard()

    def send(self, *, hears: bool, size: int = 100) -> Later:
        self.serial, self.number = self.serial + 1, self.number + 1
        accept(self.kept, self.serial, self.now, size)
        self.kept.left(self.serial, (self.number, 0), self.number, self.now, last=True)
        self.now += HEARS_S
        self.look(hears=hears)
        return later(self.serial, size, (self.number, 0))

    def look(self, *, hears: bool) -> None:
        if hears:
            self.receipts.newest = self.number - 1
            self.receipts.report(self.number)
        self.kept.heard(self.receipts, self.now)

    def fill(self, *, hears: bool) -> list[Later]:
        found = take(self.kept)
        self.serial, self.number = self.serial + 1, self.number + 1
        self.kept.taken(self.serial)
        self.kept.left(self.serial, (self.number, 0), self.number, self.now, last=True)
        self.now += HEARS_S if hears else 2 * self.kept.patience_s
        self.look(hears=hears)
        return found


def test_what_is_heard_is_not_kept() -> None:
    sent = Sent(most_bytes=1000)
    for _ in range(100):
        sent.send(hears=True)
    assert (len(sent.kept), sent.kept.lost, sent.kept.unheard) == (0, 0, False)


def test_what_left_in_an_outage_is_filled_once_and_oldest_first() -> None:
    sent = Sent()
    sent.send(hears=True)
    away = [sent.send(hears=False) for _ in range(50)]
    assert sent.kept.unheard
    sent.send(hears=True)
    assert not sent.kept.unheard
    found = []
    while len(sent.kept):
        found += sent.fill(hears=True)
    assert found[: len(away)] == away
    assert len(found) <= len(away) + 1, "the message with which it is heard again may be among them"


def test_what_fills_gaps_while_nobody_hears_is_kept_on_in_its_order() -> None:
    sent = Sent()
    away = [sent.send(hears=False) for _ in range(200)]
    sent.now += 2 * sent.kept.patience_s
    sent.look(hears=False)
    first = sent.fill(hears=False)
    assert 0 < len(first) < len(away)
    assert len(sent.kept) == len(away)
    assert sent.fill(hears=True) == first


def test_what_was_superseded_is_filled_and_what_is_too_large_is_given_up() -> None:
    kept = MessagesForLater(600.0, 1_000_000)
    accept(kept, 1, 0.0)
    accept(kept, 2, 0.1)
    accept(kept, 3, 0.1)
    kept.refused(1)
    kept.refused(3, ever=False)
    assert take(kept) == [later(1)]
    assert (kept.lost, kept.accounts()) == (1, {3: Account(3, 0, 0)})
    kept.left(9, (0, 0), 0, 0.2, last=True)
    assert kept.accounts() == {3: Account(3, 1, 2)}, "those that were dropped, and not the one that waits"


def test_a_message_of_which_a_part_has_left_says_where_it_began() -> None:
    kept = MessagesForLater(600.0, 1_000_000)
    accept(kept, 1, 0.0)
    kept.left(1, (7, 2), 7, 0.1, last=False)
    kept.heard(Heard().report(7), 0.15)
    kept.left(1, (7, 2), 8, 0.2, last=False)
    kept.refused(1)
    assert take(kept) == [later(1, at=(7, 2))]


@pytest.mark.parametrize("away", [False, True])
def test_of_more_than_fits_the_oldest_are_given_up_and_counted(away: bool) -> None:
    sent, count = Sent(most_bytes=30_000), 1000
    for _ in range(count):
        sent.send(hears=False)
        if not away:
            sent.kept.refused(sent.serial)
    sent.now += 2 * sent.kept.patience_s
    sent.look(hears=False)
    left = len(sent.kept)
    assert 50 < left < 300
    assert sent.kept.lost == count - left
    assert take(sent.kept)[0].serial == count - left


def test_what_waits_longer_than_there_is_memory_and_is_heard_was_not_lost() -> None:
    kept, receipts = MessagesForLater(600.0, 2000), Heard()
    for serial in range(100):
        accept(kept, serial, 0.0)
    kept.refused(50)
    for serial in range(50):
        kept.left(serial, (serial, 0), serial, 1.0, last=True)
    kept.heard(receipts.report(49 + REPAIRED, 7), 1.0)
    assert kept.lost == 2, "one that was refused, and one that was lost"
    assert len(kept._waiting) == 49
    assert take(kept) == []


def test_a_try_of_which_nothing_is_kept_any_more_hinders_no_other() -> None:
    sent = Sent(most_bytes=2000)
    for _ in range(3):
        sent.send(hears=False)
        sent.kept.refused(sent.serial)
    assert sent.kept.take(0.0, most=0)
    sent.kept.taken(1000)
    sent.kept.left(1000, (3, 0), 3, sent.now, last=True)
    assert sent.kept.tries
    for _ in range(100):
        sent.send(hears=False)
    assert not sent.kept.tries


def test_a_message_larger_than_what_may_be_kept_is_given_up_alone() -> None:
    sent = Sent(most_bytes=2000)
    accept(sent.kept, 0, 0.0, 5000)
    accept(sent.kept, 1, 0.0)
    sent.kept.refused(0)
    sent.kept.refused(1)
    assert take(sent.kept) == [later(1)]
    assert sent.kept.lost == 1


def test_what_is_too_old_is_given_up() -> None:
    kept = MessagesForLater(for_s=10.0, most_bytes=1_000_000)
    for serial in range(5):
        accept(kept, serial, float(serial))
        kept.refused(serial)
    kept.heard(Heard(), 12.5)
    assert [each.serial for each in take(kept)] == [3, 4]
    assert kept.lost == 3


def test_slow_reports_are_no_outage() -> None:
    sent = Sent()
    for period_s in [0.2, 0.5, 1.0, 2.0, 4.0, *[6.0] * 40]:
        sent.send(hears=False)
        sent.now += period_s
        sent.look(hears=True)
    before = len(sent.kept)
    for _ in range(20):
        sent.send(hears=False)
        sent.now += 6.0
        sent.look(hears=True)
    assert len(sent.kept) == before


def test_a_single_message_that_is_lost_and_not_repaired_is_filled() -> None:
    kept, receipts = MessagesForLater(600.0, 1_000_000), Heard()
    for number in range(2 * REPAIRED):
        accept(kept, number, number * HEARS_S)
        kept.left(number, (number, 0), number, number * HEARS_S, last=True)
        kept.heard(receipts.report(number, 5, 6), (number + 1) * HEARS_S)
        if number == REPAIRED:
            assert len(kept) == 2
            assert take(kept) == []
            receipts.add(6)  # repaired
    assert take(kept) == [later(5, at=(5, 0))]


def test_of_a_message_of_several_packets_every_one_counts() -> None:
    kept, receipts = MessagesForLater(600.0, 1_000_000), Heard()
    accept(kept, 0, 0.0)
    for number in range(3):
        kept.left(0, (0, 0), number, 0.0, last=number == 2)
    kept.heard(receipts.report(2 + REPAIRED, 1), 1.0)
    assert take(kept) == [later(0, at=(0, 0))]


def test_a_robot_that_comes_back_after_long_tells_nothing_of_what_left_before() -> None:
    kept, receipts = MessagesForLater(600.0, 1_000_000), Heard()
    count = 20
    for number in range(count):
        accept(kept, number, number)
        kept.left(number, (number, 0), number, number, last=True)
        kept.heard(receipts, number)
    kept.heard(receipts.report(count - 1), count)
    assert [each.serial for each in take(kept)] == list(range(count))


def test_memory_is_counted_down_to_nothing() -> None:
    rng, sent = random.Random(1), Sent(for_s=30.0, most_bytes=20_000)
    for _ in range(2000):
        hears = rng.random() < 0.5
        if rng.random() < 0.3 and len(sent.kept):
            sent.fill(hears=hears)
        else:
            sent.send(hears=hears, size=rng.randrange(300))
            if rng.random() < 0.1:
                sent.kept.refused(sent.serial)
        assert sent.kept._bytes <= 20_000
    while len(sent.kept) or sent.kept.tries:
        sent.fill(hears=True)
    assert (sent.kept._bytes, sent.kept._filling) == (0, {})
    assert sent.kept.filled > 100


def test_what_is_written_is_read() -> None:
    messages = [later(1, 0), Account(2, 1 << 50, 1 << 40), later((1 << 32) - 1, 3000, (1 << 50, 255))]
    assert read_later(write_later(messages)) == messages
    assert read_later(b"") == []


def test_bytes_of_strangers_raise_a_wire_error_or_mean_something() -> None:
    rng = random.Random(2)
    whole = write_later([later(1, 20), Account(2, 9, 3), later(9, 5, (4, 1))])
    for _ in range(3000):
        data = bytearray(whole[: rng.randrange(len(whole) + 1)])
        for _ in range(rng.randrange(4)):
            if data:
                data[rng.randrange(len(data))] = rng.randrange(256)
        try:
            found = read_later(bytes(data))
        except WireError:
            continue
        assert sum(len(each.payload) for each in found if isinstance(each, Later)) <= len(data)


def test_a_piece_is_no_longer_than_it_says() -> None:
    kept = MessagesForLater(600.0, 10_000_000)
    for serial in range(100):
        accept(kept, serial, 0.0, 700)
        kept.refused(serial)
    while found := take(kept):
        assert len(write_later(found)) <= PIECE


@pytest.mark.parametrize("overtakes", [True, False])
def test_what_is_missing_once_a_later_one_has_come_is_filled_if_that_overtook_it(*, overtakes: bool) -> None:
    kept, receipts = MessagesForLater(600.0, 1_000_000, lambda _: overtakes), Heard()
    for serial in range(4):
        kept.accepted(serial // 3, serial, bytes(9), 0.0)
        kept.left(serial, (serial, 0), serial, 0.0, last=True)
    kept.heard(receipts.report(3, 1), 0.1)  # serial 3 is of another topic
    assert [each.serial for each in take(kept)] == ([1] if overtakes else [])
