"""A bounded queue and its thread."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from gr_ros2.core.backlog import Backlog
from tests.waiting import PATIENCE_S


@pytest.fixture
def backlog() -> Iterator[Backlog]:
    made = Backlog("test-backlog", 100)
    yield made
    assert made.close()


def test_work_is_done_in_its_order(backlog: Backlog) -> None:
    done: list[int] = []
    for number in range(50):
        assert backlog.offer(1, done.append, number)
    assert backlog.settle(PATIENCE_S)
    assert backlog.offer(1, done.append, 50)  # it was idle in the meantime
    assert backlog.close()
    assert done == list(range(51))
    assert not backlog.offer(1, done.append, 51)
    assert not backlog.put(1, done.append, 51)
    assert backlog.close()


def test_what_does_not_fit_is_refused_at_once(backlog: Backlog) -> None:
    gate, done = threading.Event(), list[int]()
    assert backlog.offer(60, gate.wait)
    assert backlog.offer(40, done.append, 1)
    assert not backlog.offer(1, done.append, 2)
    assert backlog.offer(0, done.append, 3)
    assert not backlog.settle(0.05)
    assert backlog.pending == 3
    assert not backlog.close(0.05)
    gate.set()
    assert backlog.close()
    assert done == [1, 3]
    assert backlog.pending == 0


def test_one_piece_may_be_larger_than_the_bound(backlog: Backlog) -> None:
    done: list[int] = []
    assert backlog.offer(1000, done.append, 1)
    assert backlog.settle(PATIENCE_S)
    assert done == [1]


def test_put_waits_for_room(backlog: Backlog) -> None:
    gate, done = threading.Event(), list[int]()
    backlog.put(100, gate.wait)
    giver = threading.Thread(target=backlog.put, args=(100, done.append, 1))
    giver.start()
    giver.join(0.05)
    assert giver.is_alive()
    gate.set()
    giver.join(PATIENCE_S)
    assert backlog.settle(PATIENCE_S)
    assert done == [1]
