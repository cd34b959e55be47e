"""A scenario without flowgraph, threads and waiting: the link's engines on a clock that jumps from event to event.

What the computer takes (middleware, Python, signal processing) is one constant, ``overhead_s``, 0 unless given. Laws:
the same scenario gives the same numbers; the PHY is its airtime, one packet after the other, so no message completes
before all its packets have been on the air; of the channel, ``packet_loss`` alone takes part.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf
from typing import Any

from gr_ros2.errors import ConfigError
from gr_ros2.experiment.load import make_phy, source_names
from gr_ros2.experiment.recorder import Recorder
from gr_ros2.experiment.result import TopicResult
from gr_ros2.experiment.scenario import Scenario
from gr_ros2.gr.ends import message_codec
from gr_ros2.link import Receiver, ReceiverEvent, Sender, SenderEvent, SenderStats, SentPacket
from gr_ros2.link.airtime import AirtimeClock
from gr_ros2.link.codec import MessageCodec
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.phy import Phy
from gr_ros2.registry import Registry
from gr_ros2.sim.fleet import Fleet


@dataclass(frozen=True, slots=True)
class Offered:
    """A message handed to the source ``t`` s after the start."""

    t: float
    topic_id: int
    payload: bytes


@dataclass(frozen=True)
class Simulated:
    """What came out.

    :param duration_s: s during which messages were offered
    :param airtime_s: of one packet, s; 0 for a PHY without samples
    :param packets: as in ``result.json``
    """

    duration_s: float
    airtime_s: float
    topics: tuple[TopicResult, ...]
    packets: dict[str, Any]
    stats: SenderStats
    recorder: Recorder


def offered(scenario: Scenario, registry: Registry) -> Iterator[Offered]:
    """What the scenario's source gives to the link, in time order.

    :raises ConfigError: for a recording played as fast as the link takes it, which has no times
    """
    names = source_names(scenario, registry)
    if scenario.bag_path is None:
        for sent in Fleet(scenario.sim).messages(scenario.duration_s):
            if sent.topic in names:
                yield Offered(sent.t, names[sent.topic], sent.payload)
        return
    if not scenario.bag_speed:
        raise ConfigError("bag_speed = 0: a recording as fast as the link takes it cannot be simulated; set it above 0")
    first = None
    for message in read_bag(scenario.bag_path, names):
        first = message.stamp_ns if first is None else first
        t = (message.stamp_ns - first) * 1e-9 / scenario.bag_speed
        if scenario.duration_s and t >= scenario.duration_s:
            return
        yield Offered(t, names[message.topic], message.payload)


def simulate(
    scenario: Scenario,
    *,
    phy: Phy | None = None,
    messages: Iterator[Offered] | None = None,
    codec: MessageCodec | None = None,
    on_packet: Callable[[SentPacket], None] | None = None,
    overhead_s: float = 0.0,
) -> Simulated:
    """Run a scenario on its link's engines, as long as it asks for.

    :param phy: None makes the scenario's
    :param messages: in time order; None takes the scenario's source
    :param codec: of both ends; None makes it where ``compression`` is on
    :param on_packet: called with every packet that leaves the source
    :param overhead_s: s from the end of a packet's airtime to the republication of what it completes
    :raises ConfigError: when the scenario cannot be set up, or has no times (pace ``flow``)
    """
    if scenario.pace != "airtime":
        raise ConfigError(f"pace = {scenario.pace!r}: only pace airtime can be simulated")
    registry = scenario.load_registry()
    phy = phy or make_phy(scenario, registry)
    simulation = _Simulation(
        scenario,
        registry=registry,
        airtime=phy.airtime(),
        codec=codec,
        on_packet=on_packet,
        overhead_s=overhead_s,
    )
    return simulation.run(messages if messages is not None else offered(scenario, registry))


class _Simulation:
    def __init__(
        self,
        scenario: Scenario,
        *,
        registry: Registry,
        airtime: float,
        codec: MessageCodec | None,
        on_packet: Callable[[SentPacket], None] | None,
        overhead_s: float,
    ) -> None:
        source, sink = scenario.ros_source, scenario.ros_sink
        self._src_id = source.src_id()
        self._on_packet = on_packet
        self._overhead = overhead_s
        self._scenario = scenario
        self._airtime = airtime
        self._recorder = Recorder(registry, {self._src_id: source.namespace}, source_names(scenario, registry).values())
        self._sender = Sender(
            registry,
            source,
            codec=codec or message_codec(source, registry),
            rng=random.Random(scenario.seed),
            observer=self._sent,
        )
        self._receiver = Receiver(registry, sink, codec=codec or message_codec(sink, registry))
        self._clock: AirtimeClock[bytes] | None = AirtimeClock(airtime) if airtime else None
        self._paced = scenario.paced and self._clock is not None
        self._loss = random.Random(scenario.channel.seed)

    def run(self, messages: Iterator[Offered]) -> Simulated:
        duration = self._scenario.duration_s
        coming = next(messages, None)
        now = 0.0
        if self._paced:
            self._sender.use_credit()
        while now < inf:
            self._let_through(now)
            while coming is not None and coming.t <= now:
                self._sender.submit(coming.topic_id, coming.payload, now)
                if not self._scenario.duration_s:
                    duration = now
                coming = next(messages, None)
            self._send(now)
            if coming is None and now >= duration and self._empty():
                break
            now = max(now, self._next(now, inf if coming is None else coming.t))
            if coming is None and now > duration + self._scenario.drain_s:
                break
        return Simulated(
            duration_s=duration,
            airtime_s=self._airtime,
            topics=self._recorder.finish(duration, duration, self._empty()),
            packets=self._recorder.ledger.packets(),
            stats=self._sender.stats,
            recorder=self._recorder,
        )

    def _sent(self, event: SenderEvent) -> None:
        self._recorder.sender_event(self._src_id, event)
        if self._on_packet is not None and isinstance(event, SentPacket):
            self._on_packet(event)

    def _let_through(self, now: float) -> None:
        """Packets whose airtime is over arrive; what has waited too long is given up."""
        if self._clock is not None:
            for data in self._clock.due(now):
                self._arrive(data, now)
            credits = self._clock.grants(now)
            if self._paced:
                self._sender.credit(credits)
        self._note(self._receiver.handle_timeout(now), now)

    def _send(self, now: float) -> None:
        while (data := self._sender.next_packet(now)) is not None:
            if self._clock is not None:
                self._clock.offer(data, now)
            else:
                self._arrive(data, now)

    def _arrive(self, data: bytes, now: float) -> None:
        if self._loss.random() < self._scenario.channel.packet_loss:
            return
        self._recorder.packet_received(data, now)
        self._note(self._receiver.receive(data, now), now)

    def _note(self, events: list[ReceiverEvent], now: float) -> None:
        for event in events:
            self._recorder.receiver_event(event, now + self._overhead)

    def _empty(self) -> bool:
        return self._sender.idle and not (self._clock and self._clock.backlog)

    def _next(self, now: float, coming: float) -> float:
        clock = self._clock.next_timeout(now) if self._clock is not None else None
        times = (coming, clock, self._sender.next_timeout(), self._receiver.next_timeout())
        return min((at for at in times if at is not None), default=inf)
