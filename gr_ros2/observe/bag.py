"""What comes out of a link, as a ROS 2 bag (MCAP).

A message has two times in it: `log_time`, by which a bag is read and played, is when it was made, by this computer's
clock, as far as the clock of its sender is known, else for how long it has been under way at least; `publish_time` is
when it came out here.

What fills gaps of an outage (:mod:`gr_ros2.gr.backfill`) stands among the rest, once. What is missing at the end is
said in the bag, in the way of rosbag2 on `events/messages_lost` of the link's node: of topics whose gaps are filled
every message that their sender made between the first and the last account that came of it, of others only those that
came in part or too late. `metadata.yaml` says which are which.

Invariants: the link never waits for the disk; what the disk cannot take is counted and said.
"""

from __future__ import annotations

import time
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Hashable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from gr_ros2.calls.backfill import UNKNOWN_PLACE, Account, began_at, read_later
from gr_ros2.core.clocks import wall_ahead
from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import BagError, GrRos2Error, WireError
from gr_ros2.core.files import make_folder
from gr_ros2.core.names import link_node
from gr_ros2.link.events import APART, Announced, Delivered, Lost, ReceiverEvent, SenderEvent
from gr_ros2.link.key import Key
from gr_ros2.middleware.base import Qos
from gr_ros2.radio.lost_messages import LOST_TYPE, lost_definition, lost_event
from gr_ros2.settings.registry import BACKFILL_TYPE

if TYPE_CHECKING:
    from gr_ros2.middleware.bag_recorder import BagChannel
    from gr_ros2.observe.observers import LiveRun
    from gr_ros2.observe.result import RunResult

_DEPTH = 10
_LONGEST_S = 86400.0
"""s for which a message can have been under way."""
_REMEMBERED = 100_000
_Name = tuple[int, ...]
"""Of a message: its robot, the start of that, and where it began, or its serial number there."""


