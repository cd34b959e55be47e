"""What becomes of the messages that are submitted to one sender: numbered, counted, and told to an observer."""

from __future__ import annotations

from collections.abc import Callable

from gr_ros2.link.events import Accepted, Ended, Missed, Refused
from gr_ros2.link.fates import Fate
from gr_ros2.link.stats import SenderStats

MessageObserver = Callable[[Accepted | Refused | Missed | Ended], None]


class SenderLedger:
    """The ledger of one sender.

    :param stats: where everything is counted
    :param observer: is told all of it; None: nobody asks
    :ivar serial: of the next message
    """

    def __init__(self, stats: SenderStats, observer: MessageObserver | None) -> None:
        self._stats = stats
        self._observer = observer
        self.serial = 0

    @property
    def observed(self) -> bool:
        """Whether somebody is told, who wants to know what is to come out."""
        return self._observer is not None

    def new(self, topic_id: int) -> int:
        """Count a message that is submitted; returns its serial."""
        self._stats.submitted[topic_id] += 1
        self.serial += 1
        return self.serial - 1

    def accept(self, serial: int, topic_id: int, payload: bytes, now: float, expected: bytes | None = None) -> None:
        """A message was submitted (see :class:`Accepted`)."""
        if self._observer is not None:
            self._observer(Accepted(serial, topic_id, payload, now, expected))

    def refuse(self, serial: int, topic_id: int, fate: Fate, detail: str) -> None:
        """A message will not be sent, or not completely."""
        self._stats.refused[topic_id, fate.value] += 1
        if self._observer is not None:
            self._observer(Refused(serial, topic_id, fate, detail))

    def missed(self, topic_id: int, total: int) -> None:
        """The ROS graph has lost this many messages of a topic since the start, before they could be submitted."""
        new = total - self._stats.missed[topic_id]
        if new > 0:
            self._stats.missed[topic_id] = total
            if self._observer is not None:
                self._observer(Missed(topic_id, new))

    def ended(self, serial: int, topic_id: int, dst_id: int, arrived: bool) -> None:
        """A message for one robot has come there, or is kept no longer without that being known."""
        self._stats.ended[topic_id, arrived] += 1
        if self._observer is not None:
            self._observer(Ended(serial, topic_id, dst_id, arrived))
