"""What each rule and tuned constant of the engine of version 1 gains: every promise of the docs with it switched off,
halved and doubled, one at a time, over the same messages and losses.

A *promise* is a figure of which less is better, of one seed. A change is shown where its mean over the seeds is at
least ``SHOWN`` and the 95 % interval of the paired differences (Student's t) leaves out zero. A rule that shows no such
gain on any promise does not earn its place. A variant runs with all seeds, or until the interval of one promise lies
wholly beyond ``SHOWN``: what is needed is known then.

A variant is a :class:`~gr_ros2.core.tuning.Tuning` with another value, passed in; a rule is off where its value says
so. ``gr-ros2 ablate`` does not run over them: its variants differ in settings, which any user can repeat with
``--set``. What serves the first hellos, shared channels and relaying has no promise here (``bench first``,
``reliable``, ``relay``), and the adaptive rate has its own: :mod:`bench.rate_rules`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import repeat
from math import exp, inf, isfinite, log, sqrt
from statistics import mean, stdev
from typing import Any

from bench import repair, repair_backlog, saturated, uneven
from bench.rows import Row
from gr_ros2.core.tuning import Tuning

SEEDS = range(1, 7)
SECONDS = 20.0
"""Simulated s of a run. A seed of all promises takes about 7 s of processor time."""
SHOWN = 0.03
"""Relative change of a promise from which on a rule earns its place."""
_T = {3: 4.303, 4: 3.182, 5: 2.776, 6: 2.571}
"""97.5 % quantile of Student's t, by the number of seeds."""

RULES: dict[str, dict[str, Any]] = {
    "no waiting for a message that is due": {"hold_overlap": inf},
    "waiting also where repairs are owed": {"hold_most_owed": 0.0},
    "waiting also where it gained nothing": {"hold_most_in_vain": 0},
    "waiting for any gain": {"hold_gain": 0.0},
    "waiting for the shortest overlap": {"hold_overlap": 0.0},
    "no early reports": {"report_prompt_loss": 2.0},
    "no rarer reports": {"report_calm_loss": 0.0},
    "no reports again while messages wait": {"report_again_s": inf},
    "no reports of the oldest missing packets": {"report_oldest": 1 << 30},
    "no repairs before new packets": {"repair_most_ahead": 0},
    "no word before new packets that a packet is over": {"repair_patience_s": inf},
    "no repairs before new packets one way": {"unreported_owed": inf},
    "no end of repairs one way": {"unreported_enough": inf},
    "no account of repairs under way": {"repair_under_way": 0.0},
    "repairs for any expected loss": {"repair_enough": 0.0},
    "only the newest delay of a report": {"peer_delays": 1},
    "late reports waited for too": {"peer_soon": inf},
    "windows of repairs that do not move": {"window_step": 0.0},
    "gaps waited for where few come back": {"order_smoothing": 0.0},
    "no knowledge of what gaps held": {"gap_packets": 0},
    "no turns of topics": {"turn_every": 1 << 30},
    "long messages by value alone": {"long_packets": 1 << 30},
}
CONSTANTS = (
    "turn_every", "fragment_part", "long_packets", "repair_enough", "repair_worth", "repair_patience_s",
    "repair_poll_s", "repair_calm_poll_s", "repair_most_ahead", "gap_packets", "order_smoothing", "hold_overlap",
    "hold_surplus", "hold_most_owed", "hold_smoothing", "hold_late", "hold_most_in_vain", "hold_gain",
    "unreported_most_loss", "unreported_enough", "unreported_owed", "report_every", "report_per_arrived",
    "report_per_loss", "report_per_vain", "report_most_saved", "report_smoothing", "report_pause_s", "report_calm_s",
    "report_calm_loss", "report_slower", "report_again_s", "report_prompt_loss", "report_oldest", "peer_delays",
    "peer_interval_s", "peer_silence", "peer_later", "peer_soon", "hello_bytes_s", "hello_often_s", "hello_seldom_s",
    "hello_early", "kept_starting_s", "table_share",
)  # fmt: skip


def scaled(tuning: Tuning, name: str) -> dict[str, Tuning]:
    """With half of a constant, and with twice as much."""
    value = getattr(tuning, name)
    news = [type(value)(value * factor) for factor in (0.5, 2.0)]
    return {f"{name} = {new:.4g}, not {value:.4g}": replace(tuning, **{name: new}) for new in news}


def _six(seed: int, tuning: Tuning) -> float:
    topics, _ = saturated.run("six-topics-paced", 0.2, seed=seed, seconds=SECONDS, tuning=tuning)
    return exp(mean(log(topic.age) for topic in topics))


def _paced(name: str, seed: int, *, back: bool, **settings: Any) -> float:
    # With seed 1 the first five hellos are lost, as in one start of 3,000: nothing is delivered for 10 s.
    ages = saturated.paced(name, 0.2, back=back, seed=seed + 1, best_effort=(), duration_s=SECONDS, **settings)
    return exp(mean(log(age) for age in ages.values()))


