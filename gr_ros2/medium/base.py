"""The interface of a medium: a robot hands over a packet with its start, and the medium says who receives it.

Invariants: sans-IO, simulated time only; a packet is handed over no later than it starts; a reception is due when the
packet's airtime is over, plus the delay of its path; receptions come in the order in which they are due; whatever is
not received is counted by its reason in ``lost``; equal calls give equal receptions.
"""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count, takewhile
from math import inf
from typing import NamedTuple

from gr_ros2.link.losses import PduLosses
from gr_ros2.settings.config import ChannelConfig


@dataclass(frozen=True)
class Path:
    """What lies between a sender and one robot that can hear it.

    :param receiver: place of that robot among the robots of the medium
    :param channel: its ``snr_db`` is the level of the sender's bursts over the receiver's noise
    :param delay_s: s from the end of a packet's airtime to its reception
    """

    receiver: int
    channel: ChannelConfig
    delay_s: float = 0.0

    @property
    def level(self) -> float:
        """Power received over that of the noise; 1 on a channel without noise."""
        return 1.0 if self.channel.snr_db is None else float(10 ** (self.channel.snr_db / 10))


Paths = Sequence[Sequence[Path]]
"""For every robot the paths to those that can hear it. Robots below their noise are best left out."""
PathsAt = Callable[[float], Paths]
"""The paths at a time in s: the same object as long as no gain has changed."""


class Transmission(NamedTuple):
    """A packet on the air.

    :param sender: place of the robot among the robots of the medium
    :param number: counts the packets of this sender, from 0
    :param start, end: s; the gap after a burst is included
    :param rung: with an adaptive rate the rung that it is sent with
    """

    sender: int
    number: int
    data: bytes
    start: float
    end: float
    rung: int = 0

    def overlaps(self, other: Transmission) -> bool:
        """Whether both are on the air at the same time."""
        return self.start < other.end and other.start < self.end


class Reception(NamedTuple):
    """A packet that came out of a robot's receiver.

    :param at: s
    :param data: its bytes as received
    :param snr_db: of the burst at this receiver, dB; infinite without noise
    :param sinr_db: the same with all other bursts as noise, where they were strongest
    :param measured_db: SNR that the receiver itself has measured, dB; None where that is not simulated
    """

    receiver: int
    sent: Transmission
    at: float
    data: bytes
    snr_db: float = inf
    sinr_db: float = inf
    measured_db: float | None = None


class Medium(ABC):
    """What robots share. Subclasses say what arrives of one packet.

    :param paths: see :data:`PathsAt`
    :param shared: all robots use one channel: whoever sends hears nothing meanwhile, and packets that overlap at a
        receiver interfere. Otherwise every robot sends on a channel of its own, and hears while it sends
    :ivar lost: packets that one robot did not receive from another, by sender, receiver and reason: ``phy``,
        ``collision`` (it would have arrived without the others), ``sending`` (the receiver sent meanwhile), or the
        setting of the channel that dropped it
    """

    late = False
    """Whether receptions may come after their time, see :attr:`known_until`."""

    def __init__(self, paths: PathsAt, *, shared: bool) -> None:
        self.shared = shared
        self.lost: dict[tuple[int, int], Counter[str]] = defaultdict(Counter)
        self._paths_at = paths
        self._paths: Paths = ()
        self._near: dict[int, list[int]] = {}
        self._hears: dict[int, set[int]] = {}
        self._due: list[tuple[float, int, Transmission | Reception]] = []
        self._order = count()
        self._sent: Counter[int] = Counter()
        self._recent: dict[int, deque[Transmission]] = defaultdict(deque)
        self._longest = 0.0
        self._losses: dict[tuple[int, int], PduLosses] = {}

    def send(self, sender: int, data: bytes, start: float, airtime: float, rung: int = 0) -> Transmission:
        """Take a packet that starts at ``start`` s and lasts for ``airtime`` s."""
        sent = Transmission(sender, self._sent[sender], data, start, start + airtime, rung)
        self._sent[sender] += 1
        self._longest = max(self._longest, airtime)
        if self.shared:
            self._recent[sender].append(sent)
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
            if isinstance(item, Reception):
                yield item
                continue
            yield from self.passed(self.outcome(item))

    @abstractmethod
    def outcome(self, sent: Transmission) -> Iterable[tuple[Path, Reception]]:
        """What the receivers make of a packet whose airtime is over, before whole packets are dropped."""

    @property
    def known_until(self) -> float:
        """s, until when everything that was received is known; infinite where it is known at once."""
        return inf

    def rest(self) -> Iterator[Reception]:
        """What has been received and was not known at once. Nothing further is sent."""
        return iter(())

    def paths_of(self, sent: Transmission) -> Sequence[Path]:
        """The paths of a packet."""
        paths = self._paths_at(sent.start)
        if paths is not self._paths:
            self._paths = paths
            self._near.clear()
            self._hears.clear()
            for sender, heard in enumerate(paths):
                for path in heard:
                    self._hears.setdefault(path.receiver, set()).add(sender)
            self.paths_changed(paths)
        return paths[sent.sender]

    def paths_changed(self, paths: Paths) -> None:  # noqa: B027 - not every medium prepares something
        """Called before the first packet, and whenever a gain has changed."""

    def others(self, sent: Transmission) -> list[Transmission]:
        """The packets on the air meanwhile that matter to anybody who can hear ``sent``."""
        if not self.shared:
            return []
        near = self._near.get(sent.sender)
        if near is None:
            hearers = {path.receiver for path in self.paths_of(sent)}
            heard = (self._hears.get(receiver, set()) for receiver in hearers)
            near = self._near[sent.sender] = sorted(hearers.union(*heard) - {sent.sender})
        found = []
        for sender in (sent.sender, *near):
            recent = self._recent[sender]
            while recent and recent[0].end < sent.end - 2 * self._longest:
                recent.popleft()
            found += [other for other in takewhile(lambda one: one.start < sent.end, recent) if other.overlaps(sent)]
        return [other for other in found if other is not sent]

    def reaches(self, sent: Transmission, receiver: int) -> bool:
        """Whether a robot hears a packet, or sends it."""
        return receiver == sent.sender or sent.sender in self._hears.get(receiver, ())

    def passed(self, received: Iterable[tuple[Path, Reception]]) -> Iterator[Reception]:
        """Receptions, now or later, without those of packets that their path drops."""
        for path, reception in received:
            if path.channel.loses_packets and not self._losses_of(path, reception).passes(reception.at):
                continue
            if path.delay_s:
                later = reception._replace(at=reception.at + path.delay_s)
                heapq.heappush(self._due, (later.at, next(self._order), later))
            else:
                yield reception

    def _losses_of(self, path: Path, reception: Reception) -> PduLosses:
        key = reception.sent.sender, path.receiver
        losses = self._losses.get(key)
        if losses is None:
            losses = self._losses[key] = PduLosses(path.channel)
            losses.dropped = self.lost[key]
        return losses
