"""The gate in front of a simulated transmitter: packets pass one per airtime, and credits flow back.

A thread of its own looks when packets pass, or the one that composes them (``looks``), which saves a hop for each
packet and for each credit.

Invariants: no packet passes before its airtime is over, or before it is about to begin where a device spends the
time (`throttle` would let bursts through); the queue is unbounded and counted; samples are never touched.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import lru_cache
from math import inf
from typing import Any

from gnuradio import gr

from gr_ros2.link.airtime import LEAD_S, AirtimeClock
from gr_ros2.link.airtime_limit import AirtimeLimit
from gr_ros2.link.events import AirPacket
from gr_ros2.link.lateness import Lateness
from gr_ros2.phy.pdus import CreditPort, PduPort, packets_of, take_messages, with_begin
from gr_ros2.phy.threads import WaitingBlock, wait_until_s


class AirtimeGate(WaitingBlock, gr.basic_block):  # type: ignore[misc]
    """Message ports `pdus` in, `pdus` out, `credit` out (see :class:`gr_ros2.gr.sending.SendingBlock`).

    :param airtime: s that one packet occupies, gap included; 0 lets packets pass at once
    :param airtime_of: the airtime for a packet's bytes and MCS, at most ``airtime``; None = all packets have the same
    :param ahead: s before the begin of its airtime at which a packet passes, see :class:`AirtimeClock`
    :param limit: what limits the airtime, see :class:`AirtimeClock`; None = nothing
    :param timed, listens, ready: see :class:`AirtimeClock`
    :param admits: whether a packet with these bytes may be sent at all; others count as refused, `not_sealed`
    :param clock: s, monotonic
    :ivar lateness: delays of packets after the time at which they should pass
    :ivar looks_at: when somebody has to call :meth:`step` next, s; infinite until something changes
    :ivar looks: wakes the thread that does so, once ``looks_at`` has changed. It is set before the flowgraph starts;
        None: the gate has a thread of its own
    :raises ConfigError: for a value out of range
    """

    def __init__(
        self,
        airtime: float,
        *,
        airtime_of: Callable[[int, int], float] | None = None,
        ahead: float | None = None,
        limit: AirtimeLimit | None = None,
        timed: bool = False,
        listens: Callable[[], float] | None = None,
        ready: Callable[[], bool] | None = None,
        admits: Callable[[bytes], bool] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__("gr-ros2-airtime", "gr_ros2_airtime_gate", None, None)
        self._airtime_of = None if airtime_of is None else lru_cache(maxsize=None)(airtime_of)
        self._clock: AirtimeClock[Any] = AirtimeClock(
            airtime, LEAD_S, ahead, limit, measured=True, timed=timed, listens=listens, ready=ready
        )
        self._admits, self._at_once = admits, airtime == 0 and limit is None and admits is None
        self._now = clock
        self._left = 0
        """Packets that have passed or are about to."""
        self.passed = 0
        self.lateness = Lateness()
        self.looks_at = inf
        self.looks: Callable[[], None] | None = None
        self.arrived = 0
        """Packets that have come."""
        self._port, self._credits = PduPort(self), CreditPort(self)
        self.passes_on_to = self._port
        take_messages(self, "pdus", "_arrive", called="take")

    @property
    def backlog(self) -> int:
        """Packets that wait for the channel or occupy it."""
        return self._clock.backlog

    def at_rest(self) -> int | None:
        """How many packets have passed; None while one is due."""
        with self._lock:
            due = self._clock.first_due
            return None if due is not None and due <= self._now() else self._left

    @property
    def transmits(self) -> bool:
        """Whether packets may pass."""
        return self._clock.transmits

    def transmit(self, *, on: bool) -> None:
        """Switch sending off, at once for all packets that have not reached the device, or on again."""
        with self._lock:
            self._clock.switch(on=on)
        self._look_now()

    def account(self) -> dict[str, Any]:
        """Whether it sends, s of airtime sent since the start, packets refused by reason; with a limit also the s sent
        in its window, the s allowed, the window, how often the account could not be stored, and whether it is now."""
        with self._lock:
            clock, limit = self._clock, self._clock.limit
            told = {"transmits": clock.transmits, "sent_s": clock.used, "refused": dict(clock.refused)}
            told["deferred"] = clock.deferred
            if limit is None:
                return told
            now = self._now()
            return told | {
                "spent_s": limit.spent(now),
                "allowed_s": limit.budget,
                "window_s": limit.rule.window_s,
                "waits_s": max(limit.earliest(now, 0.0) - now, 0.0),
                "unsaved": limit.unsaved,
                "stored": limit.stored,
            }

    def stalled_s(self) -> float:
        """s for which its thread has been at one thing, or asleep beyond the time at which it meant to look again;
        infinite if it has ended, 0 where it has none. Takes no lock."""
        if not self._running or self.looks is not None:
            return 0.0
        return max(0.0, self._now() - self.looks_at) if self._thread.alive else inf

    def start(self) -> bool:
        self._port.find_readers()
        self._credits.find_readers()
        self.looks_at = self._now()
        if self.looks is None:
            return super().start()
        self._running = True
        self.looks()
        return True

    def take(self, packets: Sequence[AirPacket]) -> None:
        """Packets have come."""
        for packet in packets:
            self._offer(packet, packet)
        self._look()

    def _arrive(self, pdu: Any) -> None:
        packets, problem = packets_of(pdu)
        if problem:
            self._clock.refused[problem] += 1
        for packet in packets:
            self._offer(packet, packet if self._port.direct else pdu)
        self._look()

    def _offer(self, packet: AirPacket, passed_on: Any) -> None:
        airtime = None if self._airtime_of is None else self._airtime_of(len(packet.data), packet.mcs or 0)
        admitted = self._admits is None or self._admits(packet.data)
        with self._lock:
            if admitted:
                self._clock.offer(passed_on, self._now(), airtime, packet.leave_at)
            else:
                self._clock.refused["not_sealed"] += 1
            self.arrived += 1

    def _look(self) -> None:
        """Packets have come: those that take no time pass at once, of others its thread looks when."""
        if self._at_once:
            with self._lock:
                passed = self._clock.due(self._now())
                self._left += len(passed)
            self._pass(passed)
        self._look_now()

    def _look_now(self) -> None:
        """Something has changed: have the thread look again."""
        with self._lock:
            self.looks_at = min(self.looks_at, self._now())
            if self.looks is None:
                self._changed.notify_all()
        if self.looks is not None:
            self.looks()

    def _pass(self, passed: list[tuple[float, Any]]) -> None:
        if self._port.direct:
            # What takes no time on the air does not begin at a time either.
            self._port.send([one if self._at_once else one._replace(at=begins_at) for begins_at, one in passed])
        else:
            for begins_at, pdu in passed:
                self._port.send_pdu(pdu if self._at_once else with_begin(pdu, begins_at))
        self.passed += len(passed)

    def run(self) -> None:
        while self._running:
            self.step()
            with self._lock:
                now, at = self._now(), self.looks_at
                if self._running and at > now:
                    self._changed.wait(wait_until_s(at, now))

    def step(self) -> None:
        """Let the packets pass and give the credits that are due, and set ``looks_at``. One thread calls this."""
        with self._lock:
            if not self._running:
                self.looks_at = inf
                return
            clock, now = self._clock, self._now()
            due = clock.first_due
            passed, credits = clock.due(now), clock.grants(now)
            self._left += len(passed)
            if passed and due is not None:
                self.lateness.happened(due, now)
            free = inf if clock.held else clock.free
            at = clock.next_timeout(now)
            self.looks_at = inf if at is None else max(at, now)
        self._pass(passed)
        if credits:
            self._credits.grant(credits, free)
