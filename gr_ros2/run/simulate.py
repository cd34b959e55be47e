"""Discrete-event simulation of a scenario, without threads and waiting: the clock jumps from event to event.

An event loop (:class:`EventLoop`) serves both ends of the link and the directions between them
(:class:`LinkDirection`). It asks an end for packets when the end may have one. A packet is on the air for its airtime.
Then the other end receives it and may send in response. The time that the computer takes (middleware, Python, signal
processing) is one constant, ``overhead_s``, 0 by default.

Invariants: the same scenario gives the same numbers; the packets of a direction are sent one after the other, each for
its airtime, so no message is complete before all its packets have been on the air; events are reported in the order of
time.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf
from typing import Any, NamedTuple

from gr_ros2.errors import BagError, ConfigError, RunError
from gr_ros2.gr.ends import Start, make_endpoint
from gr_ros2.link import Delivered, ReceiverEvent, SenderEvent, SenderStats, SentPacket
from gr_ros2.link.airtime import AirtimeClock
from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.losses import PduLosses
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.observe import LinkObserver
from gr_ros2.link.rate import Rung
from gr_ros2.link.v1.endpoint_settings import robot_of
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.phy import Phy
from gr_ros2.record.recorder import Recorder
from gr_ros2.record.result import TopicResult
from gr_ros2.registry import Registry
from gr_ros2.run.ends import Halves, halves_of_ends, start_of_run
from gr_ros2.run.load import make_phy, recorded_names, source_names
from gr_ros2.run.scenario import Scenario
from gr_ros2.sim.fleet import Fleet, SimMessage
from gr_ros2.sim.sim_settings import SimSettings

_LONGEST_GAP_S = 30 * 86400.0
"""s between two consecutive messages of a recording. A longer gap means that a stamp was never set. The link would be
simulated for all of the gap: decades where the first stamp is 0."""
_IN_VAIN = 1000
"""Steps in a row without an event at one time after which a simulation is said to stand still."""
_REMEMBERED_S = 60.0
"""Simulated messages of runs up to this long are cached: 5 MB for two robots with all their topics."""


@dataclass(frozen=True, slots=True)
class Offered:
    """A message handed to the source ``t`` s after the start."""

    t: float
    topic_id: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class AirtimeEnded:
    """A packet whose airtime is over. Whether it arrives is decided later.

    :param rung: with an adaptive rate, the rung that it was sent with
    """

    data: bytes
    rung: int = 0


class Arrival(NamedTuple):
    """A packet that came out of a receiver.

    :param snr_db: as the receiver measured it, dB; None where that is not simulated
    """

    data: bytes
    snr_db: float | None = None


TimedEvent = tuple[float, "LinkDirection | Branch", SenderEvent | ReceiverEvent | AirtimeEnded]
"""Time of the event, s after the start; its direction or further receiver; and the event itself."""
Airtime = Callable[[int | None, int], float]
"""s that a packet of this many bytes, sent with this rung, is on the air; None stands for the longest packet."""
Medium = Callable[[AirtimeEnded, float], Iterable[Arrival]]
"""From a packet whose airtime is over, and the time now, to the packets that come out of the receiver."""


@dataclass(frozen=True)
class Simulated:
    """The result of a simulation.

    :param duration_s: s during which messages were offered
    :param airtime_s: of the longest packet, s; 0 for a PHY without airtime
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

    :raises ConfigError: for a recording played as fast as the link takes it, because its messages have no times
    :raises BagError: for a recording whose times jump by more than 30 days
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
    """The simulator's messages. Those of short runs are cached, because a sweep needs them many times."""
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
    """Run a scenario on its link's engines. Only those settings of the channel that lose whole packets have an effect.

    :param phy: None makes the scenario's
    :param messages: in time order; None takes the scenario's source
    :param codec: of both ends; None makes one
    :param on_packet: called with every packet that leaves the source
    :param overhead_s: s from the end of a packet's airtime to the republication of what it completes
    :raises ConfigError: when the scenario cannot be set up, or has no times (time ``unthrottled``)
    """
    registry = scenario.load_registry()
    phy = phy or make_phy(scenario, registry)
    src_id = scenario.ros_source.src_id()
    topics = {src_id: source_names(scenario, registry).values()}
    recorder = Recorder(registry, {src_id: scenario.ros_source.namespace}, topics)
    losses = PduLosses(scenario.channel)
    if phy.ladder:
        raise ConfigError("rate = 'adaptive': a forecast has one rate; set phy.options.rate to fixed")
    ends = make_ends([scenario], registry, codec, any_length=phy.any_length)
    way = LinkDirection(scenario, (ends[0], ends[1]), phy.airtime, messages or offered(scenario, registry))
    way.air = lambda packet, now: [Arrival(packet.data)] if losses.passes(now) else ()
    ways = [way]
    if scenario.reports is not None:
        heard = PduLosses(scenario.reports.channel)
        back: Medium = lambda packet, now: [Arrival(packet.data)] if heard.passes(now) else ()  # noqa: E731
        ways += report_ways(scenario, ends[:2], phy.airtime, [back])
    for timed_event in EventLoop(ways).run():
        pass_on(recorder, timed_event, overhead_s)
        if on_packet is not None and isinstance(timed_event[2], SentPacket):
            on_packet(timed_event[2])
    return Simulated(
        duration_s=way.duration_s,
        airtime_s=phy.airtime(),
        topics=recorder.finish(way.duration_s, way.duration_s, way.empty),
        packets=recorder.ledger.packets(),
        stats=way.sender.endpoint.sent,
        recorder=recorder,
    )


