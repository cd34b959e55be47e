"""Runs one scenario on simulated time: no ROS graph, no waiting, and the same numbers each time.

Invariants: equal scenarios give equal results, except for ``wall_s``; with ``time: samples`` every packet goes through
the scenario's own transmitter, channel and receiver; with ``time: packets`` packets are lost with the probability that
was measured for them (:mod:`gr_ros2.run.loss_table`); in both cases a packet arrives when its last sample has been on
the air. While nothing is sent there are no samples, as in a run in real time, so noise and fading do not advance.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gr_ros2.config import ChannelConfig
from gr_ros2.guard import Guard
from gr_ros2.link.losses import PduLosses
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.phy import Phy
from gr_ros2.record.recorder import Recorder
from gr_ros2.record.result import Result
from gr_ros2.registry import Registry
from gr_ros2.run.delivered import DeliveredBag, bag_origin_ns
from gr_ros2.run.ladder_air import LadderAir
from gr_ros2.run.load import make_phys, recording, source_names
from gr_ros2.run.loss_table import packet_losses
from gr_ros2.run.observers import LiveRun, RunObservers
from gr_ros2.run.outcome import DELIVERED_BAG, Outcome, Progress, phy_numbers
from gr_ros2.run.recorders import FurtherRecorders, make_recorder
from gr_ros2.run.scenario import Scenario, dump
from gr_ros2.run.simulate import (
    AirtimeEnded,
    Arrival,
    Branch,
    End,
    EventLoop,
    LinkDirection,
    TimedEvent,
    make_ends,
    offered,
    pass_on,
    report_ways,
)

if TYPE_CHECKING:
    from gr_ros2.phy.measure import BatchChannel

_REPORT_S = 0.05

_log = logging.getLogger(__name__)


def run_simulated(
    scenario: Scenario,
    out: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    run_observers: RunObservers | None = None,
    *,
    registry: Registry | None = None,
    bag: DeliveredBag | None = None,
) -> Outcome:
    """Run a scenario with ``time`` samples or packets to its end.

    :param out: folder for the bag of delivered messages, made if missing; None writes none
    :param on_progress: called about 20 times a second
    :param run_observers: receive all events; there is no flowgraph that they could change
    :param registry: None takes the scenario's
    :param bag: receives the delivered messages instead of a bag in ``out``
    :raises ConfigError: when the scenario cannot be set up
    :raises RunError: when it fails while it runs
    """
    began = time.monotonic()
    registry = registry or scenario.load_registry()
    ways = scenario.directions()
    phys = make_phys(ways, registry)
    with ExitStack() as stack:
        if bag is None and out is not None:
            origin_ns = bag_origin_ns(scenario, source_names(scenario, registry))
            source = recording(scenario)
            for line in source.differences:
                _log.warning(line)
            bag = stack.enter_context(DeliveredBag(out / DELIVERED_BAG, origin_ns, definitions=source.texts))
            for way in ways:
                ids, names = source_names(way, registry).values(), _published_as(way, registry).values()
                bag.add_source(way.ros_source.src_id(), registry, dict(zip(ids, names, strict=True)))
        recorder = make_recorder(registry, ways, None if bag is None else bag.take)
        further = FurtherRecorders(registry, ways)
        run_observers = run_observers or RunObservers(threaded=False)
        link_observers = Observers[LinkObserver]()
        recorded = link_observers.add(recorder, needed=True)
        link_observers.add(further)
        link_observers.add(run_observers)
        any_length = all(phy.any_length for phy in phys)
        ends = make_ends(ways, registry, any_length=any_length, ladder=phys[0].ladder)
        directions = [
            _Direction(way, registry, phy, (first, second))
            for way, phy, (first, second) in zip(ways, phys, (ends[:2], ends[1::-1]), strict=False)
        ]
        loop = EventLoop(
            [*(direction.way for direction in directions), *_further(scenario, phys[0], directions[0], ends)]
        )
        clock = _EventClock()
        run_observers.run_started(_live_run(scenario, registry, recorder, clock))
        reported, progress = 0.0, Guard("progress")
        for timed_event in _all_events(loop, directions):
            clock.now = timed_event[0]
            number = timed_event[1].number
            pass_on(further.at(number) if number else link_observers, timed_event)
            recorded.check()
            further.check()
            if on_progress is not None and time.monotonic() > reported + _REPORT_S:
                reported = time.monotonic()
                progress(on_progress, Progress(clock.now, scenario.duration_s, *recorder.progress()))
        recorded.check()
        further.check()
    played = max(direction.way.duration_s for direction in directions)
    drained = all(direction.way.empty for direction in directions)
    topics = recorder.finish(played, played, drained)
    there, *back = (direction.counters() for direction in directions)
    result = Result(
        scenario=scenario.name,
        seed=scenario.seed,
        duration_s=played,
        config=dump(scenario),
        topics=topics,
        receivers=further.finish(played, played, drained),
        packets=recorder.ledger.packets(),
        phy=phy_numbers(phys[0], len(ways), recorder),
        wall_s=time.monotonic() - began,
        incomplete=tuple(run_observers.incomplete()),
        counters={**there, **({"back": back[0]} if back else {}), "listener": {} if bag is None else dict(bag.written)},
    )
    published_as = {name: other for way in ways for name, other in _published_as(way, registry).items()}
    return Outcome(result, recorder.trace(0.0, played, published_as))


class _EventClock:
    """The run's clock, for observers."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@dataclass(eq=False)