def _uneven(seed: int, tuning: Tuning) -> dict[str, float]:
    """Mean waits of messages that do not come evenly."""
    found: dict[str, float] = {}
    for name, messages in (("random", uneven.random_times), ("in pairs", uneven.pairs)):
        found[f"{name}, one way: wait"] = mean(
            uneven.waits(messages(seed, 40.0, SECONDS), 0.2, 1 / repair.RATE, back=False, seed=seed, tuning=tuning)
        )
    last = uneven.waits(uneven.commands(seed, 0.4, 1000.0), 0.4, 0.4, back=True, seed=seed, tuning=tuning)
    return {**found, "commands before silence: wait": mean(last)}


def promises(seed: int, tuning: Tuning = Tuning()) -> dict[str, float]:
    """The figures of the docs' promises with one seed; less is better."""
    found: dict[str, float] = {}
    common: dict[str, Any] = {"seed": seed, "tuning": tuning}

    def add(name: str, **settings: Any) -> None:
        outcome = repair.run(**{"repair": "auto", "seconds": SECONDS, **common, **settings})
        found[f"{name}: age"], found[f"{name}: p99"] = outcome.age, outcome.p99
        found[f"{name}: packets"] = outcome.packets
        if outcome.reports:
            found[f"{name}: reports"] = outcome.reports

    add("odometry, reports", loss=0.2, back=0.2)
    add("odometry, one way", loss=0.2)
    add("odometry, late reports", loss=0.2, back=0.2, delay=8)
    add("odometry, bursts", loss=0.2, back=0.2, burst=3.0)
    add("odometry, 5 %", loss=0.05, back=0.05)
    add("odometry, 1 %", loss=0.01, back=0.01)
    add("odometry, nothing repaired", loss=0.2, repair="off")
    add("odometry, nothing lost", loss=0.0, back=0.0)
    add("odometry, 2 of 5 s silent", loss=0.2, back=0.2, outage=2.0)
    add("busy", hz=55.0, loss=0.1, back=0.1)
    add("busy, one way", hz=55.0, loss=0.2)
    add("15 packets", hz=3.0, size=700, loss=0.2, back=0.2)
    add("15 packets, one way", hz=3.0, size=700, loss=0.2)
    large = repair.run(
        seed=seed, repair="auto", once=True, size=500_000, packet_len=1500, loss=0.2, tail=200, tuning=tuning
    )
    found["500 kB, one way: packets"] = large.sent_until
    for reports in (True, False):
        beside = repair_backlog.run((300_000, 1), 0.2, reports=reports, **common)
        way = "reports" if reports else "one way"
        found[f"beside 300 kB, {way}: age"], found[f"300 kB, {way}: s"] = beside.age, beside.done
    found["six topics, full"] = _six(seed, tuning)
    found["odometry, full"] = saturated.run("narrow-ofdm-paced", 0.2, seed=seed, seconds=SECONDS, tuning=tuning)[0][
        0
    ].age
    for hz in (35, 40, 45):
        for way, back in (("one way", False), ("reports", True)):
            found[f"paced at {hz} Hz, {way}"] = _paced("paper-ofdm-paced", seed, back=back, odom_rate=hz, tuning=tuning)
    found["paced, six topics"] = _paced("six-topics-paced", seed, back=False, tuning=tuning)
    found.update(_uneven(seed, tuning))
    return found


def variant(name: str, base: Sequence[dict[str, float]]) -> list[dict[str, float]]:
    """The promises with one change, by seed; no more seeds than show that some promise needs what was changed.

    :param base: the promises without it, by seed
    """
    tuning, found = variants()[name], list[dict[str, float]]()
    for seed in SEEDS:
        found.append(promises(seed, tuning))
        if len(found) in _T and any(change - half >= SHOWN for change, half in changes(base, found).values()):
            break
    return found


@cache
def variants() -> dict[str, Tuning]:
    """What is varied, by name."""
    usual = Tuning()
    found = {name: replace(usual, **changed) for name, changed in RULES.items()}
    for name in CONSTANTS:
        found |= scaled(usual, name)
    return found


def changes(base: Sequence[dict[str, float]], found: Sequence[dict[str, float]]) -> dict[str, tuple[float, float]]:
    """Mean relative change of each promise and half of its 95 % interval.

    Infinity, where something was never delivered.

    :param found: by seed, of fewer seeds than `base` or as many; three at least
    """
    result: dict[str, tuple[float, float]] = {}
    for promise in found[0]:
        shares = [new[promise] / old[promise] - 1 for old, new in zip(base, found, strict=False)]
        known = all(map(isfinite, shares))
        half = _T[len(shares)] * stdev(shares) / sqrt(len(shares)) if known else 0.0
        result[promise] = mean(shares) if known else float("inf"), half
    return result


def constants(chosen: Callable[[str], bool] = lambda _: True) -> list[Row]:
    """One row per variant: the promises that it changes."""
    names = [name for name in variants() if chosen(name)]
    rows = []
    with ProcessPoolExecutor(2) as pool:
        base = list(pool.map(promises, SEEDS))
        for name, found in zip(names, pool.map(variant, names, repeat(base)), strict=True):
            shown = {p: c for p, (c, half) in changes(base, found).items() if abs(c) >= SHOWN and abs(c) > half}
            note = ", ".join(f"{promise} {change:+.1%}" for promise, change in shown.items())
            worst = max([0.0, *shown.values()])
            rows.append(Row(f"constants: {name}: worst change", worst * 100, "%", form="{:.1f}", note=note))
    return rows
