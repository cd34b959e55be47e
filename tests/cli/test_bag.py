"""`gr-ros2 link --bag`: what comes out in the order in which it was made, and disks that are full."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli.bag import OutputBag
from gr_ros2.core.errors import BagError
from gr_ros2.core.guard import Guard
from gr_ros2.link.events import Announced, Delivered
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import CALLS_TYPE, Topic
from tests.e2e.test_observers import disk
from tests.middleware.support import CUSTOM, message
from tests.waiting import wait_for

TOPICS = [(2, "/rx_robot_2/chat", Topic(0, "chat", CUSTOM, SendOptions())), (2, "/x", Topic(1, "_calls", CALLS_TYPE))]


class OneEnd:
    """A run as the bag sees it."""

    clock = staticmethod(time.monotonic)

    def __init__(self) -> None:
        self.announced: Any = lambda: TOPICS


def opened(path: Path) -> OutputBag:
    bag = OutputBag(path)
    bag.run_started(OneEnd())  # type: ignore[arg-type]
    return bag


def test_messages_lie_in_the_order_in_which_they_were_made(tmp_path: Path) -> None:
    now = time.monotonic()
    with opened(tmp_path / "new" / "bag") as bag:
        bag.receiver_event(Delivered(2, 0, message(2, 50), 0, age_s=1.0), now)
        bag.receiver_event(Delivered(2, 0, message(1, 50), 0, age_s=1.0, latency_s=60.0), now + 0.1)
        bag.receiver_event(Delivered(2, 0, b"frame", 0, shown=message(3, 50)), now + 0.2)
        bag.receiver_event(Delivered(2, 1, b"a call", 0), now)
        bag.receiver_event(Delivered(9, 0, b"nobody knows", 0), now)
    found = list(read_bag(tmp_path / "new" / "bag"))
    assert [each.payload for each in found] == [message(number, 50) for number in (1, 2, 3)]
    assert {each.topic for each in found} == {"/rx_robot_2/chat"}
    assert found[1].stamp_ns - found[0].stamp_ns == pytest.approx(58.9e9, abs=1e8)
    assert bag.incomplete() == []


def test_a_topic_that_has_another_type_is_left_out_and_said(tmp_path: Path) -> None:
    with opened(tmp_path / "bag") as bag:
        bag.receiver_event(Delivered(2, 0, message(1, 50), 0), 0.0)
        bag._run.announced = lambda: [(2, "/rx_robot_2/chat", Topic(0, "chat", "std_msgs/msg/String"))]  # type: ignore
        bag.receiver_event(Announced(2, ()), 0.0)
        bag._channels.clear()
        bag.receiver_event(Delivered(2, 0, message(1, 50), 0), 0.0)
    assert bag.incomplete() == [f"bag {tmp_path / 'bag'}: /rx_robot_2/chat lacks 1 messages"]


def test_a_folder_that_exists_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="exists already"):
        OutputBag(tmp_path)


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a disk: run as root")
def test_a_full_disk_ends_the_bag_alone_and_is_said(tmp_path: Path) -> None:
    with disk(tmp_path / "small", "size=2m") as folder, opened(folder / "bag") as bag:
        guard = Guard(bag.name)

        def full() -> bool:
            guard(bag.receiver_event, Delivered(2, 0, message(1, 300_000), 0), 0.0)
            return guard.error is not None

        wait_for(full, "the disk to be full")
        bag.close()
        assert any("No space left on device" in line for line in bag.incomplete())