def pass_on(observer: LinkObserver, timed_event: TimedEvent, overhead_s: float = 0.0) -> None:
    """Pass an event on to an observer."""
    now, way, event = timed_event
    if isinstance(event, SenderEvent):
        observer.sender_event(way.src_id, event)
    elif isinstance(event, ReceiverEvent):
        observer.receiver_event(event, now + overhead_s if isinstance(event, Delivered) else now)


@dataclass(frozen=True)
class End:
    """One robot's end of the link.

    :param events: events of its sending half that have not been reported yet
    :param src_id: -1 for none
    """

    endpoint: Endpoint
    events: list[SenderEvent]
    src_id: int = -1


def make_ends(
    ways: Sequence[Scenario],
    registry: Registry,
    codec: MessageCodec | None = None,
    *,
    any_length: bool = False,
    ladder: Sequence[Rung] = (),
) -> list[End]:
    """The ends of a link, see :func:`gr_ros2.run.ends.halves_of_ends`.

    :param ways: one scenario per direction
    :param codec: of all messages; None makes one
    :param any_length: whether the PHY carries shorter packets in less time
    :param ladder: the rungs of an adaptive rate; () for a fixed rate
    """
    start = start_of_run(ways, any_length=any_length, ladder=ladder)
    return [_end(registry, halves, codec, start, ways[0].seed) for halves in halves_of_ends(ways)]


def _end(registry: Registry, halves: Halves, codec: MessageCodec | None, start: Start, seed: int) -> End:
    events: list[SenderEvent] = []
    rng = None if halves[0] is None else random.Random(seed)
    endpoint = make_endpoint(registry, *halves, start=start, codec=codec, rng=rng, observer=events.append)
    return End(endpoint, events, robot_of(*halves))


class Branch:
    """A further end that receives the packets of a direction.

    :param air: decides what arrives at this end
    :param number: of this end among the further receivers of the same sender, from 1
    """

    def __init__(self, way: LinkDirection, receiver: End, air: Medium, number: int) -> None:
        self.src_id = way.src_id
        self.receiver = receiver
        self.air = air
        self.number = number

    def arrive(self, arrival: Arrival, now: float) -> Iterator[TimedEvent]:
        """Give the end a packet that has arrived there."""
        for event in self.receiver.endpoint.receive(arrival.data, now, arrival.snr_db):
            yield now, self, event


