"""Runs one scenario on simulated time: no ROS graph, no waiting, and the same numbers each time.

Laws: equal scenarios give equal results, but for ``wall_s``; with ``time: samples`` every packet goes through the
scenario's own transmitter, channel and receiver, with ``time: packets`` it is lost as these were measured to lose
(:mod:`gr_ros2.run.losstable`); either way it comes out when its last sample was on the air. Idle air makes no
samples, as in a run in real time, so neither noise nor fading moves on in it.
"""

from __future__ import annotations

import heapq
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gr_ros2.guard import Guard
from gr_ros2.link import Missed, Refused
from gr_ros2.link.losses import PduLosses
from gr_ros2.link.observe import LinkObserver, Observers
from gr_ros2.phy import Phy
from gr_ros2.record.recorder import Recorder
from gr_ros2.record.result import Result
from gr_ros2.registry import Registry
from gr_ros2.run.delivered import DeliveredBag, bag_origin_ns
from gr_ros2.run.load import make_phys, recording, source_names
from gr_ros2.run.losstable import packet_losses
from gr_ros2.run.outcome import DELIVERED_BAG, Outcome, Progress, phy_numbers
from gr_ros2.run.scenario import Scenario, dump
from gr_ros2.run.simulate import Landed, Reception, Step, Transmission, drop_packets, offered
from gr_ros2.run.watch import LiveRun, Onlookers

_REPORT_S = 0.05

_log = logging.getLogger(__name__)


def run_simulated(
    scenario: Scenario,
    out: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    onlookers: Onlookers | None = None,
    *,
    registry: Registry | None = None,
    bag: DeliveredBag | None = None,
) -> Outcome:
    """Run a scenario with ``time`` samples or packets to its end.

    :param out: folder for the bag of delivered messages, made if missing; None writes none
    :param on_progress: called about 20 times a second
    :param onlookers: hear everything; there is no flowgraph for them to act on
    :param registry: None takes the scenario's
    :param bag: where delivered messages go instead
    :raises ConfigError: when the scenario cannot be set up
    :raises RunError: when it fails under way
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
        recorder = Recorder(
            registry,
            {way.ros_source.src_id(): way.ros_source.namespace for way in ways},
            {way.ros_source.src_id(): source_names(way, registry).values() for way in ways},
            on_delivery=None if bag is None else bag.take,
        )
        onlookers = onlookers or Onlookers(apart=False)
        ears = Observers[LinkObserver]()
        recorded = ears.add(recorder, needed=True)
        ears.add(onlookers)
        directions = [_Direction(way, registry, phy, ears) for way, phy in zip(ways, phys, strict=True)]
        clock = _Clock()
        onlookers.run_started(_live_run(scenario, registry, recorder, clock))
        reported, progress = 0.0, Guard("progress")
        for now, number, step in heapq.merge(*(one.timed(place) for place, one in enumerate(directions)), key=_when):
            clock.now = now
            directions[number].reception.take(step)
            recorded.check()
            if on_progress is not None and time.monotonic() > reported + _REPORT_S:
                reported = time.monotonic()
                progress(on_progress, Progress(now, scenario.duration_s, *recorder.progress()))
        for direction in directions:
            direction.reception.wait_until(direction.transmission.end)
        recorded.check()
    played = max(direction.transmission.duration_s for direction in directions)
    topics = recorder.finish(played, played, all(direction.transmission.empty for direction in directions))
    there, *back = (direction.counters() for direction in directions)
    result = Result(
        scenario=scenario.name,
        seed=scenario.seed,
        duration_s=played,
        config=dump(scenario),
        topics=topics,
        packets=recorder.ledger.packets(),
        phy=phy_numbers(phys[0], len(ways), recorder),
        wall_s=time.monotonic() - began,
        incomplete=tuple(onlookers.told()),
        counters={**there, **({"back": back[0]} if back else {}), "listener": {} if bag is None else dict(bag.written)},
    )
    published_as = {name: other for way in ways for name, other in _published_as(way, registry).items()}
    return Outcome(result, recorder.trace(0.0, played, published_as))


class _Clock:
    """The run's clock, for onlookers."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class _Direction:
    """Sender, air and receiver of one direction."""

    def __init__(self, scenario: Scenario, registry: Registry, phy: Phy, ears: LinkObserver) -> None:
        self.transmission = Transmission(scenario, registry, phy.airtime())
        self.reception = Reception(scenario, registry, ears)
        self._scenario, self._registry = scenario, registry
        self._losses = PduLosses(scenario.channel)
        self._lost_by_phy: Counter[str] = Counter()
        steps: Iterable[Step] = self.transmission.steps(offered(scenario, registry))
        if scenario.time == "samples" and phy.has_samples:
            steps = self._sampled(steps, phy)
        else:
            measured = PduLosses(packet_losses(phy, scenario.channel))
            self._lost_by_phy = measured.dropped
            steps = drop_packets(steps, measured)
        self._steps = drop_packets(steps, self._losses)

    def timed(self, number: int) -> Iterator[tuple[float, int, Step]]:
        """The steps with their times and the number of this direction."""
        now = 0.0
        for step in self._steps:
            now = now if isinstance(step, Refused | Missed) else step.now
            yield now, number, step

    def counters(self) -> dict[str, Any]:
        """What each part counted; ``channel``: packets lost in the PHY, and on purpose by setting."""
        sent, got = self.transmission.stats, self.reception.stats
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
            "channel": {"phy": self._lost_by_phy.total(), **self._losses.dropped},
        }

    def _sampled(self, steps: Iterable[Step], phy: Phy) -> Iterator[Step]:
        """The steps with what the flowgraph makes of their packets, batch by batch."""
        from gr_ros2.phy.measure import Passage

        passage = Passage(phy, self._scenario.channel)
        held: list[Step] = []
        packets = 0
        for step in steps:
            held.append(step)
            packets += isinstance(step, Landed)
            if packets == passage.batch:
                yield from self._through(passage.send, held)
                held, packets = [], 0
        yield from self._through(passage.send, held)

    def _through(
        self, send: Callable[[Sequence[bytes]], list[tuple[int, bytes]]], steps: Sequence[Step]
    ) -> Iterator[Step]:
        sent = [step.data for step in steps if isinstance(step, Landed)]
        arrived: dict[int, list[bytes]] = {}
        for place, packet in send(sent) if sent else ():
            arrived.setdefault(place, []).append(packet)
        self._lost_by_phy["phy"] += len(sent) - sum(sent[place] in packets for place, packets in arrived.items())
        place = 0
        for step in steps:
            if isinstance(step, Landed):
                yield from (Landed(packet, step.now) for packet in arrived.get(place, ()))
                place += 1
            else:
                yield step


def _when(item: tuple[float, int, Step]) -> float:
    return item[0]


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
