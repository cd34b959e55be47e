"""`--bag FILE`: what comes out of a link, as a ROS 2 bag (MCAP).

A message has two times in it: `log_time`, by which a bag is read and played, is when it was made, by this computer's
clock, as far as the clock of its sender is known, else for how long it has been under way at least; `publish_time` is
when it came out here.

Invariants: the link never waits for the disk; what the disk cannot take is counted and said. A bag of a link that was
killed has all but what was written last.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click

from gr_ros2.core.closing import Closing
from gr_ros2.core.errors import BagError, GrRos2Error
from gr_ros2.core.files import make_folder
from gr_ros2.link.events import Announced, Delivered, ReceiverEvent, SenderEvent
from gr_ros2.middleware.base import Qos

if TYPE_CHECKING:
    from gr_ros2.middleware.bag_recorder import BagChannel
    from gr_ros2.observe.observers import LiveRun
    from gr_ros2.observe.result import RunResult

_DEPTH = 10


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
        self._channels: dict[tuple[int, int], BagChannel | None] = {}
        make_folder(path.parent)
        self._recorder = BagRecorder(path, "mcap", {}, self._count, lossless=False)

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
        elif isinstance(event, Delivered) and self._run is not None:
            channel = self._channel(self._run, (event.src_id, event.topic_id))
            if channel is not None:
                came = time.time() - (self._run.clock() - now)
                made = came - (event.age_s if event.latency_s is None else event.latency_s)
                self._recorder.write(channel, round(made * 1e9), event.message, round(came * 1e9))

    def close(self) -> None:
        """Finish the file; :meth:`incomplete` says what could not be written. Idempotent."""
        with suppress(BagError):
            self._recorder.close()

    def incomplete(self) -> list[str]:
        """What is not in it, a line each."""
        failed = [] if self._recorder.error is None else [str(self._recorder.error)]
        return failed + [
            f"{self.name}: {what.partition(':')[2]} lacks {count} messages" for what, count in self.missed.items()
        ]

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


bag_option = click.option(
    "--bag", type=click.Path(path_type=Path), metavar="FOLDER", help="Record what comes out as a ROS 2 bag (MCAP)."
)


@contextmanager
def output_bag(path: Path | None) -> Iterator[list[OutputBag]]:
    """The bags of a command: one if a folder is named, otherwise none.

    :raises BagError: when it cannot be made
    """
    if path is None:
        yield []
        return
    with OutputBag(path) as one:
        yield [one]
