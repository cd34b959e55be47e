"""The gate in front of a simulated transmitter: packets pass one per airtime, and credits flow back.

Invariants: no packet passes before its airtime is over, or before it is about to begin where a device spends the
time (`throttle` would let bursts through); the queue is unbounded and counted; samples are never touched.
"""

from __future__ import annotations

import threading
import time
from array import array
from collections.abc import Callable
from typing import Any

import pmt
from gnuradio import gr

from gr_ros2.link.airtime import LEAD_S, AirtimeClock
from gr_ros2.link.lateness import Lateness
from gr_ros2.phy.pdus import CREDIT, PDUS, rung_of
from gr_ros2.phy.threads import BlockThread

_ONE = pmt.from_long(1)


class AirtimeGate(gr.basic_block):  # type: ignore[misc]
    """Message ports `pdus` in, `pdus` out, `credit` out (one message: one more packet may come).

    :param airtime: s that one packet occupies, gap included; 0 lets packets pass at once
    :param airtime_of: the airtime for a packet's bytes and rung, at most ``airtime``; None = all packets have the same
    :param lead: s before the channel is free at which a credit is given
    :param ahead: s before the begin of its airtime at which a packet passes, see :class:`AirtimeClock`
    :param times: store when each packet passed; off by default, since a link that runs without end would store too many
    :ivar lateness: delays of packets after the time at which they should pass
    :ivar passed_at: s, monotonic, of every packet; empty if ``times`` is off
    :raises ConfigError: for a value out of range
    """

    def __init__(
        self,
        airtime: float,
        *,
        airtime_of: Callable[[int, int], float] | None = None,
        lead: float = LEAD_S,
        ahead: float | None = None,
        times: bool = False,
    ) -> None:
        super().__init__("gr_ros2_airtime_gate", None, None)
        self._airtime_of = airtime_of
        self._clock: AirtimeClock[Any] = AirtimeClock(airtime, lead, ahead)
        self.passed = 0
        self.lateness = Lateness()
        self.passed_at = array("d")
        self._times = times
        self._changed = threading.Condition()
        self._running = False
        self._thread = BlockThread()
        self.message_port_register_in(PDUS)
        self.message_port_register_out(PDUS)
        self.message_port_register_out(CREDIT)
        self.set_msg_handler(PDUS, self._arrive)

    @property
    def backlog(self) -> int:
        """Packets that wait for the channel or occupy it."""
        return self._clock.backlog

    def start(self) -> bool:
        with self._changed:
            self._running = True
        self._thread.start(self._run, "gr-ros2-airtime")
        return True

    def stop(self) -> bool:
        with self._changed:
            self._running = False
            self._changed.notify_all()
        self._thread.stop()
        return True

    def _arrive(self, pdu: Any) -> None:
        airtime = None if self._airtime_of is None else self._airtime_of(int(pmt.length(pmt.cdr(pdu))), rung_of(pdu))
        with self._changed:
            self._clock.offer(pdu, time.monotonic(), airtime)
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._running:
                    return
                pdus, credits = self._step()
            for pdu in pdus:
                self.message_port_pub(PDUS, pdu)
            self.passed += len(pdus)
            for _ in range(credits):
                self.message_port_pub(CREDIT, _ONE)

    def _step(self) -> tuple[list[Any], int]:
        """What is due; waits until something is due."""
        now = time.monotonic()
        due = self._clock.first_due
        pdus, credits = self._clock.due(now), self._clock.grants(now)
        if pdus and due is not None:
            self.lateness.happened(due, now)
            if self._times:
                self.passed_at.extend([now] * len(pdus))
        if not pdus and not credits:
            at = self._clock.next_timeout(now)
            self._changed.wait(None if at is None else max(0.0, at - now))
        return pdus, credits
