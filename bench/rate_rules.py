"""What each rule and constant of the adaptive rate gains: s on the air per packet delivered, with it switched off,
halved and doubled, one at a time, over channels that are constant, fade, jump and are not as their model says.

One sender and one receiver: the real choice of the rate, and the real reports, without messages and repairs. A run
takes .2 s, that of a whole link 5 s. So changes of some percent are seen among many kinds of channels. Those of the
whole link are in :mod:`bench.rate`.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial
from math import exp, inf, log, sqrt
from statistics import mean, stdev
from types import SimpleNamespace
from typing import Any

import numpy as np

from bench.constants import scaled
from bench.rows import Row
from gr_ros2.core.tuning import Tuning
from gr_ros2.link.rate import Mcs, RateController
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.reports import Reporter
from gr_ros2_lab.medium.fading import RayleighFading

MCS_TABLE = (
    Mcs("bpsk-cc", 0.006272, -1.4, 0.4),
    Mcs("qpsk-cc", 0.003312, 1.6, 0.4),
    Mcs("8psk-cc", 0.002352, 5.0, 0.4),
    Mcs("16qam-cc", 0.001792, 7.0, 0.4),
    Mcs("64qam-cc", 0.001312, 11.2, 0.4),
    Mcs("16qam", 0.001072, 16.2, 0.5),
    Mcs("64qam", 0.000832, 22.2, 0.5),
)
"""Of ``ofdm`` with packets of 220 B at 1 MS/s."""
SEEDS, SECONDS = range(1, 9), 12.0
REPORT_S, DELAY_S = 0.0016, 0.005
"""s that a report is on the air, and that it takes beside."""
STEP_S = 0.001
"""s for which fading is taken as constant."""
ERROR_DB = 1.0
"""Standard deviation of the SNR that a receiver measures on one packet, dB."""
SHOWN = 0.03
"""Relative change of the airtime per packet from which on a rule earns its place."""

Snr = Callable[[float], float]


@dataclass(frozen=True)
class Link:
    """What differs between the links beside the SNR.

    :param lost: share of the reports that are lost, beside those that the SNR costs
    :param late_s: s by which reports are late at random, at most
    :param half_duplex: whether reports take airtime from the packets, and are therefore fewer
    :param period_s: s between two packets offered; 0 for more than the air carries
    :param burst: s in which packets are offered, and s of pause after them
    :param off_db: dB more than the models say that a packet needs
    """

    lost: float = 0.0
    late_s: float = 0.0
    half_duplex: bool = False
    period_s: float = 0.0
    burst: tuple[float, float] | None = None
    off_db: float = 0.0


def run(snr: Snr, link: Link, seed: int, tuning: Tuning = Tuning()) -> float:
    """s on the air per packet that arrives.

    :param snr: SNR in dB at a time in s, of both directions
    """
    draw = random.Random(seed)
    rate = RateController(MCS_TABLE, tuning)
    rate.meet(2)
    decoder: Any = SimpleNamespace(newest=-1, bodies=())
    order: Any = SimpleNamespace(wanted=0, told=False, held=0)
    reporter = Reporter((1, 1), decoder, order, Settings(2, half_duplex=link.half_duplex, tuning=tuning))
    under_way: deque[tuple[float, float, float]] = deque()
    free = 0.0

    def arrives(mcs: int, at: float) -> bool:
        return draw.random() < MCS_TABLE[mcs].pdr(snr(at) - link.off_db)

    def report(since: float, until: float) -> None:
        nonlocal free
        now = max(since, free)
        while now <= until:
            due = reporter.due(now)
            if due <= now or (reporter.unreported and reporter.helps):
                sent, now = reporter.make(now), now + REPORT_S
                free = now
                if draw.random() >= link.lost and arrives(0, now) and sent.snr_db is not None:
                    at = now + DELAY_S + draw.random() * link.late_s
                    under_way.append((max(at, under_way[-1][0] if under_way else 0.0), sent.snr_db, sent.loss / 128))
            else:
                now = max(due, now + 1e-6)

    now, number, air, arrived = 0.0, 0, 0.0, 0
    while now < SECONDS:
        while under_way and under_way[0][0] <= now:
            at, snr_db, loss = under_way.popleft()
            rate.report(2, snr_db, loss, at)
        mcs = rate.sent([2], now)
        end = now + MCS_TABLE[mcs].airtime_s
        air += end - now
        report(now, end - 1e-9)
        if arrives(mcs, end):
            arrived += 1
            if missing := number - decoder.newest - 1:
                reporter.missed(missing, counts=decoder.newest >= 0)
            decoder.newest, order.wanted = number, number + 1
            reporter.snr.measured(snr(end) + draw.gauss(0, ERROR_DB))
            reporter.arrived(late=False)
        number += 1
        now = max(end, number * link.period_s)
        if link.burst and now % sum(link.burst) > link.burst[0]:
            now = (now // sum(link.burst) + 1) * sum(link.burst)
        report(end, now)
    return air / max(arrived, 1)


def _fades(mean_db: float, doppler_hz: float, seed: int) -> Snr:
    gain = abs(RayleighFading(doppler_hz, seed).gain(np.arange(0, SECONDS + 1, STEP_S)))
    levels_db = (mean_db + 20 * np.log10(np.maximum(gain, 1e-6))).tolist()
    return lambda now: levels_db[int(now / STEP_S)]


def _jumps(high_db: float, low_db: float, period_s: float, _seed: int) -> Snr:
    return lambda now: low_db if now // period_s % 2 else high_db


def _climbs(high_db: float, period_s: float, _seed: int) -> Snr:
    return lambda now: high_db * abs(now / period_s % 2 - 1)


def _constant(snr_db: float, seed: int) -> Snr:
    return lambda _: snr_db + seed % 5 / 5


FULL, HALF = Link(), Link(half_duplex=True)
FADES = partial(_fades, 10.0, 2.0)
JUMPS = partial(_jumps, 12.0, 3.0, 1.0)
KINDS = {
    "half of the reports lost": Link(lost=0.5),
    "reports 5 to 65 ms late": Link(late_s=0.06),
    "half duplex": HALF,
    "50 packets/s": Link(period_s=0.02),
    "bursts of 30 ms": Link(burst=(0.03, 0.3)),
    "its model 2 dB off": Link(off_db=2.0),
}
CHANNELS: dict[str, tuple[Callable[[int], Snr], Link]] = {
    **{f"fading, {db:g} dB": (partial(_fades, db, 2.0), FULL) for db in (5.0, 10.0, 15.0)},
    **{f"fading, 10 dB, {hz:g} Hz": (partial(_fades, 10.0, hz), FULL) for hz in (0.5, 6.0)},
    **{f"fading, 10 dB, {kind}": (FADES, link) for kind, link in KINDS.items()},
    **{f"fading, 15 dB, {hz:g} Hz, half duplex": (partial(_fades, 15.0, hz), HALF) for hz in (2.0, 6.0)},
    **{f"12 and 3 dB, 1 s each, {kind}": (JUMPS, link) for kind, link in list(KINDS.items())[:4]},
    "12 and 3 dB, 1 s each": (JUMPS, FULL),
    "12 and 3 dB, 3 s each": (partial(_jumps, 12.0, 3.0, 3.0), FULL),
    "20 and 6 dB, .3 s each": (partial(_jumps, 20.0, 6.0, 0.3), FULL),
    "12 dB and nothing, 1 s each": (partial(_jumps, 12.0, -8.0, 1.0), FULL),
    "12 and 2 dB, 4 s each, 2 packets/s": (partial(_jumps, 12.0, 2.0, 4.0), Link(period_s=0.5)),
    "0 to 18 dB in 1 s": (partial(_climbs, 18.0, 1.0), FULL),
    "0 to 18 dB in 5 s": (partial(_climbs, 18.0, 5.0), FULL),
    **{f"{db:g} dB": (partial(_constant, db), FULL) for db in (0.0, 2.0, 5.0, 7.0, 9.0, 11.0, 14.0, 16.0, 20.0)},
    **{f"{db:g} dB, {kind}": (partial(_constant, db), link) for db in (2.0, 7.0, 11.0) for kind, link in KINDS.items()},
}
"""The SNR by seed, and the link. A constant SNR has .2 to .8 dB more with other seeds, so that edges are among them."""
CONSTANTS = tuple(each.name for each in fields(Tuning) if each.name.startswith("rate_"))
RULES: dict[str, dict[str, Any]] = {
    "any gain is enough": {"rate_gain": 1.0},
    "no fall since the last report": {"rate_look_back_s": inf},
    "no allowance for errors": {"rate_error_db": 0.0},
    "no correction": {"rate_correction_db_s": 0.0},
    "no silence by gaps": {"rate_unanswered": 1 << 30},
    "silence though nothing was sent": {"rate_unanswered": 0},
    "no shortest silence": {"rate_least_silent_s": 0.0},
}


def airtimes(tuning: Tuning) -> dict[str, list[float]]:
    """s on the air per packet that arrives, on each channel with each seed."""
    return {name: [run(snr(seed), link, seed, tuning) for seed in SEEDS] for name, (snr, link) in CHANNELS.items()}


def changes(base: dict[str, list[float]], found: dict[str, list[float]]) -> dict[str, float]:
    """Relative change on each channel, where at least ``SHOWN`` and twice its standard error."""
    shown = {}
    for name, before in base.items():
        ratios = [log(after / one) for one, after in zip(before, found[name], strict=True)]
        change = exp(mean(ratios)) - 1
        if abs(change) >= SHOWN and abs(mean(ratios)) > 2 * stdev(ratios) / sqrt(len(ratios)):
            shown[name] = change
    return shown


def rate_rules() -> list[Row]:
    """One row per rule and constant: the channels that it changes."""
    usual = Tuning()
    variants = {what: replace(usual, **changed) for what, changed in RULES.items()}
    for name in CONSTANTS:
        variants |= scaled(usual, name)
    with ProcessPoolExecutor(2) as pool:
        base, *found = pool.map(airtimes, [usual, *variants.values()])
    rows = []
    for what, result in zip(variants, found, strict=True):
        shown = changes(base, result)
        note = ", ".join(f"{name} {change:+.0%}" for name, change in sorted(shown.items(), key=lambda item: -item[1]))
        rows.append(
            Row(f"rate: {what}: worst change", max([0.0, *shown.values()]) * 100, "%", form="{:.1f}", note=note)
        )
    return rows
