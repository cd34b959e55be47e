"""Tables of how many packets a PHY loses on a channel, measured on its flowgraph: the losses of ``time: packets``.

Invariants: every number is measured on the flowgraph of the same PHY, packet length and channel, at SNRs ``STEP_DB``
apart; between two SNRs the log-odds of delivery are interpolated, and nothing is extrapolated; the same setting gives
the same table on every machine. Tables are stored in the package and in the user's cache folder. A point that is in
neither is measured on demand, by one process at a time, and the log says so.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import math
import os
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2 import __version__, phy
from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2.core.files import replacing
from gr_ros2.phy import Phy
from gr_ros2.settings.config import BurstLoss, ChannelConfig, replaced

BUILTIN_DIR = Path(__file__).resolve().parent.parent / "losses"
"""Folder of the tables that come with gr-ros2."""
STEP_DB = 0.5
PACKETS = 1000
"""Packets sent at each SNR when a point is measured on demand. The standard deviation at a PDR of 0.5 is 0.016."""

CURVE_PACKETS = 300
"""The same for a curve, which has many points."""
_LOWEST_DB, _HIGHEST_DB, _CLOSE = -40.0, 60.0, 0.004
"""Where the search for the ends of a curve stops, and which difference of the PDR counts as none."""
_BATCH_SEEDS, _SEEDS = 7919, 2**31 - 1
"""Distance between the seeds of two batches, and the number of seeds."""
_SEEDS_APART = 2**40
"""Added to the seed, so that the losses of the PHY are independent of the channel's own losses."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Point:
    """What was counted at one SNR.

    :param lost_in: number of runs of consecutive lost packets
    """

    sent: int
    delivered: int
    lost_in: int

    @property
    def pdr(self) -> float:
        """Share of the packets that arrived."""
        return self.delivered / self.sent

    @property
    def log_odds(self) -> float:
        """Log-odds of delivery. Half a packet is added to both counts, so that the value is finite."""
        return math.log((self.delivered + 0.5) / (self.sent - self.delivered + 0.5))

    @property
    def memory(self) -> float:
        """How strongly a loss predicts the next packet: 0 = not at all, 1 = the next packet is lost too."""
        lost = self.sent - self.delivered
        if not lost or not self.delivered:
            return 0.0
        again = 1 - self.lost_in / lost
        return min(max((again - (1 - self.pdr)) / self.pdr, 0.0), 0.999)


@dataclass
class LossTable:
    """The points of one setting, by SNR in dB; None is the channel without noise.

    :param setting: what the losses depend on, apart from the SNR
    """

    setting: dict[str, Any]
    points: dict[float | None, Point] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of its file."""
        return named(self.setting)

    def losses(self, snr_db: float | None) -> tuple[float, float]:
        """Share of packets lost, and their memory (see :class:`Point`), from the points next to an SNR.

        :raises KeyError: when the table does not have these points
        """
        if snr_db is None or snr_db in self.points:
            point = self.points[snr_db]
            return 1 - point.pdr, point.memory
        below, above = neighbours(snr_db)
        low, high = self.points[below], self.points[above]
        share = (snr_db - below) / (above - below)
        memory = low.memory + share * (high.memory - low.memory)
        if low.pdr == high.pdr and low.pdr in (0.0, 1.0):
            return 1 - low.pdr, memory
        odds = low.log_odds + share * (high.log_odds - low.log_odds)
        return 1 / (1 + math.exp(odds)), memory


def named(setting: dict[str, Any]) -> str:
    """Name of the file of a setting's table."""
    digest = hashlib.sha256(json.dumps(setting, sort_keys=True).encode()).hexdigest()[:12]
    return f"{setting['phy']}-{setting['packet_len']}-{digest}.json"


def neighbours(snr_db: float) -> tuple[float, float]:
    """The two SNRs of a table next to this one, below and above. Both are equal where the table has this SNR itself."""
    steps = snr_db / STEP_DB
    return math.floor(steps) * STEP_DB, math.ceil(steps) * STEP_DB