class _PendingPacket:
    """A packet whose samples have been on the air.

    :param arrived: the packets that came out of the receiver; None while they are not known
    """

    data: bytes
    arrived: list[Arrival] | None = None


class _Air:
    """A channel that loses packets as measured, or passes them through the flowgraph.

    :ivar batches: the flowgraph, which takes packets in batches; None if the losses are those measured for packets
    :ivar losses: what a setting of the channel drops
    """

    def __init__(self, scenario: Scenario, phy: Phy, channel: ChannelConfig) -> None:
        self.losses = PduLosses(channel)
        self.lost_by_phy: Counter[str] = Counter()
        self.batches: BatchChannel | None = None
        self._measured: PduLosses | None = None
        self._ladder: LadderAir | None = None
        if phy.ladder:
            self._ladder = LadderAir(phy, channel, samples=scenario.time == "samples")
            self.lost_by_phy = self._ladder.lost
        elif scenario.time == "samples" and phy.has_samples:
            from gr_ros2.phy.measure import BatchChannel  # with GNU Radio

            self.batches = BatchChannel(phy, channel)
        else:
            self._measured = PduLosses(packet_losses(phy, channel))
            self.lost_by_phy = self._measured.dropped

    def pass_one(self, packet: AirtimeEnded, now: float) -> Iterator[Arrival]:
        """The packets that arrive after one packet was sent, for ends whose next packet depends on that."""
        if self._ladder is not None:
            arrived = self._ladder.through(packet.data, packet.rung, now)
        elif self._measured is not None:
            arrived = [Arrival(packet.data)] if self._measured.passes(now) else []
        else:
            (arrived,) = self.through([packet.data])
        yield from (arrival for arrival in arrived if self.losses.passes(now))

    def through(self, sent: Sequence[bytes]) -> list[list[Arrival]]:
        """What comes out of the flowgraph for each of some packets, without the losses of ``losses``."""
        assert self.batches is not None
        arrived: list[list[Arrival]] = [[] for _ in sent]
        for place, packet in self.batches.send(sent):
            arrived[place].append(Arrival(packet))
        for data, arrivals in zip(sent, arrived, strict=True):
            self.lost_by_phy["phy"] += Arrival(data) not in arrivals
        return arrived


