"""What a run shows to whoever looks on, such as a dashboard: the events of both ends, and the parts while they run.

Law: the run never depends on an onlooker; without one nothing of this costs anything.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from gr_ros2.config import ChannelConfig
from gr_ros2.gr import RosSource
from gr_ros2.link.events import ReceiverEvent, SenderEvent
from gr_ros2.phy import Phy
from gr_ros2.phy.path import LinkCounts
from gr_ros2.phy.tap import Samples
from gr_ros2.record.ledger import Ledger
from gr_ros2.record.result import Result
from gr_ros2.registry import Registry


class LiveLink(Protocol):
    """What can be seen of a flowgraph, and changed in it: ``phy.loopback.LoopbackLink``, ``radio.radio.Radio``.

    The setters raise a GrRos2Error where that cannot be changed.
    """

    @property
    def phy(self) -> Phy: ...
    @property
    def channel(self) -> ChannelConfig: ...
    @property
    def snr_db(self) -> float | None: ...
    def counts(self) -> LinkCounts: ...
    def samples(self) -> Samples | None: ...
    def symbols(self) -> Samples | None: ...
    def set_snr_db(self, snr_db: float | None) -> None: ...
    def set_frequency_offset(self, frequency_offset: float) -> None: ...
    def set_packet_loss(self, probability: float) -> None: ...


@dataclass(frozen=True)
class LiveRun:
    """A run, or one robot's end of a link, whose flowgraph has been built.

    :param name: of the scenario
    :param duration_s: s during which messages will be submitted; 0 = until a bag ends
    :param topics: absolute name at the source, by source id and topic id
    :param sources: sending block by source id
    :param links: every direction's flowgraph
    :param ledger: where every message sent so far stands; None where only one end of the link is here
    :param clock: s, the clock of the run's events
    """

    name: str
    duration_s: float
    packet_len: int
    registry: Registry
    topics: Mapping[tuple[int, int], str]
    sources: Mapping[int, RosSource]
    links: Sequence[LiveLink]
    ledger: Ledger | None
    clock: Callable[[], float] = time.monotonic


class EventSink(Protocol):
    """What hears both ends. It is called from the run's threads, in causal order, and must be quick and never raise."""

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        """What the sender with this source id reports."""

    def packet_received(self, data: bytes, now: float) -> None:
        """Bytes the PHY handed to the sink, before the sink reads them."""

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        """What the receiver reports; of a delivery once it is republished."""


class Watcher(EventSink, Protocol):
    """An onlooker.

    :param instruments: whether the link is to be built so that its channel can be changed and its signal seen
    """

    @property
    def instruments(self) -> bool: ...

    def run_started(self, run: LiveRun) -> None:
        """Before the first event of a run."""

    def run_ended(self, result: Result | None) -> None:
        """The link has stopped. ``result`` is None where the run failed; then it comes after the error was raised."""


_Sink = TypeVar("_Sink", bound=EventSink)


class Fanout(Generic[_Sink]):
    """Hands every event to several, in their order."""

    def __init__(self, sinks: Sequence[_Sink]) -> None:
        self._sinks = tuple(sinks)

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        for sink in self._sinks:
            sink.sender_event(src_id, event)

    def packet_received(self, data: bytes, now: float) -> None:
        for sink in self._sinks:
            sink.packet_received(data, now)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        for sink in self._sinks:
            sink.receiver_event(event, now)


class Audience(Fanout[Watcher]):
    """A watcher that passes everything on to whoever looks on at the moment: they may come while the run goes on.

    Who comes late is told of the run, and from then on of every event.

    :param instruments: see :class:`Watcher`; for everybody who may come
    """

    def __init__(self, instruments: bool = True) -> None:
        super().__init__(())
        self.instruments = instruments
        self._lock = threading.Lock()
        self._run: LiveRun | None = None

    def add(self, watcher: Watcher) -> None:
        """Let one more look on, from now."""
        with self._lock:
            if self._run is not None:
                watcher.run_started(self._run)
            self._sinks += (watcher,)

    def run_started(self, run: LiveRun) -> None:
        with self._lock:
            self._run = run
            for watcher in self._sinks:
                watcher.run_started(run)

    def run_ended(self, result: Result | None) -> None:
        with self._lock:
            self._run = None
            for watcher in self._sinks:
                watcher.run_ended(result)
