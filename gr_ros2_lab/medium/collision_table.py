"""How often a packet survives another one on the same channel: the collisions of ``time: packets``.

A table has, for one PHY, packet length and channel, the share of packets that arrived beside one other packet: by SNR,
by signal-to-interference ratio (SIR), and by when the other one began. It replaces the assumption that interference
acts like noise: what it does depends on its spectrum, on which part of a packet it meets, and on which of two preambles
a receiver follows.

Invariants: every number is measured with the modem of the PHY; the same setting gives the same table on every machine.
Tables are stored in the package and in the user's cache folder; one that is in neither is measured on demand.
"""

from __future__ import annotations

import json
import logging
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.phy import Phy
from gr_ros2.settings.config import ChannelConfig, replaced
from gr_ros2_lab.medium.base import FixedPaths, RadioPath
from gr_ros2_lab.medium.loss_table import BUILTIN_DIR, alone, cache_dir, named, program, setting_of, write_rows
from gr_ros2_lab.medium.samples import SampleMedium

OFFSETS = (-0.97, -0.9, -0.75, -0.5, -0.25, -0.1, -0.04, -0.01, 0.0, 0.01, 0.04, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)
"""When the other packet begins, in lengths of the burst after the packet; at -1 and 1 they do not overlap."""
_ALL_OFFSETS = np.array([-1.0, *OFFSETS, 1.0])
"""With those at which nothing overlaps."""
SIRS_DB = tuple(range(-8, 18))
ABOVE_DB = (0.0, 1.5, 3.0, 4.5, 6.0, 9.0, 14.0, 30.0)
"""SNRs of a table, over that at which an ideal receiver gets half of the packets, dB."""
PACKETS = 40
"""Packets at each point. Eight points around a place are interpolated."""
_COARSE = 5
_EDGE, _EDGE_PACKETS = 0.002, 20
"""How exactly the edges of a burst are found, and by how many packets at each step."""
_SURE = 1.0 / PACKETS
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CollisionTable:
    """The measured shares of one setting.

    :param setting: what they depend on, see :func:`gr_ros2_lab.medium.loss_table.setting_of`
    :param snrs_db: from the lowest to the highest
    :param delivered: of ``sent`` packets at each point, shape (snrs, sirs, offsets)
    :param edges: shares of a burst at its beginning and at its end that a receiver can do without, because it sends
        itself meanwhile: half of the packets then arrive
    """

    setting: dict[str, Any]
    snrs_db: tuple[float, ...]
    sent: int
    delivered: Floats
    edges: tuple[float, float]

    @cached_property
    def odds(self) -> Floats:
        """Log-odds of delivery at each point and where nothing overlaps, shape (snrs, sirs, ``_ALL_OFFSETS``)."""
        shares = (self.delivered + _SURE / 2) / (self.sent + _SURE)
        sides = np.repeat(shares[:, -1:].max(2, keepdims=True), shares.shape[1], 1)
        whole = np.concatenate([sides, shares, sides], 2)
        return np.asarray(np.log(whole / (1 - whole)))

    def survival(self, snrs_db: Floats, sirs_db: Floats, offset: float) -> Floats:
        """Share of the packets that arrive alone which also arrive beside another one.

        :param snrs_db: of the packet, dB, shape (n,); infinite without noise
        :param sirs_db: its power over that of the other one, dB, shape (n,)
        :param offset: when the other one begins, -1..1 lengths of the burst after the packet
        """
        place = min(int(np.searchsorted(_ALL_OFFSETS, offset, "right")) - 1, len(OFFSETS))
        share = (offset - _ALL_OFFSETS[place]) / (_ALL_OFFSETS[place + 1] - _ALL_OFFSETS[place])
        plane = self.odds[:, :, place] * (1 - share) + self.odds[:, :, place + 1] * share
        row, up = _between(snrs_db, self.snrs_db)
        column, right = _between(sirs_db, SIRS_DB)
        near = plane[row, column] * (1 - right) + plane[row, column + 1] * right
        far = plane[row + 1, column] * (1 - right) + plane[row + 1, column + 1] * right
        beside = 1 / (1 + np.exp(-(near * (1 - up) + far * up)))
        alone_ = 1 / (1 + np.exp(-(plane[row, -1] * (1 - up) + plane[row + 1, -1] * up)))
        return np.asarray(np.minimum(beside / alone_, 1.0))


def _between(values: Floats, grid: Sequence[float]) -> tuple[Any, Floats]:
    """For each value the place in a grid before it, and how far it is from there to the next, 0..1."""
    at = np.interp(values, grid, range(len(grid)))
    place = np.minimum(at.astype(int), len(grid) - 2)
    return place, at - place


def collision_table(
    phy: Phy, channel: ChannelConfig, folder: Path | None = None, *, measured: bool = True
) -> CollisionTable | None:
    """The table of a setting; None for a PHY without a modem of this package.

    :param channel: its level, its seed and its losses of whole packets are ignored
    :param measured: measure it if there is none; otherwise None
    :param folder: where it is stored, None = the cache folder
    :raises RunError: when the folder cannot be written
    """
    if phy.burst_modem is None:
        return None
    setting = {"collisions": True, **setting_of(phy, channel)}
    name = f"collisions/{named(setting)}"
    table = _read(BUILTIN_DIR / name, setting)
    if table is not None or not measured:
        return table
    path = (folder or cache_dir()) / name
    with alone(path, "collisions"):
        table = _read(path, setting)
        if table is None:
            _log.warning("measuring collisions of %s, %d B; kept in %s", phy.name, phy.packet_len, path)
            table = measure(phy, channel, setting)
            _write(table, path)
    return table


