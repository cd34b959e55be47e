"""What fills gaps waits for everything else, and keeps to an airtime limit; losses and restarts take nothing of it."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any, Literal

import pytest

from gr_ros2.calls.backfill import Later, read_later
from gr_ros2.gr.backfill import Backfill
from gr_ros2.link.events import Delivered, Received, ReceiverEvent, Rejected, SenderEvent
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.mac import Slots
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.observe.bag import OutputBag
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import BACKFILL_TYPE, Registry, Topic
from gr_ros2.settings.robot import BackfillConfig
from tests.link.v1.air import SLOT_S, Air, Robot, registry
from tests.link.v1.test_relaying import Line
from tests.observe.test_bag import OneEnd, lost_of

ODOM, SCAN = range(2)
TOPICS = Registry(
    [
        Topic(ODOM, "odom", "std_msgs/msg/String", SendOptions(queue="latest", reliability="best_effort")),
        Topic(SCAN, "scan", "std_msgs/msg/String", SendOptions(queue="fifo", reliability="best_effort")),
    ]
)
WHOLE = 51
"""bytes of a message that fills a packet."""


class Noted(list[SenderEvent | ReceiverEvent]):
    """The events of a robot, of which what fills its gaps takes note."""

    def __init__(self, robot: Filling) -> None:
        super().__init__()
        self._robot = robot

    def append(self, event: SenderEvent | ReceiverEvent) -> None:
        super().append(event)
        if self._robot.backfill is not None:
            self._robot.backfill.note(event)  # type: ignore[arg-type]


class Filling(Robot):
    """A robot that fills gaps of odometry."""

    backfill: Backfill | None = None
    share = 1.0
    records: tuple[int, ...] = ()
    ahead_s = 0.0
    """s by which its clock is ahead of the time of the link."""

    def start(self, boot: int | None = None) -> None:
        self.events = Noted(self)
        super().start(boot)
        self.backfill = Backfill(
            BackfillConfig(topics=("odom",), robots=self.records),
            self.end,
            share=self.share,
            chosen=lambda topic: topic == ODOM,
            wall_ahead=lambda: self.ahead_s,
        )


class Pair:
    """A robot that fills gaps, and one that reports.

    :ivar away: whether they do not hear each other
    """

    def __init__(self, mode: SealMode = "none", share: float = 1.0, loss: float = 0.0) -> None:
        settings: dict[str, Any] = {"packet_s": lambda: SLOT_S, "airtime_share": share} if share < 1 else {}
        Filling.share = share
        self.one, self.two = Filling(1, TOPICS, mode=mode, **settings), Robot(2, mode=mode)
        self.air = Air(self.one, self.two, loss=loss)
        lost = self.air.lost
        self.away = False
        self.air.lost = lambda sender, receiver: self.away or lost(sender, receiver)
        self.made = 0

    @property
    def backfill(self) -> Backfill:
        assert self.one.backfill is not None
        return self.one.backfill

    def slots(self, count: int, *, odom: int = 0, scans: int = 0) -> None:
        """So many slots: a message of odometry in every so many of them, and so many scans in each."""
        for slot in range(count):
            for _ in range(scans):
                self.one.end.messages.submit(SCAN, bytes(WHOLE), self.air.now)
            if odom and not slot % odom:
                self.one.end.messages.submit(ODOM, self.made.to_bytes(4, "big").ljust(WHOLE, b"."), self.air.now)
                self.made += 1
            self.backfill.look(self.air.now)
            self.air.step()

    def outage(self, slots: int = 600) -> None:
        self.away = True
        self.slots(slots, odom=4)
        self.away = False

    def fills(self) -> list[Later]:
        """The messages that came later."""
        return [
            each
            for event in self.two.events
            if isinstance(event, Delivered) and event.topic_id > SCAN
            for each in read_later(event.payload)
            if isinstance(each, Later)
        ]

    def later(self) -> list[int]:
        """Their numbers."""
        return [int.from_bytes(each.payload[:4], "big") for each in self.fills()]

    def live(self) -> list[int]:
        found = [event for event in self.two.events if isinstance(event, Delivered) and event.topic_id == ODOM]
        return [int.from_bytes(event.payload[:4], "big") for event in found]


def test_nothing_crosses_later_while_others_fill_the_air() -> None:
    pair = Pair()
    pair.slots(200, odom=4)
    pair.outage()
    kept = len(pair.backfill.kept)
    assert kept > 100
    pair.slots(100, scans=2)
    before = len(pair.later())
    pair.slots(600, scans=2)
    assert len(pair.later()) == before, "a turn came to it"
    for _ in range(40):
        pair.slots(200)
    assert not len(pair.backfill.kept)
    later = list(dict.fromkeys(pair.later()))  # one told several times whether somebody hears
    assert len(later) >= kept
    assert later == sorted(later), "oldest first"


@pytest.mark.parametrize("mode", ["none", "encrypt"])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_what_an_outage_took_crosses_once_whoever_starts_again_meanwhile(mode: SealMode, loss: float) -> None:
    pair = Pair(mode, loss=loss)
    pair.slots(200, odom=4)
    first = pair.made
    pair.outage()
    last = pair.made
    pair.slots(40, odom=4)
    pair.two.start()
    for _ in range(100):
        pair.slots(100, odom=20)
        if not len(pair.backfill.kept):
            break
    later, live = pair.later(), pair.live()
    assert set(range(first + 5, last - 5)) <= {*later, *live}
    pair.one.start()
    pair.outage()
    assert len(pair.backfill.kept) > 100, "it keeps what its next start sends"


def test_an_airtime_limit_holds_for_what_crosses_later() -> None:
    pair = Pair(share=0.1)
    pair.slots(200, odom=40)
    pair.outage()
    packets = pair.one.end.sent.packets
    pair.slots(4000, odom=40)
    assert len(pair.later()) > 50
    assert pair.one.end.sent.packets - packets < 0.2 * 4000


def test_single_messages_that_were_lost_cross_later() -> None:
    pair = Pair(loss=0.2)
    pair.slots(200, odom=4)
    first = pair.made
    pair.slots(2000, odom=4)
    last = pair.made
    live = set(pair.live())
    pair.slots(1000, odom=4)
    assert len(set(range(first, last)) - live) > 10
    assert set(range(first, last)) <= {*pair.later(), *pair.live()}
    assert len(pair.later()) < (last - first) / 2, "not all that was repaired, too"


@pytest.mark.parametrize("reliability", ["best_effort", "reliable"])
def test_in_slots_where_reports_are_rare_not_all_crosses_twice(reliability: Literal["best_effort", "reliable"]) -> None:
    topics = registry(odom=SendOptions(queue="latest", reliability=reliability))

    def slots(src_id: int) -> dict[str, Any]:
        return {"access": Slots(src_id, SLOT_S, random.Random(src_id), period_s=0.0), "packet_len": 220}

    one, two = Filling(1, topics, hears=True, **slots(1)), Robot(2, topics, hears=True, **slots(2))
    line = Line(one, two)
    for _ in range(600):
        assert one.backfill is not None
        one.backfill.look(line.now)
        line.run(0.1)
    fills = [event for event in two.events if isinstance(event, Delivered) and event.topic_id > 0]
    again = sum(len(read_later(event.payload)) for event in fills)
    assert again < 0.25 * len(two.delivered(1))


@pytest.mark.parametrize("ahead_s", [1e6, -1e6])
def test_a_clock_that_is_set_in_an_outage_leaves_what_was_kept_in_order(ahead_s: float) -> None:
    pair = Pair()
    pair.slots(200, odom=4)
    pair.outage(300)
    pair.one.ahead_s = ahead_s
    pair.outage(300)
    for _ in range(20):
        pair.slots(200)
    made = list({each.serial: each.made_us for each in pair.fills()}.values())  # one may have waited to leave before
    assert len(made) > 100
    assert made == sorted(made)
    assert made[-1] - made[0] < 1e6 * 700 * SLOT_S


@pytest.mark.parametrize("records", [(), (2,)])
def test_what_one_who_records_has_not_heard_crosses_later_whoever_else_has(
    monkeypatch: pytest.MonkeyPatch, records: tuple[int, ...]
) -> None:
    monkeypatch.setattr(Filling, "records", records)
    pair = Pair()
    other = Robot(3)
    pair.air.robots.append(other)
    pair.air.lost = lambda sender, receiver: pair.away and other not in (sender, receiver)
    pair.slots(200, odom=4)
    first = pair.made
    pair.outage(1200)
    last = pair.made
    for _ in range(20):
        pair.slots(200, odom=20)
    missing = set(range(first, last)) - {*pair.later(), *pair.live()}
    assert bool(missing) != bool(records)
    assert not len(pair.backfill.kept)


@pytest.mark.parametrize(("mode", "loss"), [("none", 0.0), ("encrypt", 0.3)])
def test_a_bag_lacks_as_many_messages_as_it_says(tmp_path: Path, mode: SealMode, loss: float) -> None:
    pair = Pair(mode, loss=loss)
    end = OneEnd()
    end.announced = lambda: [
        (1, "/x/odom", Topic(ODOM, "odom", "std_msgs/msg/String")),
        (1, "/x/_backfill", Topic(2, "_backfill", BACKFILL_TYPE)),
    ]
    bag = OutputBag(tmp_path / "bag")
    bag.run_started(end)  # type: ignore[arg-type]

    def record() -> None:
        for event in pair.two.events:
            if not isinstance(event, Received | Rejected):
                bag.receiver_event(event, pair.air.now)
        pair.two.events.clear()

    for start in range(2):
        pair.slots(300, odom=3)
        pair.backfill.kept._most = 20_000
        pair.outage(800)  # of which the memory holds a part
        record()
        pair.slots(300, odom=3)
        if start:
            pair.two.start()  # and goes on with its bag
        pair.slots(1200, odom=20)
        record()
        assert pair.backfill.kept.lost > 100
        if not start:
            pair.one.start()
    bag.close()
    came = [each.payload[:4] for each in read_bag(tmp_path / "bag") if each.topic == "/x/odom"]
    assert len(came) == len(set(came))
    assert lost_of(tmp_path / "bag") == {"/x/odom": pair.made - len(came)}


def test_what_would_be_repaired_when_later_ones_are_out_crosses_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        f"{__name__}.TOPICS",
        registry(
            odom=SendOptions(queue="fifo", reliability="best_effort"),
            scan=SendOptions(queue="fifo", reliability="best_effort"),
        ),
    )
    pair = Pair()
    pair.slots(200, odom=4)
    first = pair.made
    for _ in range(3):  # too short for anybody to seem gone
        pair.outage(100)
        pair.slots(300, odom=4)
    last = pair.made
    pair.slots(200, odom=20)
    assert len(set(pair.later())) > 60
    assert set(range(first, last)) <= {*pair.later(), *pair.live()}