class LinkDirection:
    """One direction of a link: the messages offered to the sending end, the airtime of its packets, and the receiving
    end.

    :param airtime: of a packet by its bytes, None = of the longest, s; 0 for a PHY without airtime
    :param messages: in the order of time
    :param src_id: of the end that sends; None: the scenario's source
    :param delay_s: s from the end of a packet's airtime to its arrival
    :raises ConfigError: for time ``unthrottled``, in which messages have no times
    """

    def __init__(
        self,
        scenario: Scenario,
        ends: tuple[End, End],
        airtime: Airtime,
        messages: Iterator[Offered],
        *,
        src_id: int | None = None,
        delay_s: float = 0.0,
    ) -> None:
        if scenario.time == "unthrottled":
            raise ConfigError(
                "time = 'unthrottled': packets pass whenever the computer gets round to it, which cannot "
                "be simulated; set time to real, samples or packets"
            )
        self.sender, self.receiver = ends
        self.number = 0
        self.src_id = scenario.ros_source.src_id() if src_id is None else src_id
        self.branches: list[Branch] = []
        """The further receivers. They are used only where ``air`` is set."""
        self.over = False
        """Whether this direction has nothing more to send, as far as is known: an end that answers may send later."""
        self.air: Medium | None = None
        """Decides which packets arrive. None: the caller of the loop decides, for each :class:`AirtimeEnded`."""
        self.due = 0.0
        """s, time at which something may happen next; infinite when the direction is over."""
        self.end = 0.0
        """s, time at which something last happened."""
        self.duration_s = scenario.duration_s
        """s during which messages were offered. Where the length of the bag decides this, it is known at the end."""
        self._messages = messages
        self._coming = next(messages, None)
        self._airtime = airtime
        longest = airtime(None, 0)
        self._clock: AirtimeClock[AirtimeEnded] | None = AirtimeClock(longest) if longest else None
        self._paced = self._clock is not None
        self._drain = scenario.drain_s
        self._until = scenario.duration_s
        self._delay_s = delay_s
        self._delayed: deque[tuple[float, AirtimeEnded]] = deque()
        if self._paced:
            self.sender.endpoint.use_credit()

    @property
    def empty(self) -> bool:
        """Whether nothing waits at the sending end or for the air."""
        return self.sender.endpoint.idle and not (self._clock and self._clock.backlog)

    def step(self, now: float) -> Iterator[TimedEvent]:
        """Everything that happens by ``now``."""
        self.end = now
        yield from self._let_through(now)
        self._submit(now)
        yield from self._send(now)
        yield from self._sender_events(now)
        self.due = self._next(now)

    def arrive(self, arrival: Arrival, now: float) -> Iterator[TimedEvent]:
        """Give the receiving end a packet that has arrived there."""
        for event in self.receiver.endpoint.receive(arrival.data, now, arrival.snr_db):
            yield now, self, event

    def wake(self, now: float) -> None:
        """Look again at when the sending end has a packet. It has just received something and may send earlier."""
        at = self.sender.endpoint.next_departure()
        if at is not None and (self.due < inf or self.sender.endpoint.answers):
            self.due = min(self.due, max(now, at))
            self.over = False

    def _let_through(self, now: float) -> Iterator[TimedEvent]:
        if self._clock is not None:
            for packet in self._clock.due(now):
                self._delayed.append((now + self._delay_s, packet))
        while self._delayed and self._delayed[0][0] <= now:
            yield from self._arrive_everywhere(self._delayed.popleft()[1], now)
        if self._clock is not None:
            credits = self._clock.grants(now)
            if self._paced:
                self.sender.endpoint.credit(credits)

    def _arrive_everywhere(self, packet: AirtimeEnded, now: float) -> Iterator[TimedEvent]:
        if self.air is None:
            yield now, self, packet
        else:
            for arrived in self.air(packet, now):
                yield from self.arrive(arrived, now)
            for branch in self.branches:
                for arrived in branch.air(packet, now):
                    yield from branch.arrive(arrived, now)

    def _submit(self, now: float) -> None:
        while self._coming is not None and self._coming.t <= now:
            self.sender.endpoint.submit(self._coming.topic_id, self._coming.payload, now)
            if not self._until:
                self.duration_s = now
            self._coming = next(self._messages, None)

    def _send(self, now: float) -> Iterator[TimedEvent]:
        endpoint = self.sender.endpoint
        while (data := endpoint.next_packet(now)) is not None:
            packet = AirtimeEnded(data, endpoint.rung)
            if self._clock is not None:
                self._clock.offer(packet, now, self._airtime(len(data), packet.rung))
            elif self._delay_s:
                self._delayed.append((now + self._delay_s, packet))
            else:
                yield from self._sender_events(now)
                yield from self._arrive_everywhere(packet, now)

    def _sender_events(self, now: float) -> Iterator[TimedEvent]:
        for event in self.sender.events:
            yield now, self, event
        self.sender.events.clear()

    def _next(self, now: float) -> float:
        """Time at which something may happen next; infinite when all is done, or the time to drain is over."""
        coming = self._coming
        answers = self.sender.endpoint.answers
        done = coming is None and now >= self.duration_s and self.empty
        if done and not answers:
            self.over = True
            return inf
        clock = self._clock.next_timeout(now) if self._clock is not None else None
        delayed = self._delayed[0][0] if self._delayed else None
        times = (None if coming is None else coming.t, clock, delayed, self.sender.endpoint.next_departure())
        soonest = min((at for at in times if at is not None), default=inf)
        if soonest == inf and now < self.duration_s:
            soonest = self.duration_s  # nothing more happens before the end of the run
        soonest = max(now, soonest)
        self.over = done or (coming is None and soonest > self.duration_s + self._drain)
        return inf if self.over and not answers else soonest


