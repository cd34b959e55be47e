"""The interface of a medium: a robot hands over a packet with its start, and the medium says who receives it.

Invariants: sans-IO, simulated time only; a packet is handed over no later than it starts; a reception is due when the
packet's airtime is over, plus the delay of its path; receptions come in the order in which they are due; whatever is
not received is counted by its reason in ``lost``; equal calls give equal receptions.
"""

from __future__ import annotations

import heapq
import random
from abc import ABC, abstractmethod
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import AirPacket
from gr_ros2.link.losses import PduLosses
from gr_ros2.settings.config import ChannelConfig, MeasuredChannel, replaced

Ints = NDArray[np.int_]


@dataclass(frozen=True)
class RadioPath:
    """What lies between a sender and one robot that can hear it, whatever the level.

    :param receiver: place of that robot among the robots of the medium
    :param channel: what happens to packets on the way. Its ``snr_db`` counts in :class:`FixedPaths` alone
    :param delay_s: s from the end of a packet's airtime to its reception
    """

    receiver: int
    channel: ChannelConfig
    delay_s: float = 0.0

    @property
    def bare(self) -> RadioPath:
        """The same without what levels follow from."""
        channel = self.channel
        return replace(self, channel=channel.on_the_way) if isinstance(channel, MeasuredChannel) else self


@dataclass(frozen=True, eq=False)
class Hearers:
    """The robots that hear a sender, and how well, as long as nothing changes.

    :param ids: their places among the robots of the medium, shape (n,)
    :param snr_db: level of the sender's bursts over each receiver's noise, dB, shape (n,); infinite without noise
    :param shift_hz: by how much each hears the carrier higher, Hz, shape (n,); 0 where robots do not move
    :param robots: how many there are in all
    """

    ids: Ints
    snr_db: Floats
    shift_hz: Floats
    robots: int

    @cached_property
    def receivers(self) -> list[int]:
        """``ids`` as a list."""
        return [int(one) for one in self.ids]

    @cached_property
    def noiseless(self) -> bool:
        """Whether no receiver has noise."""
        return not self.noise.any()

    @cached_property
    def noise(self) -> Floats:
        """1, or 0 for a receiver without noise, shape (n,)."""
        return np.isfinite(self.snr_db).astype(float)

    @cached_property
    def levels(self) -> Floats:
        """Power received over that of the noise; 1 where there is none, shape (n,)."""
        return np.asarray(10 ** (np.where(np.isfinite(self.snr_db), self.snr_db, 0.0) / 10))

    @cached_property
    def at(self) -> Floats:
        """The level at every robot, 0 where the sender is not heard, shape (robots,)."""
        levels = np.zeros(self.robots)
        levels[self.ids] = self.levels
        return levels


class Measured(ABC):
    """What was measured of whole packets between two robots."""

    @abstractmethod
    def loss(self, now: float) -> float:
        """Share of the packets that are lost at a time in s after the run began, 0..1."""

    def leaves(self, now: float, size: int) -> float | None:
        """When a packet that comes at a time has passed, s after the run began, where capacity was measured; None if it
        finds no room.

        :param size: bytes
        """
        del size
        return now


class Way:
    """What becomes of whole packets from one robot to another.

    :param dropped: counts packets lost, by reason
    :param measured: None where nothing was measured of them
    """

    def __init__(self, path: RadioPath, dropped: Counter[str], measured: Measured | None) -> None:
        self._losses = PduLosses(path.channel) if path.channel.loses_packets else None
        if self._losses is not None:
            self._losses.dropped = dropped
        self._delay_s, self._dropped, self._measured = path.delay_s, dropped, measured
        self._random = random.Random(f"trace {path.channel.seed}")

    def delay_s(self, now: float, size: int) -> float | None:
        """s by which a packet is delayed; None if it is lost.

        :param now: s after the run began
        :param size: bytes
        """
        if self._losses is not None and not self._losses.passes(now):
            return None
        if self._measured is None:
            return self._delay_s
        lost = self._random.random() < self._measured.loss(now)
        leaves = None if lost else self._measured.leaves(now, size)
        if leaves is None:
            self._dropped["trace" if lost else "trace_queue"] += 1
            return None
        return leaves - now + self._delay_s


