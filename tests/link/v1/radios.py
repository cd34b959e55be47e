"""Robots with several radios each, for tests: endpoints, bonds and gates in simulated time, without threads.

A packet takes its airtime, and then as long as threads and sockets may take: exponentially distributed, on each radio
in order.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from math import inf
from typing import Any

from gr_ros2.link import AirPacket, SentPacket
from gr_ros2.link.airtime import AirtimeClock
from gr_ros2.link.bond import Bond
from gr_ros2.link.events import Delivered, Lost, ReceiverEvent
from gr_ros2.settings.registry import Registry
from gr_ros2.wire import QOS_LATENCY
from tests.link.v1.air import Robot

LOOK_S = 2e-4
"""s between two looks at everything at least, as threads sleep so long."""


class Station(Robot):
    """A robot with radios.

    :param rates: bytes/s of each
    :ivar came: what became of messages of others, with the time, s
    """

    def __init__(self, src_id: int, topics: Registry | None, rates: Sequence[float], **settings: Any) -> None:
        super().__init__(src_id, topics, **{"radios": len(rates), "packet_len": 220, "any_length": True, **settings})
        self.rates = tuple(rates)
        self.came: list[tuple[float, Delivered | Lost]] = []
        self.switch_on()

    def switch_on(self) -> None:
        """Its radios start anew, without what they had under way."""
        airtimes = [self.settings.packet_len / rate for rate in self.rates]
        self.bond = Bond(airtimes)
        self.gates = [AirtimeClock[bytes](airtime) for airtime in airtimes]

    def step(self, now: float) -> list[tuple[int, bytes]]:
        """What its radios have sent until now: radio and bytes."""
        self._take(self.end.handle_timeout(now), now)
        for radio, gate in enumerate(self.gates):
            if granted := gate.grants(now):
                self.end.pace.credit(self.bond.ask(radio, granted))
        self.end.pace.credit(self.bond.asks())
        while (sent := self.end.next_packet(now)) is not None:
            for radio in self.bond.leave(everywhere=self._everywhere(sent)):
                self.gates[radio].offer(sent.data, now, len(sent.data) / self.rates[radio])
        return [(radio, data) for radio, gate in enumerate(self.gates) for _, data in gate.due(now)]

    def hear(self, radio: int, data: bytes, now: float) -> None:
        """A packet has come over a radio."""
        if self.bond.arrive(radio, data):
            self._take(self.end.receive(AirPacket(data), now), now)

    def next(self, now: float) -> float:
        """When :meth:`step` has something to do, s."""
        times = [gate.next_timeout(now) for gate in self.gates]
        times += [self.end.next_departure(), self.end.next_timeout()]
        return min((at for at in times if at is not None), default=inf)

    def payloads(self, topic_id: int, since: float = 0.0) -> list[bytes]:
        """What was delivered of a topic."""
        events = [event for at, event in self.came if at >= since and event.topic_id == topic_id]
        return [event.payload for event in events if isinstance(event, Delivered)]

    def _everywhere(self, sent: SentPacket) -> bool:
        """Whether a packet leaves over all radios, as :class:`gr_ros2.gr.radio_ports.RadioPorts` has it."""
        return sent.kind in ("hello", "report") or sent.packet.qos == QOS_LATENCY

    def _take(self, events: Iterable[ReceiverEvent], now: float) -> None:
        self.bond.note(events)
        self.came += [(now, event) for event in events if isinstance(event, Delivered | Lost)]


class Radios:
    """The air between stations: their radios of one number hear each other.

    :param jitter_s: mean of what a packet takes beside its airtime, s
    :ivar lost: whether a packet of a station over a radio does not come
    """

    def __init__(self, *stations: Station, jitter_s: float = 0.001, seed: int = 1) -> None:
        self.stations, self.jitter_s, self.rng = stations, jitter_s, random.Random(seed)
        self.now = 0.0
        self.lost: Callable[[Station, int], bool] = lambda _station, _radio: False
        self._under_way: dict[tuple[Station, int], deque[tuple[float, bytes]]] = {}
        """By receiver and radio: when each packet comes, s."""
        self._doing: list[tuple[float, Callable[[], None]]] = []

    def every(self, period_s: float, do: Callable[[int], Any]) -> None:
        """Do something again and again from now on, with numbers from 0 on."""
        numbers, begin = count(), self.now

        def again() -> None:
            number = next(numbers)
            do(number)
            self._doing.append((begin + (number + 1) * period_s, again))

        self._doing.append((begin, again))

    def run(self, seconds: float) -> None:
        """So long."""
        end = self.now + seconds
        while self.now < end:
            due, self._doing = [e for e in self._doing if e[0] <= self.now], [e for e in self._doing if e[0] > self.now]
            for _, do in due:
                do()
            for (station, radio), line in self._under_way.items():
                while line and line[0][0] <= self.now:
                    station.hear(radio, line.popleft()[1], self.now)
            for station in self.stations:
                for radio, data in station.step(self.now):
                    self._send(station, radio, data)
            times = [line[0][0] for line in self._under_way.values() if line] + [at for at, _ in self._doing]
            self.now = max(min([*times, *(each.next(self.now) for each in self.stations)]), self.now + LOOK_S)

    def _send(self, by: Station, radio: int, data: bytes) -> None:
        at = self.now + self.rng.expovariate(1 / self.jitter_s)
        for station in self.stations:
            if station is not by and radio < len(station.gates) and not self.lost(by, radio):
                line = self._under_way.setdefault((station, radio), deque())
                line.append((max(at, line[-1][0] if line else at), data))