def report_ways(
    scenario: Scenario, ends: Sequence[End], airtime: Airtime, airs: Sequence[Medium]
) -> list[LinkDirection]:
    """The directions on which receivers report to their sender.

    :param ends: the sender, and then its receivers
    :param airs: one per receiver
    """
    delay_s = 0.0 if scenario.reports is None else scenario.reports.delay_s
    ways = []
    for end, air in zip(ends[1:], airs, strict=True):
        way = LinkDirection(scenario, (end, ends[0]), airtime, iter(()), src_id=end.src_id, delay_s=delay_s)
        way.air = air
        ways.append(way)
    return ways


class EventLoop:
    """The directions of one link on one clock.

    :param ways: the directions, each with its two ends
    """

    def __init__(self, ways: Sequence[LinkDirection]) -> None:
        self._ways = ways
        self.now = -inf

    def run(self) -> Iterator[TimedEvent]:
        """Everything that happens, in the order of time, until nothing is left or the time to drain is over. To be
        called only once."""
        in_vain = 0
        while not all(way.over for way in self._ways) and (due := min(way.due for way in self._ways)) < inf:
            before, self.now = self.now, min([due, *self._timers()])
            happened = False
            for timed_event in self._step():
                happened = True
                yield timed_event
            in_vain = 0 if happened or self.now > before else in_vain + 1
            if in_vain == _IN_VAIN:
                raise self._stalled()

    def _step(self) -> Iterator[TimedEvent]:
        yield from self._expire()
        for way in self._ways:
            if way.due <= self.now:
                yield from self._handled(way.step(self.now))

    def _stalled(self) -> RunError:
        """The error that names the ends whose timers are due without effect."""
        timers = [
            f"{name} of robot {end.src_id} is due at {at:.6f} s"
            for end in {id(end): end for way in self._ways for end in (way.sender, way.receiver)}.values()
            for name, at in (("departure", end.endpoint.next_departure()), ("timeout", end.endpoint.next_timeout()))
            if at is not None and at <= self.now
        ]
        return RunError(
            f"the simulation stands still at {self.now:.6f} s: {', '.join(timers) or 'no timer'}, and nothing is done "
            "about it; this is a defect of gr-ros2, please report it with the scenario"
        )

    def _timers(self) -> Iterator[float]:
        """When the ends that receive their packets immediately have something to do other than to send."""
        for end in self._receiving_ends():
            at = end.receiver.endpoint.next_timeout()
            yield inf if at is None or at <= self.now else at

    def _expire(self) -> Iterator[TimedEvent]:
        for end in self._receiving_ends():
            yield from self._handled((self.now, end, event) for event in self._overdue(end.receiver.endpoint))

    def _receiving_ends(self) -> Iterator[LinkDirection | Branch]:
        for way in self._ways:
            if way.air is not None:
                yield way
                yield from way.branches

    def _overdue(self, endpoint: Endpoint) -> list[ReceiverEvent]:
        at = endpoint.next_timeout()
        return endpoint.handle_timeout(self.now) if at is not None and at <= self.now else []

    def _handled(self, timed_events: Iterable[TimedEvent]) -> Iterator[TimedEvent]:
        """Pass the events on, and let an end that has received something send."""
        for timed_event in timed_events:
            yield timed_event
            _, way, event = timed_event
            if way.receiver.endpoint.answers and isinstance(event, ReceiverEvent):
                for back in self._ways:
                    if back.sender is way.receiver:
                        back.wake(self.now)
