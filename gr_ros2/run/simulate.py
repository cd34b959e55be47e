"""A scenario without threads and waiting: the link's engines on a clock that jumps from event to event.

Version 0 tells its sender nothing of the receiver, so a run is three stages behind one another: what the sender puts on
the air and when (:class:`Transmission`), what the air makes of it (an :data:`Air`), and what the receiver makes of that
(:class:`Reception`). What the computer takes (middleware, Python, signal processing) is one constant, ``overhead_s``, 0
unless given. Laws: the same scenario gives the same numbers; packets go one after the other, each for its airtime, so
no message completes before all its packets have been on the air; the ledger hears both ends in the order of time.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import inf
from typing import Any

from gr_ros2.errors import BagError, ConfigError
from gr_ros2.gr.ends import message_codec
from gr_ros2.link import Receiver, Sender, SenderEvent, SenderStats, SentPacket
from gr_ros2.link.airtime import AirtimeClock
from gr_ros2.link.codec import MessageCodec
from gr_ros2.link.losses import PduLosses
from gr_ros2.link.observe import LinkObserver
from gr_ros2.link.receiver import ReceiverStats
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.phy import Phy
from gr_ros2.record.recorder import Recorder
from gr_ros2.record.result import TopicResult
from gr_ros2.registry import Registry
from gr_ros2.run.load import make_phy, recorded_names, source_names
from gr_ros2.run.scenario import Scenario
from gr_ros2.sim.fleet import Fleet, SimMessage
from gr_ros2.sim.settings import SimSettings

_LONGEST_GAP_S = 30 * 86400.0
"""s between two neighbouring messages of a recording. A longer one is a stamp that was never set, and the link would be
computed over all of it: 30 years where the first stamp is 0."""
_REMEMBERED_S = 60.0
"""Of two robots with all their topics that is 5 MB."""


@dataclass(frozen=True, slots=True)
class Offered:
    """A message handed to the source ``t`` s after the start."""

    t: float
    topic_id: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Landed:
    """A packet whose airtime was over at ``now``, s after the start."""

    data: bytes
    now: float


Step = SenderEvent | Landed
"""What happens at the sending end and on the air, in the order of time."""
Air = Callable[[Iterable[Step]], Iterable[Step]]
"""Takes away the packets that do not come through; everything else stays as it is, in its order."""


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
    :raises BagError: for one whose times leap by more than 30 days
    """
    if scenario.bag_path is None:
        names = source_names(scenario, registry)
        for sent in _simulated(scenario.sim, scenario.duration_s, frozenset(names)):
            yield Offered(sent.t, names[sent.topic], sent.payload)
        return
    if not scenario.bag_speed:
        raise ConfigError("bag_speed = 0: a recording as fast as the link takes it cannot be simulated; set it above 0")
    names = recorded_names(scenario, registry)
    first = last = None
    for message in read_bag(scenario.bag_path, names):
        first = message.stamp_ns if first is None else first
        t = (message.stamp_ns - first) * 1e-9 / scenario.bag_speed
        if scenario.duration_s and t >= scenario.duration_s:
            return
        gap = 0.0 if last is None else (message.stamp_ns - last) * 1e-9
        if gap > _LONGEST_GAP_S:
            raise BagError(
                f"bag {scenario.bag_path}: a message on {message.topic} was recorded {gap / 86400:.0f} days after the "
                "one before it; cut the recording there, or set duration_s to end before it"
            )
        last = message.stamp_ns
        yield Offered(t, names[message.topic], message.payload)


def _simulated(settings: SimSettings, duration_s: float, topics: frozenset[str]) -> Iterable[SimMessage]:
    """The simulator's messages; those of short runs are remembered, since a sweep wants them again and again."""
    if duration_s <= _REMEMBERED_S:
        return _remembered(settings, duration_s, topics)
    return Fleet(settings).messages(duration_s, topics=topics)


@lru_cache(maxsize=4)
def _remembered(settings: SimSettings, duration_s: float, topics: frozenset[str]) -> tuple[SimMessage, ...]:
    return tuple(Fleet(settings).messages(duration_s, topics=topics))


def simulate(
    scenario: Scenario,
    *,
    phy: Phy | None = None,
    messages: Iterator[Offered] | None = None,
    codec: MessageCodec | None = None,
    on_packet: Callable[[SentPacket], None] | None = None,
    overhead_s: float = 0.0,
) -> Simulated:
    """Run a scenario on its link's engines. Of the channel, what loses whole packets takes part.

    :param phy: None makes the scenario's
    :param messages: in time order; None takes the scenario's source
    :param codec: of both ends; None makes it where ``compression`` is on
    :param on_packet: called with every packet that leaves the source
    :param overhead_s: s from the end of a packet's airtime to the republication of what it completes
    :raises ConfigError: when the scenario cannot be set up, or has no times (pace ``flow``)
    """
    registry = scenario.load_registry()
    phy = phy or make_phy(scenario, registry)
    src_id = scenario.ros_source.src_id()
    topics = {src_id: source_names(scenario, registry).values()}
    recorder = Recorder(registry, {src_id: scenario.ros_source.namespace}, topics)
    sending = Transmission(scenario, registry, phy.airtime(), codec)
    receiving = Reception(scenario, registry, recorder, codec, overhead_s)
    for step in drop_packets(sending.steps(messages or offered(scenario, registry)), PduLosses(scenario.channel)):
        receiving.take(step)
        if on_packet is not None and isinstance(step, SentPacket):
            on_packet(step)
    receiving.wait_until(sending.end)
    return Simulated(
        duration_s=sending.duration_s,
        airtime_s=phy.airtime(),
        topics=recorder.finish(sending.duration_s, sending.duration_s, sending.empty),
        packets=recorder.ledger.packets(),
        stats=sending.stats,
        recorder=recorder,
    )


