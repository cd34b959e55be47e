"""The receiver of a burst modem: samples in, packets with their times out.

Invariant: an error of the modem costs the packets of the samples in which it happened, and nothing else.
"""

from __future__ import annotations

import logging

import numpy as np

from gr_ros2.link.events import AirPacket
from gr_ros2.phy.burst import BurstModem, BurstReceiver, DemodulatedPacket, Samples
from gr_ros2.phy.stream_times import StreamTimes

_log = logging.getLogger(__name__)


class Demodulation:
    """Samples in, packets out, with their times.

    :param lag: see :attr:`gr_ros2.phy.base.Phy.lag`
    :param gap: zero samples after each burst
    :ivar times: when the samples were on the air; whoever feeds them says so
    """

    def __init__(self, modem: BurstModem, lag: int, gap: int, sample_rate: float) -> None:
        self._modem = modem
        self._engine: BurstReceiver | None = None
        self._damaged = 0
        self._failed = False
        self._snr_db: float | None = None
        self._first = 0
        """Number of the first sample that the engine was fed."""
        self.fed = 0
        """Number of samples that have come since the start."""
        self._lag, self._slack = lag, gap // 2
        self.times = StreamTimes(sample_rate)

    @property
    def damaged(self) -> int:
        """Bursts found whose CRC-32 was wrong."""
        return self._damaged + (self._engine.damaged if self._engine is not None else 0)

    @property
    def snr_db(self) -> float | None:
        """SNR over the sampled band of the newest packets, dB; None before the first."""
        engine = self._engine
        return self._snr_db if engine is None else engine.snr_db

    def points(self) -> Samples:
        """The constellation points of the newest packet; empty before the first."""
        engine = self._engine
        return np.empty(0, np.complex64) if engine is None else engine.points

    def start(self) -> None:
        """Samples come, counted anew."""
        self._engine = self._modem.receiver()
        self._first = self.fed = 0

    def stop(self) -> None:
        """No more samples come."""
        self._damaged, self._snr_db, self._engine = self.damaged, self.snr_db, None

    def feed(self, samples: Samples) -> list[AirPacket]:
        """The packets that the next samples complete."""
        assert self._engine is not None
        self.fed += len(samples)
        try:
            return [self._on_air(packet) for packet in self._engine.feed(samples)]
        except Exception as error:  # noqa: BLE001 - an exception would end the thread that feeds, and all reception
            if not self._failed:
                self._failed = True
                _log.exception("%s: starts again after %s", type(self._modem).__name__, error)
            self.stop()
            self._engine = self._modem.receiver()
            self._first = self.fed
            return []

    def _on_air(self, packet: DemodulatedPacket) -> AirPacket:
        modem = self._modem.rates[packet.mcs]
        end = self._first + packet.end
        first = end - self._lag - modem.samples_of(len(packet.data))
        mcs = packet.mcs if len(self._modem.rates) > 1 else None
        return AirPacket(packet.data, self.times.at(first, end, self._slack), mcs=mcs, snr_db=packet.snr_db)