class Surroundings(ABC):
    """Who hears whom, and how well, as a function of time.

    :ivar robots: how many there are
    :ivar moves: what levels follow from that change with time, as an error names it; '' where they do not
    :ivar alike: whether all channels differ in their seeds alone
    :ivar passes: whether no path drops or delays whole packets
    :ivar surveyed: whether levels were measured, so that forecasts count what is lost by them
    """

    robots: int
    moves = ""
    alike = False
    passes: bool
    surveyed = False

    def begin(self, now: float) -> None:  # noqa: B027 - most do not move
        """A run begins at a time in s, on a clock that went before: robots move from now on."""

    def change(self, sender: int, **settings: Any) -> None:  # noqa: ARG002 - most do not change
        """Give the channels from a robot to all who hear it other settings, from now on.

        :raises ConfigError: for a value out of range, or a setting that nothing can change here
        """
        raise ConfigError(f"{', '.join(settings)}: nothing changes these channels")

    @abstractmethod
    def hearers(self, sender: int, now: float) -> Hearers:
        """Those who hear a robot at a time in s: the same object as long as nothing has changed for this robot."""

    @abstractmethod
    def path(self, sender: int, receiver: int) -> RadioPath:
        """What lies between two robots."""

    def measured(self, sender: int, receiver: int) -> Measured | None:  # noqa: ARG002 - most know nothing
        """What was measured of whole packets between two robots."""
        return None

    @abstractmethod
    def reached(self, sender: int) -> list[int]:
        """The robots that may ever hear this one."""

    @abstractmethod
    def near(self, sender: int, now: float) -> NDArray[np.bool_]:
        """Which robots may be heard by anybody who hears this one, or hear it themselves, shape (robots,)."""


class FixedPaths(Surroundings):
    """Robots between which nothing changes.

    :param paths: for every robot those to the robots that can hear it. Robots below their noise are best left out
    """

    def __init__(self, paths: Sequence[Sequence[RadioPath]]) -> None:
        self.robots = len(paths)
        self._paths = [{path.receiver: path for path in heard} for heard in paths]
        self._hearers = [self._of(heard) for heard in paths]
        self.passes = all_pass(self._paths)
        hears = np.zeros((self.robots, self.robots), bool)
        for sender, heard in enumerate(self._hearers):
            hears[sender, heard.ids] = True
        # Robots that reach a common one, and robots of which one reaches the other.
        self._near = (hears.astype(np.float32) @ hears.T.astype(np.float32) > 0) | hears | hears.T

    def change(self, sender: int, **settings: Any) -> None:
        self._paths[sender] = changed_paths(self._paths[sender], settings)
        self._hearers[sender] = self._of(list(self._paths[sender].values()))
        self.passes = all_pass(self._paths)

    def _of(self, heard: Sequence[RadioPath]) -> Hearers:
        snrs = [inf if path.channel.snr_db is None else path.channel.snr_db for path in heard]
        ids = np.array([path.receiver for path in heard], int)
        return Hearers(ids, np.array(snrs), np.zeros(len(heard)), self.robots)

    def hearers(self, sender: int, now: float) -> Hearers:  # noqa: ARG002
        return self._hearers[sender]

    def path(self, sender: int, receiver: int) -> RadioPath:
        return self._paths[sender][receiver]

    def reached(self, sender: int) -> list[int]:
        return list(self._paths[sender])

    def near(self, sender: int, now: float) -> NDArray[np.bool_]:  # noqa: ARG002
        return np.asarray(self._near[sender])


def all_pass(paths: Iterable[Mapping[int, RadioPath]]) -> bool:
    """Whether no path drops or delays whole packets."""
    return not any(path.channel.loses_packets or path.delay_s for heard in paths for path in heard.values())


def changed_paths(paths: Mapping[int, RadioPath], settings: Mapping[str, Any]) -> dict[int, RadioPath]:
    """Paths whose channels have other settings.

    :raises ConfigError: for a value out of range
    """
    return {receiver: replace(path, channel=replaced(path.channel, **settings)) for receiver, path in paths.items()}


class Transmission(NamedTuple):
    """A packet on the air.

    :param sender: place of the robot among the robots of the medium
    :param number: counts the packets of this sender, from 0
    :param start, end: s; the gap after a burst is included
    :param mcs: with an adaptive rate the MCS that it is sent with
    """

    sender: int
    number: int
    data: bytes
    start: float
    end: float
    mcs: int = 0


class Reception(NamedTuple):
    """A packet that came out of a robot's receiver.

    :param at: s, when all of it has been received
    :param packet: as received, with the SNR that the receiver itself has measured, where that is simulated
    :param snr_db: of the burst at this receiver, dB; infinite without noise
    :param sinr_db: the same with all other bursts as noise, where they were strongest
    """

    receiver: int
    sent: Transmission
    at: float
    packet: AirPacket
    snr_db: float = inf
    sinr_db: float = inf


class Losses:
    """Packets that one robot did not receive from another, by reason: ``lost[sender, receiver]["collision"]``.

    :ivar dropped: by the settings of a path
    """

    def __init__(self, robots: int) -> None:
        self._robots = robots
        self._counts: dict[str, Ints] = {}
        self.dropped: dict[tuple[int, int], Counter[str]] = defaultdict(Counter)

    def add(self, reason: str, sender: int, receivers: int | Ints | list[int], count: int = 1) -> None:
        """A packet, or ``count``, was not received by these robots."""
        if reason not in self._counts:
            self._counts[reason] = np.zeros((self._robots, self._robots), int)
        self._counts[reason][sender][receivers] += count

    def clear(self) -> None:
        """Count from 0 again."""
        self._counts.clear()
        for dropped in self.dropped.values():
            dropped.clear()

    def total(self, reason: str) -> int:
        """Of all pairs together."""
        counted = int(self._counts[reason].sum()) if reason in self._counts else 0
        return counted + sum(dropped[reason] for dropped in self.dropped.values())

    def __getitem__(self, pair: tuple[int, int]) -> Counter[str]:
        counts = {reason: int(counts[pair]) for reason, counts in self._counts.items() if counts[pair]}
        return Counter(counts) + self.dropped.get(pair, Counter())


