"""Deliveries find their messages: by key, by bytes, and through repeats."""

from __future__ import annotations

from collections.abc import Hashable

import pytest

from gr_ros2.link.events import Accepted, Delivered, SentEntry
from gr_ros2.link.tracker import REPEATS, Tracked, Tracker


def accepted(serial: int, payload: bytes, expected: bytes | None = None) -> Tracked:
    return Tracked.of(Accepted(serial, 0, payload, float(serial), expected))


def delivered(payload: bytes, key: Hashable) -> Delivered:
    return Delivered(1, 0, payload, 0, key)


def tracker(*messages: Tracked) -> Tracker[Tracked]:
    made: Tracker[Tracked] = Tracker()
    for message in messages:
        made.add(message)
    return made


def test_keys_that_come_round_mean_the_message_with_those_bytes() -> None:
    old, new = accepted(0, b"old"), accepted(1, b"new")
    messages = tracker(old, new)
    for message in (old, new):
        assert messages.left(SentEntry(message.serial, 0, "key", 0, 2)) is message
    assert messages.under(0, "key") == [old, new]
    assert messages.find(delivered(b"new", "key")) is new
    assert messages.find(delivered(b"old", "key")) is old
    assert messages.find(delivered(b"neither", "key")) is None
    assert not new.all_sent
    messages.left(SentEntry(1, 0, "key", 1, 2))
    assert new.all_sent


def test_a_message_cut_as_it_goes_is_sent_when_its_last_fragment_says_so() -> None:
    message = accepted(0, b"long")
    messages = tracker(message)
    for index, total in ((0, 0), (1, 0), (2, 3)):
        assert not message.all_sent
        messages.left(SentEntry(0, 0, 5, index, total))
    assert message.all_sent


def test_what_another_key_carries_is_found_by_its_bytes_once_it_has_left() -> None:
    message = accepted(0, b"x", expected=b"rounded")
    messages = tracker(message)
    assert messages.find(delivered(b"rounded", 9)) is None, "it has not left"
    messages.left(SentEntry(0, 0, 1, 0, 1))
    assert messages.find(delivered(b"rounded", 9)) is message
    assert messages.find(delivered(b"x", 1)) is None, "not what is to come out"


def test_a_repeat_is_of_the_message_it_repeats() -> None:
    message = accepted(0, b"map")
    messages = tracker(message)
    messages.left(SentEntry(0, 0, 1, 0, 1))
    assert messages.left(SentEntry(0, 0, 2, 0, 1, repeat=True)) is None
    event = delivered(b"map", 2)
    assert messages.repeats(event)
    assert messages.find(event) is messages.repeated(event) is message
    assert messages.find(delivered(b"mop", 2)) is None
    messages.close(message)
    assert messages.repeats(event)
    assert messages.find(event) is messages.repeated(event) is None
    assert not messages.repeats(delivered(b"map", 1))


@pytest.mark.parametrize("most", [1, 7])
def test_memory_is_bounded(most: int) -> None:
    messages: Tracker[Tracked] = Tracker(most)
    for serial in range(20):
        messages.add(accepted(serial, b"%d" % (serial % 3)))
        messages.left(SentEntry(serial, 0, serial % 5, 0, 1))
    assert [message.serial for message in messages.open] == list(range(20 - most, 20))
    assert len(messages) == most
    for message in list(messages.open):
        messages.close(message)
    assert not any((messages._open, messages._by_key, messages._by_digest))
    for number in range(2 * REPEATS):
        messages.left(SentEntry(0, 0, number, 0, 1, repeat=True))
    assert len(messages._repeats) == REPEATS
