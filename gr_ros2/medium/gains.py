"""Levels that follow from gains between robots that stand still."""

from __future__ import annotations

from collections.abc import Sequence

from gr_ros2.medium.base import Path
from gr_ros2.medium.positions import LEAST_DB, MOST_DB
from gr_ros2.medium.propagation import snr_over_db
from gr_ros2.settings.config import ChannelConfig, replaced
from gr_ros2.wire import BROADCAST

Gains = float | Sequence[Sequence[float | None]] | None
"""dB: one for all, or a row for each robot with one for each other, None where nothing arrives; None: no levels."""
_SEEDS_APART = 7919


def paths_between(
    channel: ChannelConfig, gains_db: Gains, levels: Sequence[tuple[float, float]], bandwidth: float
) -> list[list[Path]]:
    """The paths between robots that all send and receive.

    :param channel: what all paths have in common; without gains also their level
    :param levels: power that each robot transmits, dBm, and noise figure of its receiver, dB
    :param bandwidth: of the noise, Hz
    """
    draws = channel.loses_packets or channel.doppler_hz
    paths: list[list[Path]] = []
    for number, (power, _) in enumerate(levels):
        paths.append([])
        for other, (_, figure) in enumerate(levels):
            snr_db = channel.snr_db
            if gains_db is not None:
                gain_db = gains_db if isinstance(gains_db, float | int) else gains_db[number][other]
                snr_db = None if gain_db is None else float(snr_over_db(gain_db, power, figure, bandwidth))
                if snr_db is None or snr_db < LEAST_DB:
                    continue
                snr_db = min(snr_db, MOST_DB)
            if other != number:
                seed = channel.seed + _SEEDS_APART * (1 + number * BROADCAST + other)
                same = snr_db == channel.snr_db and not draws
                paths[-1].append(Path(other, channel if same else replaced(channel, snr_db=snr_db, seed=seed)))
    return paths