class _Direction:
    """One direction of the link, and the channel for its packets.

    :param ends: the end that sends, and the end that receives
    """

    def __init__(self, scenario: Scenario, registry: Registry, phy: Phy, ends: tuple[End, End]) -> None:
        self.way = LinkDirection(scenario, ends, phy.airtime, offered(scenario, registry))
        self._scenario, self._registry = scenario, registry
        self._air = _Air(scenario, phy, scenario.channel)
        self._pending: list[_PendingPacket] = []
        if self._air.batches is None or ends[1].endpoint.answers or scenario.receivers:
            self.way.air = self._air.pass_one

    def land(self, data: bytes) -> _PendingPacket:
        """Take a packet whose samples have been on the air. Whether it arrives is known when its batch is full."""
        pending = _PendingPacket(data)
        self._pending.append(pending)
        if self._air.batches is not None and len(self._pending) == self._air.batches.batch:
            self.decide()
        return pending

    def decide(self) -> None:
        """Send the packets of the current batch through the flowgraph."""
        if self._air.batches is None or not self._pending:
            return
        arrived = self._air.through([pending.data for pending in self._pending])
        for pending, packets in zip(self._pending, arrived, strict=True):
            pending.arrived = packets
        self._pending.clear()

    def arrive(self, pending: _PendingPacket, now: float) -> Iterator[TimedEvent]:
        """What came out of the flowgraph for a packet, without the packets that a setting of the channel drops."""
        for arrival in pending.arrived or ():
            if self._air.losses.passes(now):
                yield from self.way.arrive(arrival, now)

    def counters(self) -> dict[str, Any]:
        """What each part counted. ``channel``: packets lost in the PHY, and packets dropped by each setting."""
        sent, got = self.way.sender.endpoint.sent, self.way.receiver.endpoint.received
        return {
            "source": {
                "packets": sent.packets,
                "entries": sent.entries,
                "payload_bytes": sent.payload_bytes,
                "repeats": sent.repeats,
                "topics": {
                    name: {
                        "submitted": sent.submitted[topic_id],
                        "sent": sent.sent[topic_id],
                        "refused": {reason: count for (key, reason), count in sent.refused.items() if key == topic_id},
                    }
                    for name, topic_id in source_names(self._scenario, self._registry).items()
                },
            },
            "sink": {
                "packets": got.packets,
                "rejected": dict(got.rejected),
                "dropped": dict(got.dropped),
                "repeats": got.repeats,
                "packet_loss_est": got.packet_loss_est,
                "message_loss_est": got.message_loss_est,
            },
            "channel": {"phy": self._air.lost_by_phy.total(), **self._air.losses.dropped},
        }


def _further(scenario: Scenario, phy: Phy, first: _Direction, ends: Sequence[End]) -> list[LinkDirection]:
    """Connect the further receivers to the first direction, and return the directions on which receivers report."""
    first.way.branches = [
        Branch(first.way, end, _Air(scenario, phy, channel).pass_one, number)
        for number, (end, channel) in enumerate(zip(ends[2:], scenario.receivers, strict=False), 1)
    ]
    if scenario.reports is None:
        return []
    airs = [_Air(scenario, phy, channel).pass_one for channel in scenario.report_channels()]
    return report_ways(scenario, ends, phy.airtime, airs)


def _all_events(loop: EventLoop, directions: Sequence[_Direction]) -> Iterator[TimedEvent]:
    """Everything that happens. If no end answers, packets go through the flowgraph in batches. Events after a packet
    wait until it is known whether the packet arrives."""
    of = {id(direction.way): direction for direction in directions}
    held: deque[tuple[TimedEvent, _PendingPacket | None]] = deque()

    def decided() -> Iterator[TimedEvent]:
        while held and (held[0][1] is None or held[0][1].arrived is not None):
            timed_event, pending = held.popleft()
            if pending is None:
                yield timed_event
            else:
                yield from of[id(timed_event[1])].arrive(pending, timed_event[0])

    for timed_event in loop.run():
        _, way, event = timed_event
        held.append((timed_event, of[id(way)].land(event.data) if isinstance(event, AirtimeEnded) else None))
        yield from decided()
    for direction in directions:
        direction.decide()
    yield from decided()
    for direction in directions:
        way = direction.way
        yield from ((way.end, way, event) for event in way.receiver.endpoint.handle_timeout(way.end))


def _published_as(way: Scenario, registry: Registry) -> dict[str, str]:
    """Name of every topic at the sink, by its name at the source."""
    format_, src_id = way.ros_sink.namespace_format, way.ros_source.src_id()
    rows = registry.with_options(way.ros_sink.topic_options)
    return {name: rows[topic_id].republished(format_, src_id) for name, topic_id in source_names(way, registry).items()}


def _live_run(scenario: Scenario, registry: Registry, recorder: Recorder, clock: Callable[[], float]) -> LiveRun:
    topics = {
        (way.ros_source.src_id(), topic_id): name
        for way in scenario.directions()
        for name, topic_id in source_names(way, registry).items()
    }
    return LiveRun(
        name=scenario.name,
        duration_s=scenario.duration_s,
        packet_len=scenario.packet_len,
        registry=registry,
        topics=topics,
        sources={},
        links=(),
        ledger=recorder.ledger,
        clock=clock,
    )
