"""The medium for GNU Radio's stock blocks and those of others: packets through their own flowgraph.

Invariants: every robot has a channel of its own; packets go back to back through transmitter, channel and receiver, in
batches as far as is known what comes next; each batch has its own noise and fading. A flowgraph of its own for each
packet would take 22 to 30 times as long as a batch: 100 ms for one of 64 bytes through the stock OFDM blocks.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence

from gr_ros2.link.events import AirPacket
from gr_ros2.phy import Phy
from gr_ros2.settings.config import replaced
from gr_ros2_lab.medium.base import Medium, Reception, Surroundings, Transmission

_BATCH_SEEDS = 7919
"""Distance between the seeds of two batches, so that no batch has the noise of a scenario with a neighbouring seed."""
_SEEDS = 2**31 - 1


class FlowgraphMedium(Medium):
    """Carries packets through the blocks of a PHY in a flowgraph of its own.

    :param phys: of every robot
    :param ahead: what the robots are going to send, in order, as far as it can be known: where nobody answers. What it
        leaves out passes one by one
    """

    def __init__(self, around: Surroundings, phys: Sequence[Phy], ahead: Iterable[Transmission] = ()) -> None:
        super().__init__(around, shared=False)
        self._phys = phys
        self._ahead = iter(ahead)
        self._coming: defaultdict[int, deque[Transmission]] = defaultdict(deque)
        """What robots send next."""
        self._arrived: dict[Transmission, list[tuple[int, float, list[bytes]]]] = {}
        """What has passed, until its airtime is over: each receiver, its SNR in dB, and what came out there."""
        self._batches = 0

    def outcome(self, sent: Transmission) -> Iterator[Reception]:
        if sent not in self._arrived:
            batch = self._next(sent.sender)
            self._through(batch if sent in batch else [sent])
        for receiver, snr_db, packets in self._arrived.pop(sent):
            if sent.data not in packets:
                self.lost.add("phy", sent.sender, receiver)
            for packet in packets:
                yield Reception(receiver, sent, sent.end, AirPacket(packet, sent.start), snr_db, snr_db)

    def _next(self, sender: int) -> list[Transmission]:
        """A batch of what a robot sends next."""
        from gr_ros2.phy.measure import batch_of  # with GNU Radio

        coming, most = self._coming[sender], batch_of(self._phys[sender])
        while len(coming) < most and (after := next(self._ahead, None)) is not None:
            self._coming[after.sender].append(after)
        return [coming.popleft() for _ in range(min(len(coming), most))]

    def _through(self, batch: Sequence[Transmission]) -> None:
        """Send packets of one robot through the flowgraphs."""
        from gr_ros2.phy.measure import deliver, modulated

        phy, data = self._phys[batch[0].sender], [sent.data for sent in batch]
        samples = modulated(phy, data)
        self._arrived |= {sent: [] for sent in batch}
        hearers = self.hearers(batch[0])
        for receiver, snr_db in zip(hearers.ids.tolist(), hearers.snr_db.tolist(), strict=True):
            path = self.around.path(batch[0].sender, receiver)
            phy.check_channel(path.channel)
            seed = (path.channel.seed + self._batches * _BATCH_SEEDS) % _SEEDS
            arrived = deliver(phy, samples, replaced(path.channel, seed=seed))
            came: list[list[bytes]] = [[] for _ in batch]
            for place, packet in zip(places(data, arrived), arrived, strict=True):
                came[place].append(packet)
            for sent, packets in zip(batch, came, strict=True):
                self._arrived[sent].append((receiver, snr_db, packets))
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
