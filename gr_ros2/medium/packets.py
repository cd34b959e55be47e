"""The medium at packets: each packet is lost as often as a table says that was measured on the PHY's flowgraph.

Where packets overlap at a receiver, the others count as noise: the packet is cut into chunks during which the same
packets are on the air, and arrives with the product over its chunks of PDR(SINR) ** (share of the packet).

Invariants: the work for a packet depends on the robots that hear it and on those that disturb them, not on how many
robots there are; equal seeds give equal fading, losses and errors of measurement for the same packets. Fading of an
adaptive rate is a function of time, and is the same for a whole packet, so it suits packets that are short against the
reciprocal of the Doppler shift. Fading of a fixed rate is in its table, as bursts of losses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.losses import PduLosses
from gr_ros2.link.rate import Rung
from gr_ros2.medium.base import Medium, Path, Paths, PathsAt, Reception, Transmission
from gr_ros2.medium.fading import RayleighFading
from gr_ros2.medium.loss_table import LossCurve, packet_losses
from gr_ros2.phy import Phy
from gr_ros2.settings.config import ChannelConfig, replaced

Floats = NDArray[np.float64]

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
_BELOW, _ABOVE = 6.0, 10.0
"""Widths of a rung from the SNR at which half of its packets arrive: below the first all are lost, above the second as
many as at the second."""


class _Hearers:
    """The receivers of one sender.

    :ivar levels: power received over that of the noise
    :ivar noise: 1, or 0 where a channel has no noise
    :ivar bursts: what decides for receivers whose losses have a memory, by place
    :ivar fading: by place
    :ivar clear: PDR of a packet by its rung, where nothing disturbs it
    """

    def __init__(self, paths: Sequence[Path], phy: Phy) -> None:
        self.paths, self.phy, self.ladder = paths, phy, phy.ladder
        self.ids = np.array([path.receiver for path in paths], int)
        self.levels = np.array([path.level for path in paths])
        self.noise = np.array([path.channel.snr_db is not None for path in paths], float)
        self.bursts: dict[int, PduLosses] = {}
        self.fading: dict[int, RayleighFading] = {}
        self.clear: dict[int, Floats] = {}
        self.alike: dict[ChannelConfig, list[int]] = {}
        """The places of the paths that differ only in what a curve does not depend on."""
        for place, path in enumerate(paths):
            phy.check_channel(path.channel)
            self.alike.setdefault(replaced(path.channel, **_BARE), []).append(place)
            if path.channel.doppler_hz and self.ladder:
                if sum(tap != 0 for tap in path.channel.taps) > 1:
                    raise ConfigError(
                        "channel.taps: with rate: adaptive, a channel that fades has one tap; leave taps out"
                    )
                self.fading[place] = RayleighFading(path.channel.doppler_hz, path.channel.seed)


class PacketMedium(Medium):
    """See the module.

    :param phys: of every robot
    :param seed: of the losses of the PHY
    :param ideal: the PHY loses nothing; only the settings of the channels that drop whole packets do
    :raises ConfigError: at the first packet, for a channel that is not simulated at packets
    """

    def __init__(
        self, paths: PathsAt, phys: Sequence[Phy], *, shared: bool = False, seed: int = 0, ideal: bool = False
    ) -> None:
        super().__init__(paths, shared=shared)
        self._phys, self._ideal = phys, ideal
        self._random = [np.random.default_rng([seed, 1, sender]) for sender in range(len(phys))]
        self._hearers: dict[int, _Hearers] = {}
        self._curves: dict[Any, LossCurve] = {}
        self._levels = np.zeros((0, 0))
        self.examined = 0
        """Pairs of a packet and a receiver, and of a packet and another one, that were looked at."""

    def paths_changed(self, paths: Paths) -> None:
        self._hearers.clear()
        self._levels = np.zeros((len(paths), len(paths)))
        for sender, heard in enumerate(paths):
            for path in heard:
                self._levels[sender, path.receiver] = path.level

    def outcome(self, sent: Transmission) -> Iterator[tuple[Path, Reception]]:
        paths = self.paths_of(sent)
        hearers = self._hearers.get(sent.sender)
        if hearers is None:
            hearers = self._hearers[sent.sender] = _Hearers(paths, self._phys[sent.sender])
        if not len(hearers.ids):
            return
        draw = self._random[sent.sender]
        chances, errors = draw.random(len(hearers.ids)), draw.normal(0, _ERROR_DB, len(hearers.ids))
        levels = hearers.levels
        if hearers.fading:
            levels = levels.copy()
            for place, fading in hearers.fading.items():
                levels[place] *= 10 ** (fading.gain_db(sent.end) / 10)
        clear = self._clear(hearers, sent, levels)
        others = self.others(sent)
        self.examined += len(hearers.ids) + len(others)
        pdr, worst = (clear, np.zeros(len(clear))) if not others else self._disturbed(hearers, sent, levels, others)
        busy = np.isin(hearers.ids, [other.sender for other in others])
        with np.errstate(divide="ignore"):
            snrs = np.where(hearers.noise > 0, 10 * np.log10(levels), inf)
            sinrs = 10 * np.log10(levels / (hearers.noise + worst))
        alone = chances < clear
        for place, bursts in hearers.bursts.items():
            alone[place] = bursts.passes(sent.end)
        arrived = alone & (chances < pdr) & ~busy if others else alone
        for place in np.flatnonzero(~arrived).tolist():
            reason = "sending" if busy[place] else "collision" if alone[place] else "phy"
            self.lost[sent.sender, int(hearers.ids[place])][reason] += 1
        for place in np.flatnonzero(arrived).tolist():
            path, snr_db, sinr_db = hearers.paths[place], float(snrs[place]), float(sinrs[place])
            measured_db = _CLEAR_DB if snr_db == inf else snr_db + float(errors[place])
            yield path, Reception(path.receiver, sent, sent.end, sent.data, snr_db, sinr_db, measured_db)

    def _clear(self, hearers: _Hearers, sent: Transmission, levels: Floats) -> Floats:
        """PDR of a packet where nothing disturbs it."""
        phy = hearers.phy
        if self._ideal or not phy.has_samples:
            return np.ones(len(levels))
        if not hearers.ladder and not self.shared:
            return self._fixed(hearers)
        if not hearers.ladder and any(path.channel.doppler_hz for path in hearers.paths):
            raise ConfigError(
                "channel.doppler_hz: on a shared channel that fades, packets of a fixed rate are not simulated at "
                "packets; set time to samples"
            )
        if hearers.fading:
            return self._on_curves(hearers, sent, np.where(hearers.noise > 0, levels, inf))
        known = hearers.clear.get(sent.rung)
        if known is None:
            known = self._on_curves(hearers, sent, np.where(hearers.noise > 0, levels, inf))
            hearers.clear[sent.rung] = known
        return known

    def _fixed(self, hearers: _Hearers) -> Floats:
        """The PDR of a fixed rate, from the points of its table next to each SNR."""
        known = hearers.clear.get(0)
        if known is None:
            known = hearers.clear[0] = np.ones(len(hearers.paths))
            for place, path in enumerate(hearers.paths):
                losses = packet_losses(hearers.phy, path.channel)
                known[place] -= losses.packet_loss
                if losses.burst_loss is not None:
                    hearers.bursts[place] = PduLosses(losses)
        return known

    def _on_curves(self, hearers: _Hearers, sent: Transmission, sinrs: Floats) -> Floats:
        """PDR at these power ratios."""
        pdr = np.ones(len(sinrs))
        with np.errstate(divide="ignore"):
            sinrs_db = 10 * np.log10(sinrs)
        for channel, places in hearers.alike.items():
            key = hearers.phy, sent.rung, channel
            curve = self._curves.get(key)
            if curve is None:
                limits = limits_of(hearers.ladder[sent.rung]) if hearers.ladder else None
                curve = self._curves[key] = LossCurve(hearers.phy.on_rung(sent.rung), channel, limits)
            pdr[places] = curve.pdr(sinrs_db[places])
        return pdr

    def _disturbed(
        self, hearers: _Hearers, sent: Transmission, levels: Floats, others: Sequence[Transmission]
    ) -> tuple[Floats, Floats]:
        """PDR of a packet that others overlap, and the power of those others where they were strongest."""
        edges = {sent.start, sent.end}
        for other in others:
            edges |= {max(sent.start, other.start), min(sent.end, other.end)}
        times = sorted(edges)
        pdr, worst = np.ones(len(levels)), np.zeros(len(levels))
        for begin, end in pairwise(times):
            power = np.zeros(len(levels))
            for other in others:
                if other.start < end and begin < other.end:
                    power += self._levels[other.sender, hearers.ids]
            worst = np.maximum(worst, power)
            share = (end - begin) / (sent.end - sent.start)
            with np.errstate(divide="ignore"):
                sinrs = levels / (hearers.noise + power)
            pdr *= self._chunk(hearers, sent, sinrs, power) ** share
        return pdr, worst

    def _chunk(self, hearers: _Hearers, sent: Transmission, sinrs: Floats, power: Floats) -> Floats:
        """PDR of a packet if it were like this chunk from end to end."""
        if not hearers.phy.has_samples or self._ideal:
            return np.where(power > 0, 0.0, 1.0)  # nothing is known of a level: packets that overlap are lost
        return self._on_curves(hearers, sent, sinrs)


def limits_of(rung: Rung) -> tuple[float, float]:
    """The SNRs in dB between which the losses of a rung are measured."""
    return rung.half_db - _BELOW * rung.width_db, rung.half_db + _ABOVE * rung.width_db
