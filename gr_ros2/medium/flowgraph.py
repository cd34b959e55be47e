"""The medium for GNU Radio's stock blocks and those of others: packets through their own flowgraph.

Invariants: every robot has a channel of its own; packets go back to back through transmitter, channel and receiver, in
batches where nobody needs to know at once; each batch has its own noise and fading.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from math import inf

from gr_ros2.link.events import AirPacket
from gr_ros2.medium.base import Medium, Reception, Surroundings, Transmission
from gr_ros2.phy import Phy
from gr_ros2.settings.config import replaced

_BATCH_SEEDS = 7919
"""Distance between the seeds of two batches, so that no batch has the noise of a scenario with a neighbouring seed."""
_SEEDS = 2**31 - 1


class FlowgraphMedium(Medium):
    """See the module.

    :param phys: of every robot
    :param at_once: a packet's receptions are known when its airtime is over; otherwise when a batch is full, and then
        come late (:attr:`known_until`, :meth:`rest`)
    """

    def __init__(self, around: Surroundings, phys: Sequence[Phy], *, at_once: bool) -> None:
        super().__init__(around, shared=False)
        self._phys, self.late = phys, not at_once
        self._waiting: dict[int, list[Transmission]] = {}
        self._batches = 0

    def outcome(self, sent: Transmission) -> Iterator[Reception]:
        from gr_ros2.phy.measure import batch_of  # with GNU Radio

        waiting = self._waiting.setdefault(sent.sender, [])
        waiting.append(sent)
        if not self.late or len(waiting) == batch_of(self._phys[sent.sender]):
            yield from self._through(self._waiting.pop(sent.sender))

    @property
    def known_until(self) -> float:
        return min((waiting[0].end for waiting in self._waiting.values()), default=inf)

    def rest(self) -> Iterator[Reception]:
        while self._waiting:
            yield from self.passed(self._through(self._waiting.popitem()[1]))

    def _through(self, batch: Sequence[Transmission]) -> Iterator[Reception]:
        """What comes out of the flowgraphs for some packets of one sender."""
        from gr_ros2.phy.measure import deliver, modulated

        phy, data = self._phys[batch[0].sender], [sent.data for sent in batch]
        samples = modulated(phy, data)
        hearers = self.hearers(batch[0])
        for receiver, snr_db in zip(hearers.ids.tolist(), hearers.snr_db.tolist(), strict=True):
            path = self.around.path(batch[0].sender, receiver)
            phy.check_channel(path.channel)
            seed = (path.channel.seed + self._batches * _BATCH_SEEDS) % _SEEDS
            arrived = deliver(phy, samples, replaced(path.channel, seed=seed))
            came = list(zip(places(data, arrived), arrived, strict=True))
            whole = sum(data[place] == packet for place, packet in came)
            self.lost.add("phy", batch[0].sender, receiver, len(batch) - whole)
            for place, packet in came:
                sent = batch[place]
                yield Reception(receiver, sent, sent.end, AirPacket(packet, sent.start), snr_db, snr_db)
        self._batches += 1


def places(packets: Sequence[bytes], arrived: Sequence[bytes]) -> list[int]:
    """For each packet that arrived, in order, its index among the packets sent.

    A packet that does not equal any sent one was altered on the way: it gets the index after that of the previous
    arrival.
    """
    sent: dict[bytes, deque[int]] = {}
    for place, packet in enumerate(packets):
        sent.setdefault(packet, deque()).append(place)
    found, last = [], -1
    for packet in arrived:
        copies = sent.get(packet, deque())
        while copies and copies[0] <= last:
            copies.popleft()
        last = copies.popleft() if copies else min(last + 1, len(packets) - 1)
        found.append(last)
    return found