class LossCurve:
    """The PDR at any SNR: nothing below the lowest point of a table, and above the highest as much as there.

    :param channel: its SNR is ignored
    :param limits: lowest and highest SNR in dB; None finds them: between all packets lost, and as few as without noise
    """

    def __init__(self, phy: Phy, channel: ChannelConfig, limits: tuple[float, float] | None = None) -> None:
        self._phy, self._channel = phy, channel
        if limits is None:
            limits = self._found()
        self.low_db, self.high_db = limits
        first, last = neighbours(self.low_db)[0], neighbours(self.high_db)[1]
        steps = {first + STEP_DB * step for step in range(round((last - first) / STEP_DB) + 1)}
        table = self._table({None, *steps})
        self._clear = table.points[None].pdr
        self._snrs = sorted(steps)
        self._odds = [table.points[snr_db].log_odds for snr_db in self._snrs]

    def pdr(self, snrs_db: Any) -> NDArray[np.float64]:
        """Share of the packets that arrive, at SNRs in dB; infinite = without noise."""
        odds = np.interp(snrs_db, self._snrs, self._odds)
        pdr = np.where(snrs_db == math.inf, self._clear, 1 / (1 + np.exp(-odds)))
        return np.where(snrs_db < self.low_db, 0.0, pdr)

    def _table(self, snrs: set[float | None]) -> LossTable:
        return table_for(self._phy, self._channel, snrs, packets=CURVE_PACKETS)

    def _found(self) -> tuple[float, float]:
        clear = self._table({None}).points[None]
        middle = next(snr_db for snr_db in range(-40, 60) if self._phy.computed_pdr(snr_db) > 0.5)
        low = high = float(middle)
        while low > _LOWEST_DB and self._table({low}).points[low].delivered:
            low -= STEP_DB
        while high < _HIGHEST_DB and self._table({high}).points[high].pdr < clear.pdr - _CLOSE:
            high += STEP_DB
        return low, high


def setting_of(phy: Phy, channel: ChannelConfig) -> dict[str, Any]:
    """What the losses of a PHY's packets depend on, apart from the SNR. Options at their default are left out."""
    chosen, default = phy.options, phy.Options()
    names = [item.name for item in fields(chosen)]
    options = {name: getattr(chosen, name) for name in names if getattr(chosen, name) != getattr(default, name)}
    on_samples = {name: value for name, value in channel.on_samples().items() if name != "snr_db"}
    setting = {"phy": phy.name, "packet_len": phy.packet_len, "options": options, "channel": on_samples}
    if channel.doppler_hz:
        setting["sample_rate"] = phy.sample_rate  # all other settings are relative to it
    return dict(json.loads(json.dumps(setting, default=str)))


def measure(phy: Phy, channel: ChannelConfig, packets: int) -> Point:
    """Send packets and count those that arrive.

    :param channel: its seed and its losses of whole packets are ignored
    :param packets: how many, 1 or more
    """
    from gr_ros2.phy.measure import batch_of, deliver, modulated  # only here: an existing table needs no flowgraph

    source = random.Random(0)
    delivered, runs, before = 0, 0, True
    size = batch_of(phy)
    for number, first in enumerate(range(0, packets, size)):
        batch = [source.randbytes(phy.packet_len) for _ in range(min(size, packets - first))]
        arrived = set(deliver(phy, modulated(phy, batch), replaced(channel, seed=number * _BATCH_SEEDS % _SEEDS)))
        delivered += sum(packet in arrived for packet in batch)
        for packet in batch:
            runs += before and packet not in arrived
            before = packet in arrived
    return Point(packets, delivered, runs)


def packet_losses(phy: Phy, channel: ChannelConfig) -> ChannelConfig:
    """A channel that loses whole packets as the PHY does on ``channel``. Missing points are measured.

    With fading the losses come in bursts (two states, with the measured burst length), otherwise independently.

    :raises ConfigError: for a channel that the PHY does not support, or for sample clocks that differ: measurements
        show that the losses then depend on the contents of a packet, and only then
    :raises RunError: when the cache folder cannot be written
    """
    phy.check_channel(channel)
    if not phy.has_samples:
        return ChannelConfig()
    if channel.epsilon != 1:
        raise ConfigError(
            f"channel.epsilon = {channel.epsilon:g}: with sample clocks that differ, how many packets are lost depends "
            "on what they carry, which no table tells; set time to samples"
        )
    table = table_for(phy, channel, snrs_of(channel))
    lost, memory = table.losses(channel.snr_db)
    seed = channel.seed + _SEEDS_APART
    if channel.doppler_hz and 0 < lost < 1:
        bursts = BurstLoss(p_good_to_bad=lost * (1 - memory), p_bad_to_good=(1 - lost) * (1 - memory))
        return ChannelConfig(burst_loss=bursts, seed=seed)
    return ChannelConfig(packet_loss=lost, seed=seed)


