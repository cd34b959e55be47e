"""Credits for a flowgraph that runs as fast as it can: only a few packets are in progress at any time.

Invariants: credits given are at most ``window`` ahead of the packets that have passed; several credits are given at a
time, since each message between blocks costs about as much as a packet; progress is polled while the window is full.
"""

from __future__ import annotations

from collections.abc import Callable

from gnuradio import gr

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.pdus import CreditPort
from gr_ros2.phy.threads import WaitingBlock

WINDOW = 32
"""Packets in progress: enough to keep the flowgraph busy between two polls of its progress."""

_SHARE = 4
"""A grant is at least this part of the window."""
_POLL_S = 0.001


class CreditWindow(WaitingBlock, gr.basic_block):  # type: ignore[misc]
    """Message port `credit` out: an integer, the number of further packets that may come, whenever the air is free.

    :param progress: returns how many packets have passed
    :param window: packets in progress, 1 or more
    :raises ConfigError: for a window below 1
    """

    def __init__(self, progress: Callable[[], int], window: int = WINDOW) -> None:
        super().__init__("gr-ros2-window", "gr_ros2_credit_window", None, None)
        if window < 1:
            raise ConfigError(f"window = {window}: must be 1 or more")
        self._progress = progress
        self._window = window
        self._credits = CreditPort(self)

    def start(self) -> bool:
        self._credits.find_readers()
        return super().start()

    def run(self) -> None:
        granted = self._progress()
        while self._running:
            credits = self._progress() + self._window - granted
            if credits * _SHARE >= self._window:
                self._credits.grant(credits, None)
                granted += credits
            with self._changed:
                if self._running:
                    self._changed.wait(_POLL_S)
