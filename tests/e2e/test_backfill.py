"""Gaps of an outage that are filled later, into the bag of another robot's link."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.observe.positions import humble_types
from gr_ros2.state.keys import new_key_file
from tests.e2e.links import LinkProcess, Links
from tests.e2e.test_clocks import clock
from tests.e2e.test_observers import disk, needs_root
from tests.observe.test_bag import lost_of
from tests.waiting import wait_for

POINT = "geometry_msgs/msg/PointStamped"
PEER = (sys.executable, "-m", "tests.e2e.clock_peer")
PLACES = "/rx_robot_2/place"
PLACE: dict[str, Any] = {"topics": {"place": {}}}


def got(link: LinkProcess) -> int:
    """Places that have come out there."""
    return sum(line.startswith("got") for line in link.said)


def filled(link: LinkProcess) -> bool:
    found = link.status()["backfill"]
    return found["filled"] > 0 and not found["kept"]


def made(bag: Path) -> list[float]:
    """When the places in a bag were made, by their order there, s; each is there once."""
    store = humble_types()
    found = [store.deserialize_cdr(each.payload, POINT).point.x for each in read_bag(bag) if each.topic == PLACES]
    assert len(found) == len(set(found)), "each once"
    return found


def is_whole(times: list[float]) -> bool:
    """Whether nothing is missing; a computer with much to do publishes less often for a while."""
    gaps = sorted(later - earlier for earlier, later in pairwise(times))
    return gaps[-1] < 20 * gaps[len(gaps) // 2]


def test_what_nobody_heard_in_an_outage_is_in_the_bag_afterwards(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    recording = {**PLACE, "clock": {"every_s": 0.5}}
    with Links(tmp_path, recording, {**PLACE, "backfill": {"topics": ["place"], "for_s": 300}}) as links:
        one = links.start(1, "1", "0", "--bag", str(bag), command=PEER)
        two = links.start(2, "2", "0", command=PEER)
        links.meet()
        wait_for(lambda: clock(one), "its clock to be known")
        known = time.time()
        wait_for(lambda: got(one) > 10, "places")
        for link in (one, two):
            link.transmit(on=False)
        wait_for(lambda: two.status()["backfill"]["kept"] > 30, "places that nobody heard")
        came = got(one)
        for link in (one, two):
            link.transmit(on=True)
        wait_for(lambda: filled(two), "the gap to be filled")
        wait_for(lambda: got(one) > came + 10, "places that come again")
        assert two.status()["backfill"]["given_up"] == 0
        assert one.end() == 0
    times = made(bag)
    assert len(times) > came + 30
    later = [at for at in times if at > known]
    assert later == sorted(later), "in the order in which they were made"
    assert is_whole(sorted(times))
    assert lost_of(bag) == {}


def test_who_records_starts_again_and_gets_what_was_sent_meanwhile(tmp_path: Path) -> None:
    key = tmp_path / "fleet.key"
    new_key_file(key)
    lossy = {**PLACE, "key": str(key), "channel": {"packet_loss": 0.1}}
    with Links(tmp_path, lossy, {**lossy, "backfill": {"topics": ["*"]}}) as links:
        two = links.start(2, "2", "0", command=PEER)
        times: list[float] = []
        for number in range(2):
            wait_for(lambda: two.status().get("backfill", {}).get("kept", 0) > 20, "places that nobody hears")
            bag = tmp_path / f"bag_{number}"
            one = links.start(1, "1", "0", "--bag", str(bag), command=PEER)
            wait_for(lambda: one.heard() and filled(two), "the gap to be filled")  # noqa: B023
            before = got(one)
            wait_for(lambda: got(one) > before + 5, "places")  # noqa: B023
            assert one.end() == 0
            times += made(bag)
            assert lost_of(bag) == {}
        assert two.status()["backfill"]["given_up"] == 0
    assert is_whole(sorted(set(times)))


def test_what_does_not_fit_is_given_up_and_the_bag_says_so(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    newest = {"topics": {"place": {"queue": "latest"}}}
    with Links(tmp_path, PLACE, {**newest, "backfill": {"topics": ["place"], "memory_mb": 0.01}}) as links:
        one = links.start(1, "1", "0", "--bag", str(bag), command=PEER)
        two = links.start(2, "2", "0", command=PEER)
        links.meet()
        wait_for(lambda: got(one) > 5, "places")
        two.transmit(on=False)  # it hears the other one all the time, which does not hear it
        wait_for(lambda: two.status()["backfill"]["given_up"] > 20, "places that do not fit")
        two.transmit(on=True)
        wait_for(lambda: filled(two), "the gap to be filled")
        given_up = two.status()["backfill"]["given_up"]
        before = got(one)
        wait_for(lambda: got(one) > before + 10, "places that come again")
        assert two.end() == 0
        two = links.start(2, "2", "0", command=PEER)
        before = got(one)
        wait_for(lambda: got(one) > before + 10, "places of its next start")
        assert one.end() == 0
    assert len(made(bag)) > 50
    assert lost_of(bag) == {PLACES: given_up}


@needs_root
def test_a_full_disk_ends_the_bag_alone_and_status_says_so(tmp_path: Path) -> None:
    with (
        disk(tmp_path / "disk", "size=64k") as small,
        Links(tmp_path, PLACE, {**PLACE, "backfill": {"topics": ["place"]}}) as links,
    ):
        one = links.start(1, "1", "0", "--bag", str(small / "bag"), command=PEER)
        two = links.start(2, "2", "0", command=PEER)
        links.meet()
        wait_for(lambda: got(one) > 5, "places")
        two.transmit(on=False)
        wait_for(lambda: two.status()["backfill"]["kept"] > 20, "places that nobody heard")
        with suppress(OSError), (small / "other").open("wb", buffering=0) as other:
            while other.write(bytes(4096)):
                pass
        two.transmit(on=True)
        wait_for(lambda: one.status()["incomplete"], "the disk to be full")
        ended = f"bag {small / 'bag'}: ended ("
        for words in ("status", "top"):
            assert ended in " ".join(one.ask(words)[1].split()), words
        before = got(one)
        wait_for(lambda: got(one) > before + 10 and filled(two), "places that come, and fill no bag")
        assert one.end() == 1
    assert any(line.startswith(ended) and line.endswith("events missed") for line in one.said)
