"""What one endpoint of a robot has on its ROS graph, and how it leaves it."""

from __future__ import annotations

from typing import Any

from gr_ros2.gr.backfill import LiveBackfill
from gr_ros2.gr.calls import LiveCalls
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.gr.throughput import LiveThroughput
from gr_ros2.gr.wishes import LiveWishes


class LinkParts:
    """A block that sends and one that receives, and what crosses beside their topics.

    :ivar calls: its services; None where it goes one way, or topics leave no room for calls
    :ivar wishes: topics asked for from afar; None likewise
    :ivar throughput: measurements of what it carries; None likewise
    :ivar backfill: what crosses later; None where nothing does
    """

    source: SendingBlock
    sink: ReceivingBlock
    calls: LiveCalls | None = None
    wishes: LiveWishes | None = None
    throughput: LiveThroughput | None = None
    backfill: LiveBackfill | None = None

    def close(self) -> None:
        """Leave the ROS graph, also where not all of it could be made. Idempotent."""
        halves = getattr(self, "source", None), getattr(self, "sink", None)
        for part in (self.backfill, self.throughput, self.wishes, self.calls, *halves):
            if part is not None:
                part.close()

    def stats(self) -> dict[str, Any]:
        """A snapshot of each; {} for what it does not have."""
        beside = {"calls": self.calls, "backfill": self.backfill, "wishes": self.wishes}
        return {
            "source": self.source.stats(),
            "sink": self.sink.stats(),
            **{name: {} if part is None else part.stats() for name, part in beside.items()},
        }
