"""The medium at packets: each packet is lost as often as a table says that was measured on the PHY's flowgraph.

Where packets overlap at a receiver, the packet is cut into chunks during which the same packets are on the air. Of the
packets that survive the noise, the share that survives a chunk is what was measured beside one packet of the same power
that overlaps as much: at the beginning for the first chunk, else at the end (:mod:`.collision_table`).
Where nothing was measured (blocks of others, an adaptive rate), the others count as noise: PDR(SINR) ** (share of the
packet), over that without them.

Invariants: the work for a packet depends on the robots that hear it and on those that disturb them, not on how many
robots there are; equal seeds give equal fading, losses and errors of measurement for the same packets. Fading of an
adaptive rate is a function of time, and is the same for a whole packet, so it suits packets that are short against the
reciprocal of the Doppler shift. Fading of a fixed rate is in its table, as bursts of losses.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from itertools import pairwise
from typing import Any

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import AirPacket
from gr_ros2.link.losses import PduLosses
from gr_ros2.link.rate import Mcs
from gr_ros2.phy import Phy
from gr_ros2.settings.config import ChannelConfig, replaced
from gr_ros2_lab.medium.base import Hearers, Ints, Medium, Reception, Surroundings, Transmission
from gr_ros2_lab.medium.collision_table import SIRS_DB, CollisionTable, burst_s, collision_table
from gr_ros2_lab.medium.fading import RayleighFading
from gr_ros2_lab.medium.loss_table import LossCurve, packet_losses

_ERROR_DB = 1.0
"""Standard deviation of the SNR that a receiver measures on one preamble, dB."""
_CLEAR_DB = 60.0
"""SNR that a receiver measures where there is no noise, dB."""
_BARE: dict[str, Any] = {
    "snr_db": None,
    "doppler_hz": 0.0,
    "packet_loss": 0.0,
    "burst_loss": None,
    "outages": (),
    "seed": 0,
}
"""What the curve of a channel does not depend on."""
_LEAST = 1e-9
"""Smallest PDR by which another one is divided."""
_WEAK = 10 ** (SIRS_DB[-1] / 10)
"""Power of a packet over the interference from which on it takes no harm: the end of the tables."""
_HOPELESS = 1e-3
"""PDR without interference below which nobody asks what interference does."""
_BELOW, _ABOVE = 6.0, 10.0
"""Widths of an MCS from the SNR at which half of its packets arrive: below the first all are lost, above the second as
many as at the second."""


class _Reach:
    """What one sender's packets meet at its receivers, as long as nothing changes.

    :ivar groups: channels that differ in what a curve depends on
    :ivar kinds: the place in ``groups`` of each receiver's channel
    :ivar bursts: what decides for receivers whose losses have a memory, by place
    :ivar fading: by place
    :ivar clear: PDR of a packet by its MCS, where nothing disturbs it
    """

    def __init__(self, heard: Hearers, sender: int, around: Surroundings, phy: Phy) -> None:
        self.heard, self.sender, self.phy, self.mcs_table = heard, sender, phy, phy.mcs_table
        self.bursts: dict[int, PduLosses] = {}
        self.fading: dict[int, RayleighFading] = {}
        self.clear: dict[int, Floats] = {}
        ids = heard.ids.tolist()
        channels = [around.path(sender, receiver).channel for receiver in (ids[:1] if around.alike else ids)]
        for channel in set(channels):
            phy.check_channel(channel)
        bare = [replaced(channel, **_BARE) for channel in channels]
        self.groups = list(dict.fromkeys(bare))
        self.kinds = np.array([self.groups.index(channel) for channel in bare])
        self.fades = any(channel.doppler_hz for channel in channels)
        if self.fades and self.mcs_table:
            for place, receiver in enumerate(ids):
                channel = around.path(sender, receiver).channel
                if sum(tap != 0 for tap in channel.taps) > 1:
                    raise ConfigError(
                        "channel.taps: with rate: adaptive, a channel that fades has one tap; leave taps out"
                    )
                if channel.doppler_hz:
                    self.fading[place] = RayleighFading(channel.doppler_hz, channel.seed)

    def over(self, heard: Hearers) -> _Reach:
        """The same with other levels, where robots move."""
        reach = copy(self)
        reach.heard, reach.clear = heard, {}
        return reach


class PacketMedium(Medium):
    """Loses packets as often as the tables of their PHYs say.

    :param phys: of every robot
    :param seed: of the losses of the PHY
    :param ideal: the PHY loses nothing; only the settings of the channels that drop whole packets do
    :raises ConfigError: at the first packet, for a channel that is not simulated at packets
    """

    def __init__(
        self, around: Surroundings, phys: Sequence[Phy], *, shared: bool = False, seed: int = 0, ideal: bool = False
    ) -> None:
        super().__init__(around, shared=shared)
        self._phys, self._ideal = phys, ideal
        self._random = [np.random.default_rng([seed, 1, sender]) for sender in range(len(phys))]
        self._reach: dict[int, _Reach] = {}
        self._curves: dict[Any, LossCurve] = {}
        self._tables: dict[Any, CollisionTable | None] = {}
        self._gaps: dict[Phy, float] = {}
        self.examined = 0
        """Pairs of a packet and a receiver, and of a packet and another one, that were looked at."""

    def outcome(self, sent: Transmission) -> list[Reception]:
        heard = self.hearers(sent)
        if not len(heard.ids):
            return []
        reach = self._reached(sent, heard)
        others = self.others(sent)
        self.examined += len(heard.ids) + len(others)
        if heard.noiseless and self._certain(reach):
            return self._in_reach(sent, heard, others)
        draw = self._random[sent.sender]
        chances, errors = draw.random(len(heard.ids)), draw.normal(0, _ERROR_DB, len(heard.ids))
        levels = heard.levels
        if reach.fading:
            levels = levels.copy()
            for place, fading in reach.fading.items():
                levels[place] *= 10 ** (fading.gain_db(sent.end) / 10)
        clear = self._clear(reach, sent, levels)
        alone = chances < clear
        for place, bursts in reach.bursts.items():
            alone[place] = bursts.passes(sent.end)
        arrived, busy = alone, np.zeros(len(alone), bool)
        snrs = sinrs = heard.snr_db if levels is heard.levels else _in_db(levels, heard.noise)
        if others:
            deaf = np.array(self._deaf(reach, sent, others), int)
            busy = (heard.ids[:, None] == deaf).any(1)
            # Interference is of interest where the packet would arrive without it.
            places = np.flatnonzero(alone & ~busy)
            pdr, worst = self._disturbed(reach, sent, (places, levels[places], clear[places]), others)
            sinrs = snrs.copy()
            sinrs[places] = _in_db(levels[places], heard.noise[places] + worst)
            arrived = np.zeros(len(alone), bool)
            arrived[places] = chances[places] < pdr
        if not arrived.all():
            self.lost.add("phy", sent.sender, heard.ids[~alone & ~busy])
            self.lost.add("collision", sent.sender, heard.ids[alone & ~arrived & ~busy])
            self.lost.add("sending", sent.sender, heard.ids[busy])
        rows = (heard.ids, snrs, sinrs, np.where(heard.noise > 0, snrs + errors, _CLEAR_DB))
        return [
            Reception(receiver, sent, sent.end, AirPacket(sent.data, sent.start, snr_db=measured_db), snr_db, sinr_db)
            for receiver, snr_db, sinr_db, measured_db in zip(*(row[arrived].tolist() for row in rows), strict=True)
        ]

    def _in_reach(self, sent: Transmission, heard: Hearers, others: Sequence[Transmission]) -> list[Reception]:
        """The outcome where nothing is known of levels: whoever hears one packet alone receives it."""
        receivers = heard.receivers
        if others:
            end = self._end(sent)
            others = [other for other in others if other.start < end and sent.start < self._end(other)]
            sending = {other.sender for other in others}
            disturbed = {one for other in others for one in self.around.hearers(other.sender, sent.start).receivers}
            for reason, ones in (("sending", sending), ("collision", disturbed - sending)):
                lost = [receiver for receiver in receivers if receiver in ones]
                if lost:
                    self.lost.add(reason, sent.sender, lost)
            receivers = [one for one in receivers if one not in sending and one not in disturbed]
        packet = AirPacket(sent.data, sent.start, snr_db=_CLEAR_DB)
        return [Reception(one, sent, sent.end, packet) for one in receivers]

    def _reached(self, sent: Transmission, heard: Hearers) -> _Reach:
        known = self._reach.get(sent.sender)
        if known is None or (known.heard is not heard and known.fading):
            known = _Reach(heard, sent.sender, self.around, self._phys[sent.sender])
        elif known.heard is not heard:
            known = known.over(heard)
        self._reach[sent.sender] = known
        return known

    def _certain(self, reach: _Reach) -> bool:
        """Whether the PHY loses nothing where nothing disturbs."""
        return self._ideal or not reach.phy.has_samples

    def _clear(self, reach: _Reach, sent: Transmission, levels: Floats) -> Floats:
        """PDR of a packet where nothing disturbs it."""
        if self._certain(reach):
            return np.ones(len(levels))
        if not reach.mcs_table and not self.shared and not self.around.moves:
            return self._fixed(reach)
        if not reach.mcs_table and reach.fades:
            raise ConfigError(
                "channel.doppler_hz: on a channel that fades and is shared, or whose levels change, packets of a fixed "
                "rate are not simulated at packets; set time to samples"
            )
        if reach.fading:
            return self._on_curves(reach, sent, _in_db(levels, reach.heard.noise))
        known = reach.clear.get(sent.mcs)
        if known is None:
            known = reach.clear[sent.mcs] = self._on_curves(reach, sent, reach.heard.snr_db)
        return known

    def _fixed(self, reach: _Reach) -> Floats:
        """The PDR of a fixed rate, from the points of its table next to each SNR."""
        known = reach.clear.get(0)
        if known is None:
            known = reach.clear[0] = np.ones(len(reach.heard.ids))
            for place, receiver in enumerate(reach.heard.ids.tolist()):
                losses = packet_losses(reach.phy, self.around.path(reach.sender, receiver).channel)
                known[place] -= losses.packet_loss
                if losses.burst_loss is not None:
                    reach.bursts[place] = PduLosses(losses)
        return known

    def _on_curves(self, reach: _Reach, sent: Transmission, sinrs_db: Floats) -> Floats:
        pdr = np.ones(len(sinrs_db))
        for kind, channel in enumerate(reach.groups):
            places = slice(None) if len(reach.groups) == 1 else reach.kinds == kind
            pdr[places] = self._curve(reach, sent, channel).pdr(sinrs_db[places])
        return pdr

    def _curve(self, reach: _Reach, sent: Transmission, channel: ChannelConfig) -> LossCurve:
        key = reach.phy, sent.mcs, channel
        curve = self._curves.get(key)
        if curve is None:
            limits = limits_of(reach.mcs_table[sent.mcs]) if reach.mcs_table else None
            curve = self._curves[key] = LossCurve(reach.phy.on_mcs(sent.mcs), channel, limits)
        return curve

    def _disturbed(
        self, reach: _Reach, sent: Transmission, at: tuple[Ints, Floats, Floats], others: Sequence[Transmission]
    ) -> tuple[Floats, Floats]:
        """PDR of a packet that others overlap, and the power of those others where they were strongest.

        :param at: places of the receivers in question, their levels, and their PDRs without interference
        """
        places, levels, clear = at
        if not len(places):
            return clear, levels
        ids = reach.heard.ids[places]
        bursts = [(other.start, self._end(other)) for other in others]
        powers = [self.around.hearers(other.sender, sent.start).at[ids] for other in others]
        begin_s, end_s = sent.start, self._end(sent)
        edges = {min(max(edge, begin_s), end_s) for burst in bursts for edge in burst}
        pdr, worst = clear.copy(), np.zeros(len(levels))
        for begin, end in pairwise(sorted({begin_s, end_s} | edges)):
            power = np.zeros(len(levels))
            for (first, last), added in zip(bursts, powers, strict=True):
                if first < end and begin < last:
                    power += added
            np.maximum(worst, power, out=worst)
            hit = np.flatnonzero((power * _WEAK > levels) & (clear > _HOPELESS))
            if len(hit):
                share = (end - begin) / (end_s - begin_s)
                offset = share - 1 if begin == begin_s else 1 - share
                pdr[hit] *= self._survival(reach, sent, places[hit], levels[hit], power[hit], offset=offset)
        return pdr, worst

    def _survival(
        self, reach: _Reach, sent: Transmission, hit: Ints, levels: Floats, power: Floats, *, offset: float
    ) -> Floats:
        """Share of the packets that survive interference during part of them, of those that survive the noise.

        :param hit: places of the receivers
        :param power: of the interference over that of the noise
        :param offset: as in :meth:`CollisionTable.survival`
        """
        if self._certain(reach):
            return np.zeros(len(hit))  # nothing is known of a level: packets that overlap are lost
        noise = reach.heard.noise[hit]
        survival = np.ones(len(hit))
        for kind, channel in enumerate(reach.groups):
            places = slice(None) if len(reach.groups) == 1 else np.flatnonzero(reach.kinds[hit] == kind)
            one, beside = levels[places], power[places]
            table = self._table(reach.phy.on_mcs(sent.mcs), channel, measured=not reach.mcs_table)
            if table is not None:
                snrs_db = _in_db(one, noise[places])
                survival[places] = table.survival(snrs_db, np.asarray(10 * np.log10(one / beside)), offset)
            else:  # as if it were noise
                curve = self._curve(reach, sent, channel)
                alone = np.maximum(curve.pdr(_in_db(one, noise[places])), _LEAST)
                survival[places] = (curve.pdr(_in_db(one, noise[places] + beside)) / alone) ** (1 - abs(offset))
        return survival

    def _deaf(self, reach: _Reach, sent: Transmission, others: Sequence[Transmission]) -> list[int]:
        """The robots that send while a packet is on the air, and so long that they miss too much of it."""
        begin, end = sent.start, self._end(sent)
        for channel in () if self._certain(reach) else reach.groups:
            table = self._table(reach.phy.on_mcs(sent.mcs), channel, measured=not reach.mcs_table)
            if table is not None:
                length = end - begin
                begin, end = begin + table.edges[0] * length, end - table.edges[1] * length
                break
        return [other.sender for other in others if other.start < end and begin < self._end(other)]

    def _table(self, phy: Phy, channel: ChannelConfig, *, measured: bool) -> CollisionTable | None:
        key = phy, channel
        if key not in self._tables:
            self._tables[key] = collision_table(phy, channel, measured=measured)
        return self._tables[key]

    def _end(self, sent: Transmission) -> float:
        """s, when the burst of a packet ends; its airtime includes a gap after that."""
        phy = self._phys[sent.sender].on_mcs(sent.mcs)
        if phy not in self._gaps:
            self._gaps[phy] = 0.0 if phy.burst_modem is None else phy.airtime() - burst_s(phy)
        return sent.end - self._gaps[phy]


def _in_db(levels: Floats, noise: Floats) -> Floats:
    """Levels over noise in dB; infinite where there is none."""
    with np.errstate(divide="ignore"):
        return np.asarray(10 * np.log10(levels / noise))


def limits_of(mcs: Mcs) -> tuple[float, float]:
    """The SNRs in dB between which the losses of an MCS are measured."""
    return mcs.half_db - _BELOW * mcs.width_db, mcs.half_db + _ABOVE * mcs.width_db
