"""A block that delays packets.

Invariants: no packet passes before its delay is over; packets stay in order; nothing is dropped.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from gnuradio import gr

from gr_ros2.phy.pdus import PDUS
from gr_ros2.phy.threads import WaitingBlock


class PacketDelay(WaitingBlock, gr.basic_block):  # type: ignore[misc]
    """Message port `pdus` in and out: every packet leaves ``delay_s`` seconds after it came."""

    def __init__(self, delay_s: float) -> None:
        super().__init__("gr-ros2-delay", "gr_ros2_packet_delay", None, None)
        self._delay_s = delay_s
        self._waiting: deque[tuple[float, Any]] = deque()
        self.message_port_register_in(PDUS)
        self.message_port_register_out(PDUS)
        self.set_msg_handler(PDUS, self._take)

    def _take(self, pdu: Any) -> None:
        with self._changed:
            self._waiting.append((time.monotonic() + self._delay_s, pdu))
            self._changed.notify_all()

    def run(self) -> None:
        while True:
            with self._changed:
                while self._running and (left := self._left()) != 0:
                    self._changed.wait(left)
                if not self._running:
                    return
                _, pdu = self._waiting.popleft()
            self.message_port_pub(PDUS, pdu)

    def _left(self) -> float | None:
        """s until the first packet may leave, None if there is none."""
        return max(0.0, self._waiting[0][0] - time.monotonic()) if self._waiting else None
