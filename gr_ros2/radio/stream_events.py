"""Events that a device reports while it runs, counted by name: lost samples, bursts that came too late or were cut.

Invariants: a name means the same on every device. An event that a device cannot report is left out, not counted as 0.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pmt
from gnuradio import gr
from numpy.typing import NDArray

from gr_ros2.phy.threads import KeepsThreadState

BURSTS_OUT = "bursts_out"
"""Counter of the bursts that a device has sent completely. All other events are losses."""
_MARK = pmt.intern("rx_rate")
_ASYNC, _EVENTS = pmt.intern("async_msgs"), pmt.intern("event_code")
_NAMES = {
    "burst_ack": BURSTS_OUT,
    "underflow": "underflows",
    "underflow_in_packet": "underflows",
    "seq_error": "sequence_errors",
    "seq_error_in_burst": "sequence_errors",
    "time_error": "late",
}
"""Our names for the events of ``uhd.usrp_sink``."""


class GapCounter(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Counts the places where samples are missing.

    A source sets a tag `rx_rate` on its first sample, and on each sample that follows lost ones. ``uhd.usrp_source``
    does so, and ``soapy.source`` of GNU Radio 3.10.5 and later.
    """

    def __init__(self) -> None:
        super().__init__("gr_ros2_gap_counter", [np.complex64], None)
        self.gaps: int | None = None
        """Number of places so far; None if the source sets no tags."""

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        count = len(input_items[0])
        for tag in self.get_tags_in_window(0, 0, count, _MARK):
            self.gaps = (self.gaps or 0) + (tag.offset > 0)
        return count


class UsrpEvents(KeepsThreadState, gr.basic_block):  # type: ignore[misc]
    """Message port `async_msgs` in: the events of bursts that a ``uhd.usrp_sink`` reports.

    :ivar counted: ``bursts_out``: bursts that the USRP has sent completely; ``underflows``: it ran out of samples
        within a burst; ``sequence_errors``: packets lost on their way to the USRP; ``late``: bursts that came too late
    """

    def __init__(self) -> None:
        super().__init__("gr_ros2_usrp_events", None, None)
        self.counted = Counter(dict.fromkeys(_NAMES.values(), 0))
        self.message_port_register_in(_ASYNC)
        self.set_msg_handler(_ASYNC, self._count)

    def _count(self, message: Any) -> None:
        events = pmt.dict_ref(pmt.cdr(message), _EVENTS, pmt.PMT_NIL)
        for place in range(pmt.length(events)):
            name = pmt.symbol_to_string(pmt.nth(place, events))
            self.counted[_NAMES.get(name, name)] += 1
