"""One radio channel that the IP packets of several robots share, with a medium access that costs nothing.

Invariants: the robots that have a packet are served in turn, one packet each, without collision and without a gap, and
every packet occupies the channel for its airtime. A packet for several robots is sent once, and each of them loses it
or not by itself; a packet for one robot occupies the channel alike. Each robot's packets wait in a queue bounded in
bytes, which drops and counts what does not fit.
"""

from __future__ import annotations

import select
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import ExitStack
from ipaddress import IPv4Address

from gr_ros2.core.closing import Closing
from gr_ros2.link.losses import PduLosses
from gr_ros2.phy.threads import shorten_switch_interval
from gr_ros2_lab.race.contenders import MTU, address_of
from gr_ros2_lab.race.links import LinkLog, LinkReport, RaceRadio
from gr_ros2_lab.race.tun import QUEUE_BYTES, Tun, shared_air

_POLL_S = 0.05
_IP_PROTOCOL, _IP_TO = 9, slice(16, 20)
"""Places in an IPv4 header: of the protocol, and of the address to which the packet goes."""
_IGMP = 2


class RaceChannel(Closing):
    """A TUN device in each namespace, and the channel between them.

    :param namespaces: paths of the robots' namespaces
    :raises GrRos2Error: when a part does not start
    """

    def __init__(self, radio: RaceRadio, namespaces: Sequence[str]) -> None:
        robots = range(len(namespaces))
        self._airtimes = [radio.airtime_s(length) for length in range(MTU + 1)]
        self._losses = {
            (sender, receiver): PduLosses(radio.channel(len(robots) * sender + receiver))
            for sender in robots
            for receiver in robots
        }
        self._places = {IPv4Address(address_of(number)).packed: number for number in robots}
        self._queues: list[deque[bytes]] = [deque() for _ in robots]
        self._waiting = [0] * len(robots)
        self._log, self._drops = LinkLog(), Counter[str]()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gr-ros2-channel", daemon=True)
        with ExitStack() as stack:
            self._tuns: list[Tun] = []
            for number, namespace in enumerate(namespaces):
                self._tuns.append(Tun(namespace, shared_air(address_of(number), mtu=MTU)))
                stack.callback(self._tuns[-1].close)
            shorten_switch_interval()
            self._thread.start()
            stack.callback(self._end)
            self._stack = stack.pop_all()

    def report(self) -> LinkReport:
        """The traffic on the air so far. There is no way back: all robots are on one channel."""
        lost = sum(losses.dropped.total() for losses in self._losses.values())
        return LinkReport(self._log, LinkLog(), {**self._drops, "on_air": lost})

    def _run(self) -> None:
        free, last = time.monotonic(), 0
        robots = len(self._tuns)
        while not self._over.is_set():
            self._take(0.0)
            if not any(self._queues):
                self._take(_POLL_S)
                free = max(free, time.monotonic())
                continue
            last = next(
                number % robots for number in range(last + 1, last + 1 + robots) if self._queues[number % robots]
            )
            packet = self._queues[last].popleft()
            self._waiting[last] -= len(packet)
            airtime = self._airtimes[len(packet)]
            free += airtime
            if self._over.wait(max(0.0, free - time.monotonic())):
                return
            self._log.note(free, len(packet), airtime)
            self._deliver(last, packet)

    def _take(self, timeout_s: float) -> None:
        """Queue what the robots have sent."""
        for tun in select.select(self._tuns, [], [], timeout_s)[0]:
            number = self._tuns.index(tun)
            while (packet := tun.read(0)) is not None:
                if packet[_IP_PROTOCOL] == _IGMP:  # nobody on this channel routes multicast
                    continue
                if self._waiting[number] + len(packet) > QUEUE_BYTES:
                    self._drops["queue_full"] += 1
                    continue
                self._queues[number].append(packet)
                self._waiting[number] += len(packet)

    def _deliver(self, sender: int, packet: bytes) -> None:
        place = self._places.get(packet[_IP_TO])
        now = time.monotonic()
        for number in range(len(self._tuns)) if place is None else (place,):
            if number != sender and self._losses[sender, number].passes(now):
                try:
                    self._tuns[number].write(packet)
                except OSError:
                    self._drops["not_taken"] += 1

    def _end(self) -> None:
        self._over.set()
        self._thread.join()

    def close(self) -> None:
        """Stop the channel and remove the interfaces."""
        self._stack.close()