def snrs_of(channel: ChannelConfig) -> set[float | None]:
    """The SNRs of the points that a channel needs."""
    return {None} if channel.snr_db is None else set(neighbours(channel.snr_db))


def table_for(
    phy: Phy,
    channel: ChannelConfig,
    snrs: set[float | None],
    *,
    packets: int | None = None,
    folder: Path | None = None,
) -> LossTable:
    """The table of a setting with at least these points. Missing points are measured and stored.

    :param packets: sent at each point that is measured, None = ``PACKETS``; points with fewer packets count as missing
    :param folder: where the table is stored, None = the cache folder
    :raises RunError: when the folder cannot be written
    """
    packets = PACKETS if packets is None else packets
    table = LossTable(setting_of(phy, channel))
    _read(BUILTIN_DIR / table.name, table)
    if _missing(table, snrs, packets):
        path = (folder or cache_dir()) / table.name
        with alone(path, "packet loss"):
            _read(path, table)
            for snr_db in _missing(table, snrs, packets):
                at = "without noise" if snr_db is None else f"at {snr_db:g} dB"
                _log.warning(
                    "measuring the packet loss of %s, %d B, %s; kept in %s", phy.name, phy.packet_len, at, path
                )
                table.points[snr_db] = measure(phy, replaced(channel, snr_db=snr_db), packets)
                write(table, path)
    return table


def cache_dir() -> Path:
    """Folder of tables measured on demand: ``gr-ros2/losses`` in ``$XDG_CACHE_HOME``, by default ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gr-ros2" / "losses"


def write(table: LossTable, path: Path) -> None:
    """Write a table so that it appears whole or not at all."""
    points = sorted(table.points.items(), key=lambda item: -math.inf if item[0] is None else item[0])
    rows = [[snr_db, point.sent, point.delivered, point.lost_in] for snr_db, point in points]
    write_rows(path, {"setting": table.setting, "columns": ["snr_db", "sent", "delivered", "lost_in"]}, "points", rows)


def write_rows(path: Path, values: Mapping[str, Any], name: str, rows: Iterable[Sequence[Any]]) -> None:
    """Write JSON values, and below a name one line per row, so that the file appears whole or not at all."""
    lines = ",\n  ".join(json.dumps(row) for row in rows)
    text = json.dumps({"program": program(), **values}, indent=1)[:-2] + f',\n "{name}": [\n  {lines}\n ]\n}}\n'
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


@cache
def program() -> str:
    """Version of gr-ros2 and digest of the PHYs' sources. A changed PHY loses other packets."""
    digest = hashlib.sha256()
    for source in sorted(Path(phy.__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return f"{__version__} {digest.hexdigest()[:12]}"


def _read(path: Path, table: LossTable) -> None:
    """Add the points of a file. A file that is damaged, or that was measured with other PHYs, is ignored."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if (path.parent == BUILTIN_DIR or values["program"] == program()) and values["setting"] == table.setting:
            points = {row[0]: Point(*row[1:]) for row in values["points"]}
            for snr_db, point in points.items():
                sure = snr_db is None or math.isfinite(snr_db)
                if not (sure and 0 <= point.delivered <= point.sent > 0 <= point.lost_in):
                    raise ValueError(f"{point} at {snr_db} dB")
            table.points.update(points)
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError) as error:
        _log.warning("%s: no table of losses (%s); measuring again", path, error)


def _missing(table: LossTable, snrs: set[float | None], packets: int) -> list[float | None]:
    found = {snr_db for snr_db, point in table.points.items() if point.sent >= packets}
    return sorted(snrs - found, key=lambda snr_db: -math.inf if snr_db is None else snr_db)


@contextmanager
def alone(path: Path, what: str) -> Iterator[None]:
    """Lock the file in which something measured is kept: this process has it for itself, and other processes wait.

    :raises RunError: when it cannot be written there
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.with_name(f".{path.name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
    except OSError as error:
        raise RunError(
            f"{path}: the {what} measured cannot be kept ({error.strerror or error}); set XDG_CACHE_HOME to a folder "
            "that can be written"
        ) from error
