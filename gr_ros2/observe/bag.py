"""What comes out of a link, as a ROS 2 bag (MCAP).

A message has two times in it: `log_time`, by which a bag is read and played, is when it was made, by this computer's
clock, as far as the clock of its sender is known, else for how long it has been under way at least; `publish_time` is
when it came out here.

What fills gaps of an outage (:mod:`gr_ros2.gr.backfill`) stands among the rest, once. What is missing at the end is
said in the bag, in the way of rosbag2 on `events/messages_lost` of the link's node: messages of which a part has come,
and those that their sender has given up.

Invariants: the link never waits for the disk; what the disk cannot take is counted and said.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Hashable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from gr_ros2.calls.backfill import UNKNOWN_PLACE, Missing, began_at, read_later
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
        self._given_up: Counter[str] = Counter()
        """Messages of each topic that nobody has any more."""
        self._lost: dict[_Name, str] = {}
        """Topics of messages of which only a part has come."""
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
            self._note_lost(self._run, event.src_id, event.topic_id, key=event.key)
        elif isinstance(event, Delivered) and not event.again:
            came = now + wall_ahead(self._run.clock)
            fillers = self._filling(self._run)
            if (event.src_id, event.topic_id) in fillers:
                self._fill(self._run, event, came)
                return
            fills = event.src_id in fillers.values() and isinstance(event.key, Key)
            if fills and self._is_known(_name(event.src_id, event.key)):
                return
            took = event.latency_s
            if took is None or not 0 <= took <= _LONGEST_S:  # a stamp of simulated time, or of a bag that is played
                # One that was repaired may have been under way for any time up to its age.
                took = 0.0 if event.repaired else event.age_s
            self._write(self._run, (event.src_id, event.topic_id), came - took, came, event.message)

    def close(self) -> None:
        """Finish the file; :meth:`incomplete` says what could not be written. Idempotent."""
        with suppress(GrRos2Error):
            if not self._recorder.closed:
                self._tell_lost()
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
        """Write messages that fill gaps, and note what their sender has given up."""
        try:
            found = read_later(event.message)
        except WireError as error:
            self._count(f"not_recorded:robot {event.src_id}", str(error))
            return
        boot = event.key.boot if isinstance(event.key, Key) else 0
        apart = event.topic_id // APART * APART
        clock = run.clocks().get(event.src_id)
        for each in found:
            if isinstance(each, Missing):
                self._note_lost(run, event.src_id, each.topic_id + apart, each.count)
                continue
            known = self._is_known((event.src_id, boot, each.serial))
            if each.began is not None:
                name = (event.src_id, boot, *each.began)
                if self._lost.pop(name, None) is None:  # of one whose first part is missing the place is not known
                    self._lost.pop((*name[:3], UNKNOWN_PLACE), None)
                known = self._is_known(name) or known
            if not known:
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

    def _note_lost(self, run: LiveRun, src_id: int, topic_id: int, count: int = 1, key: Hashable = None) -> None:
        """Messages are missing in the bag, unless they come later."""
        channel = self._channel(run, (src_id, topic_id))
        name = _name(src_id, key) if isinstance(key, Key) else None
        if channel is None or name in self._known:  # it filled a gap before it was given up
            return
        if name is not None and len(self._lost) < _REMEMBERED:
            self._lost[name] = channel.topic
        else:
            self._given_up[channel.topic] += count

    def _tell_lost(self) -> None:
        """Say in the bag what is missing in it, as rosbag2 does."""
        lost = self._given_up + Counter(self._lost.values())
        if lost and self._run is not None:
            node = link_node(next(iter(self._run.sources)))
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