class Medium(ABC):
    """What robots share. Subclasses say what arrives of one packet.

    :param around: who hears whom
    :param shared: all robots use one channel: whoever sends hears nothing meanwhile, and packets that overlap at a
        receiver interfere. Otherwise every robot sends on a channel of its own, and hears while it sends
    :ivar lost: packets that one robot did not receive from another, by sender, receiver and reason: ``phy``,
        ``collision`` (it would have arrived without the others), ``sending`` (the receiver sent meanwhile), or the
        setting of the channel that dropped it
    """

    def __init__(self, around: Surroundings, *, shared: bool) -> None:
        self.shared, self.around = shared, around
        self.lost = Losses(around.robots)
        self._due: list[tuple[float, int, Transmission | list[Reception]]] = []
        self._order = count()
        self._sent: Counter[int] = Counter()
        self._recent: deque[Transmission] = deque()
        self._longest = 0.0
        self._ways: dict[tuple[int, int], Way] = {}
        self._begin_s = 0.0

    def begin(self, now: float) -> None:
        """A run begins at a time in s, on a clock that went before: robots move, and outages count, from now on."""
        self._begin_s = now
        self.around.begin(now)
        self._ways.clear()

    def change(self, sender: int, **settings: Any) -> None:
        """Change settings of the channels of a robot that sends."""
        self.around.change(sender, **settings)
        self._ways.clear()

    def send(self, sender: int, data: bytes, start: float, airtime: float, mcs: int = 0) -> Transmission:
        """Take a packet that starts at ``start`` s and lasts for ``airtime`` s."""
        sent = Transmission(sender, self._sent[sender], data, start, start + airtime, mcs)
        self._sent[sender] += 1
        self._longest = max(self._longest, airtime)
        if self.shared:
            self._recent.append(sent)
        heapq.heappush(self._due, (sent.end, next(self._order), sent))
        return sent

    @property
    def next_due(self) -> float:
        """s, when a packet ends or arrives next; infinite when none is on its way."""
        return self._due[0][0] if self._due else inf

    def receptions(self, now: float) -> Iterator[Reception]:
        """What has been received by ``now`` since the call before."""
        while self._due and self._due[0][0] <= now:
            _, _, item = heapq.heappop(self._due)
            yield from self.passed(self.outcome(item)) if isinstance(item, Transmission) else item

    @abstractmethod
    def outcome(self, sent: Transmission) -> Iterable[Reception]:
        """What the receivers make of a packet whose airtime is over, before whole packets are dropped."""

    def hearers(self, sent: Transmission) -> Hearers:
        """Those who hear a packet. All of a packet is heard as its start is."""
        return self.around.hearers(sent.sender, sent.start)

    def others(self, sent: Transmission) -> list[Transmission]:
        """The packets on the air meanwhile that matter to anybody who hears ``sent``."""
        recent = self._recent
        start, end = sent.start, sent.end
        while recent and recent[0].end < end - 2 * self._longest:
            recent.popleft()
        if len(recent) < 2:
            return []
        found = [other for other in recent if start < other.end and other.start < end and other is not sent]
        if found:
            near = self.around.near(sent.sender, start)
            found = [other for other in found if near[other.sender] or other.sender == sent.sender]
        return found

    def passed(self, received: Iterable[Reception]) -> Iterator[Reception]:
        """Receptions, now or later, without those of packets that their path drops."""
        if self.around.passes:
            yield from received
            return
        later: dict[float, list[Reception]] = {}
        for reception in received:
            receiver, sent, at, packet, snr_db, sinr_db = reception
            pair = sent.sender, receiver
            delay_s = self.way(pair).delay_s(at - self._begin_s, len(sent.data))
            if delay_s is None:
                continue
            if delay_s:
                at += delay_s
                later.setdefault(at, []).append(Reception(receiver, sent, at, packet, snr_db, sinr_db))
            else:
                yield reception
        for at, receptions in later.items():
            heapq.heappush(self._due, (at, next(self._order), receptions))

    def way(self, pair: tuple[int, int]) -> Way:
        """What becomes of whole packets from one robot to another."""
        if (way := self._ways.get(pair)) is None:
            way = self._ways[pair] = Way(self.around.path(*pair), self.lost.dropped[pair], self.around.measured(*pair))
        return way
