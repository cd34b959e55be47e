"""`gr-ros2 link --bag`: what comes out in the order in which it was made, and disks that are full."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from gr_ros2.calls.backfill import NO_PLACE, Account, Later, write_later
from gr_ros2.core.errors import BagError
from gr_ros2.core.guard import Guard
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.events import Announced, Delivered, Lost
from gr_ros2.link.key import Key
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.observe.bag import OutputBag
from gr_ros2.radio.lost_messages import LOST_TYPE, _types
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import BACKFILL_TYPE, CALLS_TYPE, Topic
from tests.e2e.test_observers import disk
from tests.middleware.support import CUSTOM, message
from tests.waiting import wait_for

TOPICS = [
    (2, "/rx_robot_2/chat", Topic(0, "chat", CUSTOM, SendOptions())),
    (2, "/x", Topic(1, "_calls", CALLS_TYPE)),
    (2, "/y", Topic(2, "_backfill", BACKFILL_TYPE)),
]


class OneEnd:
    """A run as the bag sees it."""

    clock = staticmethod(time.monotonic)

    def __init__(self) -> None:
        self.announced: Any = lambda: TOPICS
        self.sources = {1: None}
        self.clocks: Any = dict


def opened(path: Path) -> OutputBag:
    bag = OutputBag(path)
    bag.run_started(OneEnd())  # type: ignore[arg-type]
    return bag


def test_messages_lie_in_the_order_in_which_they_were_made(tmp_path: Path) -> None:
    now = time.monotonic()
    with opened(tmp_path / "new" / "bag") as bag:
        bag.receiver_event(Delivered(2, 0, message(2, 50), 0, age_s=1.0), now)
        bag.receiver_event(Delivered(2, 0, message(1, 50), 0, age_s=1.0, latency_s=60.0), now + 0.1)
        bag.receiver_event(Delivered(2, 0, b"frame", 0, repaired=True, age_s=9e3, shown=message(3, 50)), now + 0.2)
        bag.receiver_event(Delivered(2, 1, b"a call", 0), now)
        bag.receiver_event(Delivered(9, 0, b"nobody knows", 0), now)
        bag.receiver_event(Delivered(2, 0, b"frame", 0, shown=message(3, 50), again=True), now + 0.3)
    found = list(read_bag(tmp_path / "new" / "bag"))
    assert [each.payload for each in found] == [message(number, 50) for number in (1, 2, 3)]
    assert {each.topic for each in found} == {"/rx_robot_2/chat"}
    assert found[1].stamp_ns - found[0].stamp_ns == pytest.approx(58.9e9, abs=1e8)
    assert bag.incomplete() == []


@pytest.mark.parametrize("latency_s", [1.7e9, 7 * 86400.0, -60.0])
def test_a_stamp_that_is_not_of_the_clock_does_not_move_a_message(tmp_path: Path, latency_s: float) -> None:
    now, wall = time.monotonic(), time.time()
    with opened(tmp_path / "bag") as bag:
        bag.receiver_event(Delivered(2, 0, message(1, 50), 0, age_s=2.0, latency_s=latency_s), now)
    (found,) = read_bag(tmp_path / "bag")
    assert found.stamp_ns / 1e9 == pytest.approx(wall - 2.0, abs=0.1)


def fills(*messages: Later | Account, boot: int = 7) -> Delivered:
    return Delivered(2, 2, write_later(messages), 0, Key(boot, 100, 0))


def lost_of(path: Path) -> dict[str, int]:
    """Messages that are missing, as the bag says."""
    told = [each.payload for each in read_bag(path) if each.topic.endswith("/events/messages_lost")]
    stats = [each for said in told for each in _types().deserialize_cdr(said, LOST_TYPE).messages_lost_statistics]
    return {each.topic_name: each.messages_lost_in_transport for each in stats}


def test_what_fills_a_gap_stands_where_it_was_made_and_once(tmp_path: Path) -> None:
    now, wall = time.monotonic(), time.time()
    made = [round((wall - ago) * 1e6) for ago in (30, 20, 10)]
    with opened(tmp_path / "bag") as bag:
        bag._run.clocks = lambda: {2: ClockOffset(5.0, 0.001, 0, 0.0, 1, 5.0, 0.001, 0.0)}  # type: ignore[union-attr]
        bag.receiver_event(Delivered(2, 0, message(3, 50), 0, Key(7, 40, 1), age_s=1.0), now)
        oldest, old = (
            Later(0, 0, made[0], message(1, 50), (29, NO_PLACE)),
            Later(0, 1, made[1], message(2, 50), (30, 0)),
        )
        came = Later(0, 2, made[2], message(3, 50), (40, 1))
        bag.receiver_event(fills(old, came), now)
        bag.receiver_event(fills(oldest, old), now + 1)
        bag.receiver_event(fills(oldest), now + 1)
        bag.receiver_event(Delivered(2, 0, message(2, 50), 0, Key(7, 30, 0)), now + 1)  # repaired after all
        bag.receiver_event(fills(oldest, boot=8), now + 2)  # of another start
        bag.receiver_event(Delivered(2, 0, message(3, 50), 0, Key(8, 40, 1), age_s=0.1), now)  # says the same
    found = list(read_bag(tmp_path / "bag"))
    assert [each.payload for each in found] == [message(number, 50) for number in (1, 1, 2, 3, 3)]
    assert found[2].stamp_ns / 1e9 == pytest.approx(wall - 25, abs=0.1)
    assert lost_of(tmp_path / "bag") == {}


def test_the_bag_says_what_is_missing_at_the_end(tmp_path: Path) -> None:
    with opened(tmp_path / "bag") as bag:
        for place in range(3):
            bag.receiver_event(Lost(2, 0, "given_up", Key(7, 30, place)), 0.0)
        bag.receiver_event(Lost(2, 0, "expired"), 0.0)
        bag.receiver_event(Lost(2, 1, "expired", Key(7, 31, 0)), 0.0)
        bag.receiver_event(fills(Later(0, 5, 0, message(1, 50), (30, 1))), 0.0)
    assert lost_of(tmp_path / "bag") == {"/rx_robot_2/chat": 2 + 1}
    assert custom_data(tmp_path / "bag").endswith("of no topic; of others, those that came in part or too late")


def custom_data(path: Path) -> str:
    """What a bag says of how it counts lost messages."""
    found = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]["custom_data"]
    return str(found["messages_lost"])


def test_of_a_topic_whose_gaps_are_filled_every_message_is_counted_whatever_came_of_it(tmp_path: Path) -> None:
    with opened(tmp_path / "bag") as bag:

        def came(number: int, boot: int = 7) -> None:
            bag.receiver_event(Delivered(2, 0, message(1, 50), 0, Key(boot, number, 0)), 0.0)

        for number in range(90, 110):
            came(number)
        bag.receiver_event(fills(Account(0, 100, 500)), 0.0)  # 10 of what came are of later packets
        for number in range(120, 130):
            came(number)
        bag.receiver_event(Lost(2, 0, "given_up", Key(7, 110, 0)), 0.0)
        bag.receiver_event(Lost(2, 0, "given_up", Key(7, 141, 0)), 0.0)  # behind the last account
        unbegun = Later(0, 5, 0, message(1, 50), (111, NO_PLACE))
        bag.receiver_event(fills(unbegun, Later(0, 6, 0, message(1, 50), (30, 0)), Account(0, 125, 525)), 0.0)
        bag.receiver_event(fills(Account(0, 110, 510), unbegun), 0.0)  # came late, and again
        bag.receiver_event(fills(Later(0, 7, 0, message(1, 50), (112, 3)), Account(0, 140, 540)), 0.0)
        bag.receiver_event(fills(Account(0, 0, 0), Account(0, 50, 50), boot=8), 0.0)  # its next start, of which 2 came
        came(3, boot=8)
        came(4, boot=8)
    assert lost_of(tmp_path / "bag") == {"/rx_robot_2/chat": 40 - (10 + 10 + 2) + 1 + 48}
    assert custom_data(tmp_path / "bag").startswith("all that were made, of /rx_robot_2/chat; ")


def test_a_message_that_came_another_way_is_not_missing(tmp_path: Path) -> None:
    with opened(tmp_path / "bag") as bag:
        for key in (Key(7, 1, 0), Key(7, 2, 0)):
            bag.receiver_event(Lost(2, 0, "expired", key), 0.0)
            bag.receiver_event(Delivered(2, 0, message(1, 50), 0, key), 0.0)
        bag.receiver_event(Lost(2, 0, "expired", Key(7, 2, 0)), 0.0)
    assert lost_of(tmp_path / "bag") == {}


def test_what_filled_a_gap_before_the_receiver_gave_it_up_is_not_missing(tmp_path: Path) -> None:
    with opened(tmp_path / "bag") as bag:
        bag.receiver_event(fills(Later(0, 5, 0, message(1, 50), (30, 1))), 0.0)
        bag.receiver_event(Lost(2, 0, "given_up", Key(7, 30, 1)), 0.0)
    assert lost_of(tmp_path / "bag") == {}


def test_a_message_of_which_the_first_part_was_missed_is_not_missing_once_it_has_filled_the_gap(tmp_path: Path) -> None:
    with opened(tmp_path / "bag") as bag:
        bag.receiver_event(Lost(2, 0, "overtaken", Key(7, 30, -1)), 0.0)
        bag.receiver_event(Lost(2, 0, "overtaken", Key(7, 31, -1)), 0.0)
        bag.receiver_event(fills(Later(0, 5, 0, message(1, 50), (30, 1))), 0.0)
    assert lost_of(tmp_path / "bag") == {"/rx_robot_2/chat": 1}


def test_what_cannot_be_read_is_counted(tmp_path: Path) -> None:
    with opened(tmp_path / "bag") as bag:
        bag.receiver_event(Delivered(2, 2, b"\xffjunk", 0), 0.0)
        bag.receiver_event(Delivered(2, 2, write_later([Later(0, 1, 2, bytes(9), (1, 0))])[:-1], 0), 0.0)
        bag.receiver_event(fills(Later(77, 1, 2, bytes(9), (1, 0)), Account(77, 1, 1)), 0.0)
        bag.receiver_event(fills(Later(0, 1, (1 << 64) - 1, message(1, 50), (1, 0))), 0.0)
        bag.receiver_event(Delivered(2, 0, message(2, 50), 0, age_s=3e9), 0.0)  # made before 1970
    assert [each.payload for each in read_bag(tmp_path / "bag")] == [message(2, 50)]
    assert bag.incomplete() == [f"bag {tmp_path / 'bag'}: robot 2 lacks 3 messages"]


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
