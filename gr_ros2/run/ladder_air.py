"""The simulated channel of a PHY with an adaptive rate: each packet is lost as its rung loses packets at the SNR of its
moment.

Invariants: equal seeds give equal fading, losses and errors of measurement for the same order of packets. Fading is a
function of time: it also goes on while nothing is sent, and is the same for a whole packet. So it suits packets that
are short against the reciprocal of the Doppler shift.
"""

from __future__ import annotations

import math
import random
from collections import Counter

from gr_ros2.config import ChannelConfig, replaced
from gr_ros2.errors import ConfigError
from gr_ros2.link.rate import Rung
from gr_ros2.phy import Phy
from gr_ros2.run.loss_table import LossTable, snrs_of, table_for
from gr_ros2.run.simulate import Arrival

_ERROR_DB = 1.0
"""Standard deviation of the SNR that a receiver measures on one preamble, dB."""
_CLEAR_DB = 60.0
"""SNR that a receiver measures where there is no noise, dB."""
_BELOW, _ABOVE = 6.0, 10.0
"""Widths of a rung from the SNR at which half of its packets arrive: below the first all are lost, above the second as
many as at the second."""
PACKETS = 300
"""Packets sent at each SNR when a point is measured."""
_SINUSOIDS = 32
_SEEDS_APART = 7919


class RayleighFading:
    """Flat fading with the classical Doppler spectrum, as a sum of sinusoids (Clarke, 1968; Jakes, 1974).

    :param doppler_hz: largest Doppler shift, Hz
    """

    def __init__(self, doppler_hz: float, seed: int) -> None:
        draw = random.Random(f"fading {seed}")
        turn = 2 * math.pi
        self._waves = [
            (turn * doppler_hz * math.cos(turn * draw.random()), turn * draw.random()) for _ in range(_SINUSOIDS)
        ]

    def gain_db(self, now: float) -> float:
        """Power gain at a time in s, dB; its mean power is 1."""
        real = sum(math.cos(pulse * now + phase) for pulse, phase in self._waves)
        imaginary = sum(math.sin(pulse * now + phase) for pulse, phase in self._waves)
        return 10 * math.log10(max((real**2 + imaginary**2) / _SINUSOIDS, 1e-12))


def limits(rung: Rung) -> tuple[float, float]:
    """The SNRs in dB between which the losses of a rung are measured."""
    return rung.half_db - _BELOW * rung.width_db, rung.half_db + _ABOVE * rung.width_db


class LadderAir:
    """The channel.

    :param phy: a PHY with an adaptive rate
    :param samples: whether each packet goes through the modem of its rung; otherwise it is lost as measured for packets
        of that rung
    :ivar lost: packets that the PHY lost
    :raises ConfigError: for a channel with echoes that fade: only flat fading is simulated here
    """

    def __init__(self, phy: Phy, channel: ChannelConfig, *, samples: bool) -> None:
        phy.check_channel(channel)
        if channel.doppler_hz and sum(tap != 0 for tap in channel.taps) > 1:
            raise ConfigError("channel.taps: with rate: adaptive, a channel that fades has one tap; leave taps out")
        self.lost: Counter[str] = Counter()
        self._phy, self._ladder, self._samples = phy, phy.ladder, samples
        self._mean_db = channel.snr_db
        self._fading = RayleighFading(channel.doppler_hz, channel.seed) if channel.doppler_hz else None
        self._calm = replaced(channel, doppler_hz=0.0, snr_db=None)
        self._random = random.Random(channel.seed + _SEEDS_APART)
        self._tables: dict[int, LossTable] = {}
        self._sent = 0

    def through(self, data: bytes, rung: int, now: float) -> list[Arrival]:
        """What arrives of a packet.

        :param now: s since the run began
        """
        snr_db = self._mean_db
        if snr_db is not None and self._fading is not None:
            snr_db += self._fading.gain_db(now)
        chance, error_db = self._random.random(), self._random.gauss(0, _ERROR_DB)
        arrived = self._demodulated(data, rung, snr_db) if self._samples else self._drawn(data, rung, snr_db, chance)
        self.lost["phy"] += data not in arrived
        measured_db = _CLEAR_DB if snr_db is None else snr_db + error_db
        return [Arrival(packet, measured_db) for packet in arrived]

    def _demodulated(self, data: bytes, rung: int, snr_db: float | None) -> list[bytes]:
        from gr_ros2.phy.measure import BatchChannel  # with GNU Radio

        self._sent += 1
        channel = replaced(self._calm, snr_db=snr_db, seed=self._calm.seed + self._sent * _SEEDS_APART)
        return [packet for _, packet in BatchChannel(self._phy.rungs[rung], channel).send([data])]

    def _drawn(self, data: bytes, rung: int, snr_db: float | None, chance: float) -> list[bytes]:
        if snr_db is not None:
            low_db, high_db = limits(self._ladder[rung])
            if snr_db < low_db:
                return []
            snr_db = min(snr_db, high_db)
        return [] if chance < self._losses(rung, snr_db) else [data]

    def _losses(self, rung: int, snr_db: float | None) -> float:
        """Share of the packets of a rung that are lost at an SNR."""
        needed = replaced(self._calm, snr_db=snr_db)
        table = self._tables.get(rung)
        if table is None or not snrs_of(needed) <= table.points.keys():
            found = table_for(self._phy.rungs[rung], needed, snrs_of(needed), packets=PACKETS)
            if table is not None:
                found.points.update(table.points)
            table = self._tables[rung] = found
        return table.losses(snr_db)[0]
