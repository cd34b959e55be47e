"""Levels that follow from gains between robots that stand still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gr_ros2.settings.config import ChannelConfig
from gr_ros2.wire import BROADCAST
from gr_ros2_lab.medium.base import RadioPath
from gr_ros2_lab.medium.positions import LEAST_DB, MOST_DB
from gr_ros2_lab.medium.propagation import snr_over_db

Gains = float | Sequence[Sequence[float | None]] | None
"""dB: one for all, or a row for each robot with one for each other, None where nothing arrives; None: no levels."""
_SEEDS_APART = 7919


def all_paths(channel: ChannelConfig, robots: int, *, leveled: bool) -> list[list[RadioPath]]:
    """The paths between robots that all send and receive. Where they draw random numbers, each has its own seed.

    :param channel: what all paths have in common
    :param leveled: whether each gets a level of its own
    """
    apart = leveled or channel.loses_packets or bool(channel.doppler_hz)

    def between(number: int, other: int) -> ChannelConfig:
        return replace(channel, seed=channel.seed + _SEEDS_APART * (1 + number * BROADCAST + other))

    return [
        [RadioPath(other, between(number, other) if apart else channel) for other in range(robots) if other != number]
        for number in range(robots)
    ]


def at_gains(
    paths: Sequence[Sequence[RadioPath]], gains_db: Gains, levels: Sequence[tuple[float, float]], bandwidth: float
) -> list[list[RadioPath]]:
    """The paths of robots at the levels that follow from gains, without those on which nothing is heard.

    :param levels: power that each robot transmits, dBm, and noise figure of its receiver, dB
    :param bandwidth: of the noise, Hz
    """
    if gains_db is None:
        return [list(heard) for heard in paths]
    found: list[list[RadioPath]] = []
    for number, (heard, (power, _)) in enumerate(zip(paths, levels, strict=True)):
        found.append([])
        for path in heard:
            gain_db = gains_db if isinstance(gains_db, float | int) else gains_db[number][path.receiver]
            if gain_db is None:
                continue
            snr_db = float(snr_over_db(gain_db, power, levels[path.receiver][1], bandwidth))
            if snr_db >= LEAST_DB:
                found[-1].append(replace(path, channel=replace(path.channel, snr_db=min(snr_db, MOST_DB))))
    return found