class _Counted:
    """Of a topic of one start of a robot: how many of its messages are missing, by accounts of the robot.

    :param topic: its name in the bag
    :ivar last: the newest account; None until there is one
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self._first: Account | None = None
        self.last: Account | None = None
        self._came = 0
        """Messages that came and are of packets between both accounts."""
        self._numbers: list[int] = []
        """Packets of those that came and are newer, in order."""

    def came(self, number: int) -> None:
        """A message came.

        :param number: of the packet in which it began
        """
        if self.last is None or number >= self.last.number:
            insort(self._numbers, number)
            del self._numbers[:-_REMEMBERED]
        elif self._first is not None and number >= self._first.number:
            self._came += 1

    def told(self, account: Account) -> None:
        """Its sender tells how many there were."""
        if self.last is not None and account.number <= self.last.number:
            return
        older = bisect_left(self._numbers, account.number)
        if self._first is None:
            self._first = account
        else:
            self._came += older
        del self._numbers[:older]
        self.last = account

    @property
    def missing(self) -> int:
        """How many have not come."""
        if self._first is None or self.last is None:
            return 0
        return max(self.last.count - self._first.count - self._came, 0)


class OutputBag(Closing):
    """A bag being written: a :class:`gr_ros2.observe.observers.RunObserver`.

    :param path: folder that does not exist yet
    :raises ConfigError: the folder around it cannot be made
    :raises BagError: it exists already, or cannot be made
    :ivar missed: messages that are not in it, by reason
    """

    instruments = False

    def __init__(self, path: Path) -> None:
        from gr_ros2.middleware.bag_recorder import BagRecorder

        self.name = f"bag {path}"
        self.missed: Counter[str] = Counter()
        self._run: LiveRun | None = None
        self._nameless: Counter[str] = Counter()
        """Messages of each topic that were lost, of which nothing else is known."""
        self._lost: dict[_Name, tuple[int, str]] = {}
        """Topics of messages of which only a part has come: id and name."""
        self._counted: dict[tuple[int, int, int], _Counted] = {}
        """By robot, its start and the id of a topic whose gaps are filled."""
        self._fillers: dict[tuple[int, int], int] | None = None
        self._known: dict[_Name, None] = {}
        """The newest messages of robots that fill gaps, as one may come twice: where it was not known to be heard."""
        self._channels: dict[tuple[int, int], BagChannel | None] = {}
        make_folder(path.parent)
        self._recorder = BagRecorder(path, "mcap", {LOST_TYPE: lost_definition()}, self._count, lossless=False)

    def run_started(self, run: LiveRun) -> None:
        self._run = run

    def run_ended(self, result: RunResult | None) -> None:
        """Do nothing: the code that opened the bag closes it."""

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        """What this robot sends, its own bag has."""

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """Write a message that came out.

        :raises BagError: when the file cannot be written
        """
        if isinstance(event, Announced):
            for row in event.topics:
                self._channels.pop((event.src_id, row.topic_id), None)  # it may mean something else now
            self._fillers = None
        elif self._run is None:
            return
        elif isinstance(event, Lost):
            self._note_lost(self._run, event)
        elif isinstance(event, Delivered) and not event.again:
            came = now + wall_ahead(self._run.clock)
            fillers = self._filling(self._run)
            if (event.src_id, event.topic_id) in fillers:
                self._fill(self._run, event, came)
                return
            if isinstance(event.key, Key):
                name = _name(event.src_id, event.key)
                self._lost.pop(name, None)
                if event.src_id in fillers.values():
                    if self._is_known(name):
                        return
                    self._count_of(self._run, event.src_id, event.key.boot, event.topic_id).came(event.key.number)
            took = event.latency_s
            if took is None or not 0 <= took <= _LONGEST_S:  # a stamp of simulated time, or of a bag that is played
                # One that was repaired may have been under way for any time up to its age.
                took = 0.0 if event.repaired else event.age_s
            self._write(self._run, (event.src_id, event.topic_id), came - took, came, event.message)

    def close(self) -> None:
        """Finish the file; :meth:`incomplete` says what could not be written. Idempotent."""
        with suppress(GrRos2Error):
            if not self._recorder.closed and self._run is not None:
                self._tell_lost(self._run)
        with suppress(BagError):
            self._recorder.close()

    def incomplete(self) -> list[str]:
        """What is not in it, a line each."""
        failed = [] if self._recorder.error is None else [str(self._recorder.error)]
        return failed + [
            f"{self.name}: {what.partition(':')[2]} lacks {count} messages" for what, count in self.missed.items()
        ]

    def _filling(self, run: LiveRun) -> Mapping[tuple[int, int], int]:
        """The topics whose messages fill gaps of others, and the robots that send them."""
        if self._fillers is None:
            rows = run.announced()
            self._fillers = {(src, topic.topic_id): src for src, _, topic in rows if topic.type_name == BACKFILL_TYPE}
        return self._fillers

    def _fill(self, run: LiveRun, event: Delivered, came: float) -> None:
        """Write messages that fill gaps, and note how many there were."""
        try:
            found = read_later(event.message)
        except WireError as error:
            self._count(f"not_recorded:robot {event.src_id}", str(error))
            return
        boot = event.key.boot if isinstance(event.key, Key) else 0
        apart = event.topic_id // APART * APART
        clock = run.clocks().get(event.src_id)
        for each in found:
            counted = self._count_of(run, event.src_id, boot, each.topic_id + apart)
            if isinstance(each, Account):
                counted.told(each)
                continue
            known = self._is_known((event.src_id, boot, each.serial))
            if each.began is not None:
                name = (event.src_id, boot, *each.began)
                if self._lost.pop(name, None) is None:  # of one whose first part is missing the place is not known
                    self._lost.pop((*name[:3], UNKNOWN_PLACE), None)
                known = self._is_known(name) or known
            if not known:
                counted.came(each.at[0])
                made = each.made_us * 1e-6 - (0.0 if clock is None else clock.ahead_s)
                self._write(run, (event.src_id, each.topic_id + apart), made, came, each.payload)

    def _is_known(self, name: _Name) -> bool:
        """Whether a message of this name is in the bag; from now on it is."""
        if name in self._known:
            return True
        self._known[name] = None
        if len(self._known) > _REMEMBERED:
            del self._known[next(iter(self._known))]
        return False

    def _count_of(self, run: LiveRun, src_id: int, boot: int, topic_id: int) -> _Counted:
        found = self._counted.get((src_id, boot, topic_id))
        if found is None:
            channel = self._channel(run, (src_id, topic_id))
            if channel is None:
                return _Counted("")
            found = self._counted[src_id, boot, topic_id] = _Counted(channel.topic)
        return found

    def _note_lost(self, run: LiveRun, event: Lost) -> None:
        """A message is missing in the bag, unless it comes later."""
        channel = self._channel(run, (event.src_id, event.topic_id))
        name = _name(event.src_id, event.key) if isinstance(event.key, Key) else None
        if channel is None or name in self._known:  # it filled a gap before it was given up
            return
        if name is not None and len(self._lost) < _REMEMBERED:
            self._lost[name] = event.topic_id, channel.topic
        else:
            self._nameless[channel.topic] += 1

    def _tell_lost(self, run: LiveRun) -> None:
        """Say in the bag what is missing in it, as rosbag2 does, and which topics that counts."""
        lost, whole = Counter[str](), set[str]()
        for counted in self._counted.values():
            if counted.last is not None:
                whole.add(counted.topic)
                lost[counted.topic] += counted.missing
        for (src_id, boot, number, _), (topic_id, topic) in self._lost.items():
            found = self._counted.get((src_id, boot, topic_id))
            lost[topic] += found is None or found.last is None or number >= found.last.number
        lost += Counter({topic: count for topic, count in self._nameless.items() if topic not in whole})
        counted_whole = ", ".join(sorted(whole)) or "no topic"
        self._recorder.note(
            "messages_lost", f"all that were made, of {counted_whole}; of others, those that came in part or too late"
        )
        if lost:
            node = link_node(next(iter(run.sources)))
            where = self._recorder.channel(f"/{node}/events/messages_lost", LOST_TYPE, Qos(depth=_DEPTH))
            self._recorder.write(where, time.time_ns(), lost_event(node, lost))

    def _write(self, run: LiveRun, key: tuple[int, int], made: float, came: float, payload: bytes) -> None:
        """Write a message of a topic, if there is such a topic."""
        channel = self._channel(run, key)
        if channel is not None:
            self._recorder.write(channel, max(0, round(made * 1e9)), payload, round(came * 1e9))

    def _channel(self, run: LiveRun, key: tuple[int, int]) -> BagChannel | None:
        """The channel of a topic; None for what is no topic, or has another type than one of the same name."""
        if key not in self._channels:
            found = None
            for src_id, name, topic in run.announced():
                if (src_id, topic.topic_id) == key and topic.is_topic:
                    qos = Qos("reliable", "transient_local" if topic.latched else "volatile", _DEPTH)
                    try:
                        found = self._recorder.channel(name, topic.type_name, qos)
                    except GrRos2Error as error:
                        self._count(f"not_recorded:{name}", str(error))
            self._channels[key] = found
        return self._channels[key]

    def _count(self, what: str, why: str) -> None:  # noqa: ARG002 - the reason is that of the error
        self.missed[what] += 1


def _name(src_id: int, key: Hashable) -> _Name:
    assert isinstance(key, Key)
    return src_id, key.boot, *began_at(key.number, key.place)