def measure(phy: Phy, channel: ChannelConfig, setting: dict[str, Any]) -> CollisionTable:
    """Send packets beside others, and count those that arrive."""
    half = next(snr_db for snr_db in range(-40, 60) if phy.computed_pdr(snr_db) > 0.5)
    snrs_db = tuple(half + above for above in ABOVE_DB)
    delivered = np.zeros((len(snrs_db), len(SIRS_DB), len(OFFSETS)))
    for row, snr_db in enumerate(snrs_db):
        for place, offset in enumerate(OFFSETS):
            delivered[row, :, place] = _by_sir(partial(delivered_at, phy, channel, snr_db, offset))
    return CollisionTable(setting, snrs_db, PACKETS, delivered, (edge(phy, channel, -1), edge(phy, channel, 1)))


def edge(phy: Phy, channel: ChannelConfig, side: int) -> float:
    """Share of a burst at its beginning (-1) or its end (1) that can be missed, without noise; found by bisection."""
    around = FixedPaths([[RadioPath(1, replaced(channel, snr_db=None))], [RadioPath(0, channel)]])
    draw, airtime, burst = random.Random(1), phy.airtime(), burst_s(phy)
    spare, lost = 0.0, 0.25
    while lost - spare > _EDGE:
        missed = (spare + lost) / 2
        medium = SampleMedium(around, [phy] * 2, shared=True)
        for number in range(_EDGE_PACKETS):
            start = (4 * number + 2) * airtime
            medium.send(0, draw.randbytes(phy.packet_len), start, airtime)
            medium.send(1, draw.randbytes(phy.packet_len), start + side * (1 - missed) * burst, airtime)
        received = medium.receptions(4 * _EDGE_PACKETS * airtime)
        if sum(reception.sent.sender == 0 for reception in received) > _EDGE_PACKETS / 2:
            spare = missed
        else:
            lost = missed
    return spare


def _by_sir(count: Callable[[float], int]) -> list[int]:
    """What arrives at each SIR. Between two that all or no packets survive, it is taken to be the same."""
    known = {sir_db: count(sir_db) for sir_db in SIRS_DB[::_COARSE]}
    for low, high in pairwise(list(known)):
        same = known[low] == known[high] and known[low] in (0, PACKETS)
        known |= {sir_db: known[low] if same else count(sir_db) for sir_db in range(low + 1, high)}
    return [known[sir_db] for sir_db in SIRS_DB]


def delivered_at(phy: Phy, channel: ChannelConfig, snr_db: float, offset: float, sir_db: float) -> int:
    """How many of ``PACKETS`` packets arrive beside another one each."""
    levels = [replaced(channel, snr_db=snr_db), replaced(channel, snr_db=max(snr_db - sir_db, -50.0))]
    around = FixedPaths([[RadioPath(2, level)] for level in levels] + [[]])
    medium = SampleMedium(around, [phy] * 3, shared=True)
    draw, airtime, burst = random.Random(0), phy.airtime(), burst_s(phy)
    count = 0
    for number in range(PACKETS):
        start = (4 * number + 2) * airtime
        medium.send(0, draw.randbytes(phy.packet_len), start, airtime)
        medium.send(1, draw.randbytes(phy.packet_len), start + offset * burst, airtime)
        count += sum(reception.sent.sender == 0 for reception in medium.receptions(start + 1.99 * airtime))
    return count


def burst_s(phy: Phy) -> float:
    """s that the longest packet's burst lasts, without the gap after it."""
    modem = phy.burst_modem
    assert modem is not None
    return len(modem.modulate(bytes(phy.packet_len))) / phy.sample_rate


def _write(table: CollisionTable, path: Path) -> None:
    values = {
        "setting": table.setting,
        "snrs_db": table.snrs_db,
        "sirs_db": SIRS_DB,
        "offsets": OFFSETS,
        "sent": table.sent,
        "edges": table.edges,
    }
    write_rows(path, values, "delivered", [row for plane in table.delivered.astype(int).tolist() for row in plane])


def _read(path: Path, setting: dict[str, Any]) -> CollisionTable | None:
    """A table in a file; None where there is none, or one of other PHYs or that is damaged."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        current = BUILTIN_DIR in path.parents or values["program"] == program()
        if not current or values["setting"] != setting:
            return None
        if (values["sirs_db"], values["offsets"]) != (list(SIRS_DB), list(OFFSETS)):
            return None
        snrs_db = tuple(values["snrs_db"])
        delivered = np.array(values["delivered"], float).reshape(len(snrs_db), len(SIRS_DB), len(OFFSETS))
        sent, (begin, end) = values["sent"], values["edges"]
        counts = np.array([*delivered.flat, begin * sent, end * sent])
        rising = len(snrs_db) > 1 and np.isfinite(snrs_db).all() and (np.diff(snrs_db) > 0).all()
        if not (sent > 0 and rising and ((counts >= 0) & (counts <= sent)).all()):
            raise ValueError("counts or shares that are none")
        return CollisionTable(setting, snrs_db, sent, delivered, (begin, end))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
        _log.warning("%s: no table of collisions (%s); measuring again", path, error)
        return None