def drop_packets(steps: Iterable[Step], losses: PduLosses) -> Iterator[Step]:
    """The steps without the packets that are lost whole."""
    for step in steps:
        if not isinstance(step, Landed) or losses.passes(step.now):
            yield step


class Transmission:
    """The sending end and its turn on the air.

    :param airtime: of one packet, s; 0 for a PHY without samples
    :param codec: None makes it where ``compression`` is on
    :raises ConfigError: for pace ``flow``, which has no times
    """

    def __init__(
        self, scenario: Scenario, registry: Registry, airtime: float, codec: MessageCodec | None = None
    ) -> None:
        if scenario.pace != "airtime":
            raise ConfigError(f"pace = {scenario.pace!r}: only pace airtime can be simulated")
        self._steps: list[Step] = []
        self._sender = Sender(
            registry,
            scenario.ros_source,
            codec=codec or message_codec(scenario.ros_source, registry),
            rng=random.Random(scenario.seed),
            observer=self._steps.append,
        )
        self._clock: AirtimeClock[bytes] | None = AirtimeClock(airtime) if airtime else None
        self._paced = scenario.paced and self._clock is not None
        self._drain = scenario.drain_s
        self._until = scenario.duration_s
        self.duration_s = scenario.duration_s
        """s during which messages were offered; where the scenario leaves that to its bag, known at the end."""
        self.end = 0.0
        """s, when the run was over."""

    @property
    def stats(self) -> SenderStats:
        """The sender's counters."""
        return self._sender.stats

    @property
    def empty(self) -> bool:
        """Whether nothing waits at the sender or for the air."""
        return self._sender.idle and not (self._clock and self._clock.backlog)

    def steps(self, messages: Iterator[Offered]) -> Iterator[Step]:
        """Everything that happens, until nothing is left or the time to drain is over. Once."""
        coming = next(messages, None)
        now = 0.0
        if self._paced:
            self._sender.use_credit()
        while now < inf:
            self.end = now
            self._let_through(now)
            while coming is not None and coming.t <= now:
                self._sender.submit(coming.topic_id, coming.payload, now)
                if not self._until:
                    self.duration_s = now
                coming = next(messages, None)
            self._send(now)
            yield from self._steps
            self._steps.clear()
            if coming is None and now >= self.duration_s and self.empty:
                break
            now = max(now, self._next(now, inf if coming is None else coming.t))
            if coming is None and now > self.duration_s + self._drain:
                break

    def _let_through(self, now: float) -> None:
        if self._clock is not None:
            self._steps += (Landed(data, now) for data in self._clock.due(now))
            credits = self._clock.grants(now)
            if self._paced:
                self._sender.credit(credits)

    def _send(self, now: float) -> None:
        while (data := self._sender.next_packet(now)) is not None:
            if self._clock is not None:
                self._clock.offer(data, now)
            else:
                self._steps.append(Landed(data, now))

    def _next(self, now: float, coming: float) -> float:
        clock = self._clock.next_timeout(now) if self._clock is not None else None
        times = (coming, clock, self._sender.next_timeout())
        soonest = min((at for at in times if at is not None), default=inf)
        # Nothing more to come before the end of the run: the receiver may still be waiting.
        return self.duration_s if soonest == inf and now < self.duration_s else soonest


class Reception:
    """The receiving end, and who hears of both.

    :param ears: hears every event of both ends, in the order of time
    :param codec: None makes it where ``compression`` is on
    :param overhead_s: s from the end of a packet's airtime to the republication of what it completes
    """

    def __init__(
        self,
        scenario: Scenario,
        registry: Registry,
        ears: LinkObserver,
        codec: MessageCodec | None = None,
        overhead_s: float = 0.0,
    ) -> None:
        self._src_id = scenario.ros_source.src_id()
        self._receiver = Receiver(
            registry, scenario.ros_sink, codec=codec or message_codec(scenario.ros_sink, registry)
        )
        self._ears = ears
        self._overhead = overhead_s

    @property
    def stats(self) -> ReceiverStats:
        """The receiver's counters."""
        return self._receiver.stats

    def take(self, step: Step) -> None:
        """One step, no earlier than the one before."""
        if isinstance(step, Landed):
            self.wait_until(step.now)
            self._ears.packet_received(step.data, step.now)
            for event in self._receiver.receive(step.data, step.now):
                self._ears.receiver_event(event, step.now + self._overhead)
        else:
            self._ears.sender_event(self._src_id, step)

    def wait_until(self, now: float) -> None:
        """Give up what has waited too long by then."""
        while (at := self._receiver.next_timeout()) is not None and at < now:
            for event in self._receiver.handle_timeout(at):
                self._ears.receiver_event(event, at + self._overhead)
