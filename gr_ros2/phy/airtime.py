"""The gate in front of a simulated transmitter: packets pass at the pace of the air, and credits flow back.

Laws: with pace `airtime` no packet passes before its airtime is over, or ``early`` before that where a device
spends the time (`throttle` would let bursts through), and
the queue is unbounded and counted; with pace `flow` packets pass at once, and credits keep at most ``window`` of
them between the gate and the place ``progress`` counts at; samples are never touched.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Literal

import pmt
from gnuradio import gr

from gr_ros2.errors import ConfigError
from gr_ros2.link.airtime import LEAD_S, AirtimeClock
from gr_ros2.phy.threads import BlockThread, quicken_threads

Pace = Literal["airtime", "flow"]
WINDOW = 32
"""Packets under way with pace `flow`: enough to keep the flowgraph busy between two looks at its progress."""

_POLL_S = 0.001
_JOIN_S = 1.0
_PDUS, _CREDIT = pmt.intern("pdus"), pmt.intern("credit")
_ONE = pmt.from_long(1)
_log = logging.getLogger(__name__)


class AirtimeGate(gr.basic_block):  # type: ignore[misc]
    """Message ports `pdus` in, `pdus` out, `credit` out (one message: one more packet may come).

    :param airtime: s one packet occupies, gap included; 0 lets packets pass at once
    :param pace: `airtime` as on the air; `flow` as fast as the flowgraph takes it
    :param lead: s before the air is free at which a credit is given
    :param early: s before its airtime is over at which a packet passes, see :class:`AirtimeClock`
    :param window: packets under way with pace `flow`, or with airtime 0, 1 or more
    :param progress: number of packets that are through, for the window; None counts those that passed the gate
    :raises ConfigError: for a value out of range
    """

    def __init__(
        self,
        airtime: float = 0.0,
        pace: Pace = "airtime",
        *,
        lead: float = LEAD_S,
        early: float = 0.0,
        window: int = WINDOW,
        progress: Callable[[], int] | None = None,
    ) -> None:
        super().__init__("gr_ros2_airtime_gate", None, None)
        if pace not in ("airtime", "flow"):
            raise ConfigError(f"pace = {pace!r}: write airtime or flow")
        if window < 1:
            raise ConfigError(f"window = {window}: must be 1 or more")
        if airtime < 0:
            raise ConfigError(f"airtime = {airtime} s: must be 0 or more")
        self._clock: AirtimeClock[Any] | None = None
        if pace == "airtime" and airtime > 0:
            self._clock = AirtimeClock(airtime, lead, early)
        self._window = window
        self._progress = progress
        self._granted = 0
        self.passed = 0
        self._changed = threading.Condition()
        self._running = False
        self._thread: threading.Thread | None = None
        self._block_thread = BlockThread()
        self.message_port_register_in(_PDUS)
        self.message_port_register_out(_PDUS)
        self.message_port_register_out(_CREDIT)
        self.set_msg_handler(_PDUS, self._arrive)

    @property
    def backlog(self) -> int:
        """Packets waiting for the air or on it."""
        return self._clock.backlog if self._clock is not None else 0

    def start(self) -> bool:
        quicken_threads()
        self._block_thread.keep()
        with self._changed:
            self._running = True
        self._thread = threading.Thread(target=self._run, name="gr-ros2-airtime", daemon=True)
        self._thread.start()
        return True

    def stop(self) -> bool:
        with self._changed:
            self._running = False
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        self._block_thread.release()
        return True

    def _arrive(self, pdu: Any) -> None:
        if self._clock is None:
            self.message_port_pub(_PDUS, pdu)
            self.passed += 1
        else:
            with self._changed:
                self._clock.offer(pdu, time.monotonic())
                self._changed.notify_all()

    def _run(self) -> None:
        step = self._by_window if self._clock is None else self._by_clock
        while True:
            with self._changed:
                if not self._running:
                    return
                pdus, credits = step()
            for pdu in pdus:
                self.message_port_pub(_PDUS, pdu)
            self.passed += len(pdus)
            for _ in range(credits):
                self.message_port_pub(_CREDIT, _ONE)

    def _by_clock(self) -> tuple[list[Any], int]:
        """What is due, after waiting for it if nothing is yet."""
        assert self._clock is not None
        now = time.monotonic()
        pdus, credits = self._clock.due(now), self._clock.grants(now)
        if not pdus and not credits:
            at = self._clock.next_timeout(now)
            self._changed.wait(None if at is None else max(0.0, at - now))
        return pdus, credits

    def _by_window(self) -> tuple[list[Any], int]:
        """Credits up to the window, after a moment if it is full: progress can only be polled."""
        done = self.passed if self._progress is None else self._progress()
        credits = max(0, done + self._window - self._granted)
        self._granted += credits
        if not credits:
            self._changed.wait(_POLL_S)
        return [], credits
