"""Observers of a run, such as a dashboard: they receive the events of both ends, and can read the parts while they run.

Invariant: the run never depends on an observer, even if the observer raises, hangs or is slow; without observers there
is no cost.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from gr_ros2.core.backlog import Backlog
from gr_ros2.core.errors import RunError
from gr_ros2.core.guard import Guard
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.events import BoundPacket, Received, ReceiverEvent, Rejected, SenderEvent, SentPacket
from gr_ros2.link.lateness import Lateness
from gr_ros2.link.observe import LinkObserver, Observers, name_of
from gr_ros2.observe.result import RunResult
from gr_ros2.observe.team import TeamView
from gr_ros2.phy import Phy
from gr_ros2.settings.config import ChannelConfig
from gr_ros2.settings.registry import Registry, Topic

if TYPE_CHECKING:  # they need GNU Radio, and a run in simulated time by packets does not
    from gr_ros2.gr.sending import SendingBlock
    from gr_ros2.phy.tap import Samples
    from gr_ros2.radio.radio import LinkCounts

_HELD_BYTES = 1 << 25
"""Bytes of events that may wait for an observer with a thread of its own."""
_EVENT_BYTES = 256
"""Bytes counted for each event, in addition to its packet or payload."""
_PATIENCE_S = 5.0
"""s that an observer may take to process the waiting events."""


class LiveLink(Protocol):
    """What an observer can read and change of one direction of a link: ``radio.radio.Radio``, or the channel of a run.

    The setters raise a GrRos2Error where the setting cannot be changed.

    :ivar phy: of transmitter and receiver
    :ivar channel: as its settings say
    :ivar snr_db: of the newest packets, as the receiver measured it, dB; None where it has not
    :ivar changeable: whether the channel can be changed
    :ivar transmits: whether packets go on the air
    """

    @property
    def phy(self) -> Phy: ...
    @property
    def channel(self) -> ChannelConfig: ...
    @property
    def snr_db(self) -> float | None: ...
    @property
    def changeable(self) -> bool: ...
    @property
    def transmits(self) -> bool: ...

    def gate_lateness(self) -> Lateness | None:
        """How late packets left the airtime gate; None where there is none."""

    def counts(self) -> LinkCounts:
        """Packets so far."""

    def samples(self) -> Samples | None:
        """The newest samples behind the channel; None where nothing taps them."""

    def symbols(self) -> Samples | None:
        """The newest constellation points of the receiver; None where it shows none."""

    def transmit(self, *, on: bool) -> None:
        """Whether packets go on the air from now on."""

    def set_snr_db(self, snr_db: float | None) -> None:
        """Signal-to-noise ratio of the channel from now on, dB; None = no noise."""

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """Offset of the carrier from now on, fraction of the sample rate."""

    def set_packet_loss(self, probability: float) -> None:
        """Probability from now on that a packet is dropped, 0..1."""


class Wishes(Protocol):
    """What asks other robots for topics: :class:`gr_ros2.gr.wishes.LiveWishes`. It raises a GrRos2Error where it
    refuses."""

    def known(self) -> Mapping[int, list[dict[str, Any]]]:
        """What each robot that is heard offers, as far as it was asked and has answered."""

    def offers(self, robot: int, *, anew: bool = False) -> Mapping[str, Any]:
        """What a robot offers, which is asked now if ``anew``."""

    def want(self, robot: int, name: str, rate: float = 0.0, for_s: float = 60.0) -> None:
        """Want a topic of a robot, so many messages/s at most, for so many s."""

    def give_up(self, robot: int, name: str) -> None:
        """Want it no more."""

    def stats(self) -> Mapping[str, Any]:
        """The wishes of this robot, and those of others here."""


class FarServices(Protocol):
    """What calls services of other robots: :class:`gr_ros2.gr.calls.LiveCalls`."""

    def reached(self) -> Mapping[str, str]:
        """Types, by their names here, of those that can be called."""

    def call(self, name: str, payload: bytes) -> bytes:
        """Call one, and wait for the reply. It raises a GrRos2Error where there is none."""


class Change(NamedTuple):
    """What somebody has changed during a run.

    :param at: s on the run's clock
    :param setting: its name, as in a file: ``channel.snr_db``, or ``transmit`` of all robots
    """

    at: float
    setting: str
    value: float | bool | None


@dataclass(frozen=True)
class LiveRun:
    """A run, or one robot's end of a link, whose flowgraph has been built.

    :param name: of the scenario
    :param duration_s: s during which messages will be submitted; 0 = until a bag ends
    :param topics: absolute name at the source, by source id and topic id
    :param sources: sending block by source id
    :param links: every direction's flowgraph
    :param fates: messages by their fate now, by source id and topic id; None where only one end of the link is in
        this process
    :param clock: s, the clock of the run's events
    :param airtime: s that a packet of so many bytes takes at an MCS; None where packets take no air
    :param team: robots that share a channel, None where none do
    :param received_as: absolute name under which a topic of a sender, by its name in a registry, comes out here; ''
        where the names of ``topics`` are shown
    :param announced: source id, absolute name here and meaning of each topic that other robots have announced so far
    :param alarms: what is wrong with the robots that are heard, or with what lies between them, one line each
    :param clocks: what is known of the clocks of the robots that are heard
    :param heard: source ids of the robots that the receiver of the run's events can hear; None = all
    :param wants_key: called where somebody has begun to watch a topic of a robot, by their ids, that is sent as frames
    :param wishes: asks other robots for topics; None where nobody can be asked
    :param calls: calls services of other robots; None where none can be called
    :param changed: told of each change that somebody makes while it runs
    :param hears_always: whether the samples of the first of ``links`` are those of all the time, not of bursts alone
    """

    name: str
    duration_s: float
    packet_len: int
    registry: Registry
    topics: Mapping[tuple[int, int], str]
    sources: Mapping[int, SendingBlock]
    links: Sequence[LiveLink]
    fates: Callable[[], Mapping[tuple[int, int], Mapping[str, int]]] | None
    clock: Callable[[], float] = time.monotonic
    airtime: Callable[[int, int], float] | None = None
    team: Callable[[], TeamView] | None = None
    received_as: Callable[[int, str], str] = lambda _src_id, _name: ""
    announced: Callable[[], Sequence[tuple[int, str, Topic]]] = tuple
    alarms: Callable[[], Sequence[str]] = tuple
    clocks: Callable[[], Mapping[int, ClockOffset]] = dict
    heard: frozenset[int] | None = None
    wants_key: Callable[[int, int], None] = lambda _src_id, _topic_id: None
    wishes: Wishes | None = None
    calls: FarServices | None = None
    changed: Callable[[Change], None] = lambda _: None
    hears_always: bool = False


class RunObserver(LinkObserver, Protocol):
    """An observer. Messages about it use its ``name``, where it has one.

    :ivar instruments: whether the link must be built so that its channel can be changed and its signal observed
    """

    @property
    def instruments(self) -> bool: ...

    def run_started(self, run: LiveRun) -> None:
        """Called before the first event of a run."""

    def run_ended(self, result: RunResult | None) -> None:
        """Called when the link has stopped. ``result`` is None where the run failed; the call then follows the
        error."""


class LateObservers(Observers[RunObserver]):
    """An observer that passes everything on to other observers, which may be attached while the run goes on.

    An observer that is attached late first receives ``run_started``, and then every further event.
    """

    name = "audience"
    instruments = True

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()
        self._run: LiveRun | None = None

    def invite(self, observer: RunObserver) -> None:
        """Attach one more observer, from now on."""
        with self._lock:
            guard = Guard(name_of(observer))
            if self._run is not None:
                guard(observer.run_started, self._run)
            self._guarded += ((observer, guard),)

    def run_started(self, run: LiveRun) -> None:
        with self._lock:
            self._run = run
            for observer, guard in self._guarded:
                guard(observer.run_started, run)

    def run_ended(self, result: RunResult | None) -> None:
        with self._lock:
            self._run = None
            for observer, guard in self._guarded:
                guard.last(observer.run_ended, result)


class RunObservers(Observers[RunObserver]):
    """The observers of one run or link. They can neither stop it nor delay it.

    :param threaded: give each observer a thread of its own and a bounded queue of events; events that do not fit are
        left out and counted. Otherwise observers are called directly, which is correct in simulated time, because
        the simulation waits for them.
    """

    def __init__(self, observers: Iterable[RunObserver] = (), *, threaded: bool) -> None:
        self._threaded = [ThreadedObserver(observer) for observer in observers] if threaded else []
        super().__init__(self._threaded if threaded else observers)
        self.instruments = any(observer.instruments for observer, _ in self._guarded)

    def run_started(self, run: LiveRun) -> None:
        for observer, guard in self._guarded:
            guard(observer.run_started, run)

    def settle(self) -> None:
        """Wait until all observers have received everything so far. The link has stopped. If an observer takes too
        long, its remaining events count as missed."""
        for observer in self._threaded:
            observer.settle()

    def run_ended(self, result: RunResult | None) -> None:
        """The run is over. No call follows this one."""
        for observer, guard in self._guarded:
            guard.last(observer.run_ended, result)


class ThreadedObserver(Observers[RunObserver]):
    """An observer with a thread of its own."""

    def __init__(self, observer: RunObserver) -> None:
        super().__init__((observer,))
        self.name = name_of(observer)
        self.instruments = observer.instruments
        self._observer, self._guard = self._guarded[0]
        self._backlog = Backlog(f"gr-ros2-{self.name}"[:40], _HELD_BYTES)
        self._ended = self._hangs = False

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        self._pass_on(_size(event), self._observer.sender_event, src_id, event)

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:
        self._pass_on(_size(event), self._observer.receiver_event, event, now)

    def run_started(self, run: LiveRun) -> None:
        self._backlog.offer(0, self._guard, self._observer.run_started, run)

    def settle(self) -> None:
        """Wait until the observer has had all events; one that does not keep up is given up."""
        if not self._backlog.settle(_PATIENCE_S):
            self._give_up()

    def run_ended(self, result: RunResult | None) -> None:
        self._ended = True
        self._backlog.offer(0, self._guard.last, self._observer.run_ended, result)
        if not self._backlog.close(0 if self._hangs else _PATIENCE_S):
            self._give_up()

    def _pass_on(self, size: int, call: Callable[..., object], *arguments: object) -> None:
        if self._ended:
            return
        if self._guard.error is not None or not self._backlog.offer(_EVENT_BYTES + size, self._guard, call, *arguments):
            self._guard.miss()

    def _give_up(self) -> None:
        """The observer hangs: count the waiting events as missed."""
        self._hangs = True
        if self._guard.error is None:
            self._guard.end(RunError(f"it has not come back for {_PATIENCE_S:g} s"))
            self._guard.miss(self._backlog.pending)


def _size(event: SenderEvent | ReceiverEvent) -> int:
    """Bytes of the packet or message that an event holds. A packet counts twice: as bytes and as payloads."""
    if isinstance(event, SentPacket | Received):
        return 2 * len(event.data)
    return len(event.data) if isinstance(event, Rejected | BoundPacket) else len(getattr(event, "payload", b""))
