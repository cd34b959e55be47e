"""What each rule and tuned constant of the engine of version 1 gains: every promise of the docs with it switched off,
halved and doubled, one at a time, over the same messages and losses.

A *promise* is a figure of which less is better, of one seed. A change is shown where its mean over the seeds is at
least ``SHOWN`` and the 95 % interval of the paired differences (Student's t) leaves out zero. A rule that shows no such
gain on any promise does not earn its place. A variant runs with all seeds, or until the interval of one promise lies
wholly beyond ``SHOWN``: what is needed is known then.

``gr-ros2 ablate`` does not run over them: its variants differ in settings, which any user can repeat with ``--set``.
These are no settings, and no value that is passed in either: each constant stands beside the rule that it tunes, with
what it was measured by, and 22 variants take away a whole rule, which has no number. So a variant patches modules, in
worker processes. The rules of the adaptive rate have promises of their own: :mod:`bench.rate_rules`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from itertools import repeat
from math import exp, inf, isfinite, log, sqrt
from statistics import mean, stdev
from typing import Any

from bench import repair, repair_backlog, saturated, uneven
from bench.rows import Row
from gr_ros2.link.v1.reports import Reporter

SEEDS = range(1, 7)
SECONDS = 20.0
"""Simulated s of a run. A seed of all promises takes about 7 s of processor time."""
SHOWN = 0.03
"""Relative change of a promise from which on a rule earns its place."""
_T = {3: 4.303, 4: 3.182, 5: 2.776, 6: 2.571}
"""97.5 % quantile of Student's t, by the number of seeds."""

Patch = tuple[str, str, Any]
"""Module of ``gr_ros2.link.v1``; name in it (a dot leads into a class), and its value."""


def _module(name: str) -> Any:
    return import_module(f"gr_ros2.link.v1.{name}")


def _scaled(module: str, name: str, *factors: float) -> Iterator[tuple[str, list[Patch]]]:
    value = getattr(_module(module), name)
    for factor in factors or (0.5, 2.0):
        new = type(value)(value * factor)
        yield f"{name} = {new:.4g}, not {value:.4g}", [(module, name, new)]


def _newest_only(make: Callable[[Any, float], Any]) -> Callable[[Any, float], Any]:
    """Reports of the newest packets only."""

    def made(reporter: Any, now: float) -> Any:
        reporter._old_turn = True
        return make(reporter, now)

    return made


def _nothing(*_: Any) -> None:
    pass


RULES: dict[str, list[Patch]] = {
    "no waiting for a message that is due": [("hold", "Hold.until", lambda _self, now, _end, _airtime, **_: now)],
    "waiting also where repairs are owed": [("hold", "_MOST_OWED", 0.0)],
    "waiting also where it gained nothing": [("hold", "_MOST_IN_VAIN", 0)],
    "waiting for any gain": [("hold", "_GAIN", 0.0)],
    "waiting for the shortest overlap": [("hold", "OVERLAP", 0.0)],
    "no early reports": [("peers", "PROMPT", 2.0), ("reports", "PROMPT", 2.0)],
    "no rarer reports": [("reports", "CALM", 0.0)],
    "no reports again while messages wait": [("reports", "_AGAIN_S", inf)],
    "no reports of the oldest missing packets": [("reports", "Reporter.make", _newest_only(Reporter.make))],
    "no resending before new packets": [("repair", "RepairWindow.urgent", lambda _self, _now: None)],
    "no word before new packets that a packet is over": [("repair_slots", "PATIENCE_S", inf)],
    "no repairs before new packets one way": [("unreported", "Unreported.due", lambda _self, _newest: False)],
    "no end of repairs one way": [("unreported", "Unreported.cover", _nothing)],
    "no account of repairs under way": [("thrift", "Thrift.combined", _nothing)],
    "repairs for any expected loss": [("thrift", "_ENOUGH", 0.0)],
    "only the newest delay of a report": [("peers", "_DELAYS", 1)],
    "late reports waited for too": [("peers", "_SOON", inf)],
    "windows of repairs that do not move": [("combining", "_GOLDEN", 0.0)],
    "gaps waited for where few come back": [("order", "_SMOOTHING", 0.0)],
    "no knowledge of what gaps held": [("gap_contents", "GapContents.learn", _nothing)],
    "no turns of topics": [("freshness", "TURN", 1 << 30)],
    "long messages by value alone": [("packing", "LONG", 1 << 30)],
}
CONSTANTS = (
    ("lifetime", "WORTH"), ("thrift", "_ENOUGH"), ("order", "_SMOOTHING"),
    ("peers", "_DELAYS"), ("peers", "_SOON"), ("peers", "PROMPT"), ("freshness", "TURN"),
    ("packing", "FULL_PART"), ("packing", "LONG"),
    ("reports", "_EVERY"), ("reports", "_SMOOTHING"), ("reports", "_PAUSE_S"), ("reports", "_CALM_S"),
    ("reports", "CALM"), ("reports", "_SLOWER"), ("reports", "_AGAIN_S"), ("reports", "PER_ARRIVED"),
    ("reports", "PER_LOSS"), ("reports", "PER_VAIN"), ("reports", "_MOST"),
    ("hold", "OVERLAP"), ("hold", "SURPLUS"), ("hold", "_MOST_OWED"), ("hold", "_SMOOTHING"),
    ("hold", "_LATE"), ("hold", "_MOST_IN_VAIN"), ("hold", "_GAIN"),
)  # fmt: skip


def _six(seed: int) -> float:
    topics, _ = saturated.run("six-topics-paced", 0.2, seed=seed, seconds=SECONDS)
    return exp(mean(log(topic.age) for topic in topics))


def _paced(name: str, seed: int, *, back: bool, **settings: Any) -> float:
    # With seed 1 the first five hellos are lost, as in one start of 3,000: nothing is delivered for 10 s.
    ages = saturated.paced(name, 0.2, back=back, seed=seed + 1, best_effort=(), duration_s=SECONDS, **settings)
    return exp(mean(log(age) for age in ages.values()))


def _uneven(seed: int) -> dict[str, float]:
    """Mean waits of messages that do not come evenly."""
    found: dict[str, float] = {}
    for name, messages in (("random", uneven.random_times), ("in pairs", uneven.pairs)):
        found[f"{name}, one way: wait"] = mean(
            uneven.waits(messages(seed, 40.0, SECONDS), 0.2, 1 / repair.RATE, back=False, seed=seed)
        )
    last = uneven.waits(uneven.commands(seed, 0.4, 1000.0), 0.4, 0.4, back=True, seed=seed)
    return {**found, "commands before silence: wait": mean(last)}


def promises(seed: int) -> dict[str, float]:
    """The figures of the docs' promises with one seed; less is better."""
    repair_backlog.run.cache_clear()
    found: dict[str, float] = {}

    def add(name: str, **settings: Any) -> None:
        outcome = repair.run(seed=seed, **{"repair": "auto", "seconds": SECONDS, **settings})
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
    large = repair.run(seed=seed, repair="auto", once=True, size=500_000, packet_len=1500, loss=0.2, tail=200)
    found["500 kB, one way: packets"] = large.sent_until
    for reports in (True, False):
        beside = repair_backlog.run((300_000, 1), 0.2, reports=reports, seed=seed)
        way = "reports" if reports else "one way"
        found[f"beside 300 kB, {way}: age"], found[f"300 kB, {way}: s"] = beside.age, beside.done
    found["six topics, full"] = _six(seed)
    found["odometry, full"] = saturated.run("narrow-ofdm-paced", 0.2, seed=seed, seconds=SECONDS)[0][0].age
    for hz in (35, 40, 45):
        for way, back in (("one way", False), ("reports", True)):
            found[f"paced at {hz} Hz, {way}"] = _paced("paper-ofdm-paced", seed, back=back, odom_rate=hz)
    found["paced, six topics"] = _paced("six-topics-paced", seed, back=False)
    found.update(_uneven(seed))
    return found


@contextmanager
def patched(patches: Sequence[Patch]) -> Iterator[None]:
    """The engine with other constants or without rules, wherever they are imported."""
    before: list[tuple[Any, str, Any]] = []
    for module, name, value in patches:
        place = _module(module)
        first, _, rest = name.partition(".")
        if rest:
            holders = [getattr(place, first)]
        else:
            known = getattr(place, name)
            engine = [m for key, m in list(sys.modules.items()) if key.startswith("gr_ros2.link.v1.")]
            public = not name.startswith("_") and sum(hasattr(m, name) for m in engine) > 1
            holders = [m for m in engine if getattr(m, name, None) is known and public] or [place]
        for holder in holders:
            before.append((holder, rest or name, getattr(holder, rest or name)))
            setattr(holder, rest or name, value)
    try:
        yield
    finally:
        for holder, name, value in reversed(before):
            setattr(holder, name, value)


def variant(name: str, base: Sequence[dict[str, float]]) -> list[dict[str, float]]:
    """The promises with one change, by seed; no more seeds than show that some promise needs what was changed.

    :param base: the promises without it, by seed
    """
    found: list[dict[str, float]] = []
    with patched(variants()[name]):
        for seed in SEEDS:
            found.append(promises(seed))
            if len(found) in _T and any(change - half >= SHOWN for change, half in changes(base, found).values()):
                break
    return found


@cache
def variants() -> dict[str, list[Patch]]:
    """What is changed, by name."""
    scaled = [item for module, name in CONSTANTS for item in _scaled(module, name)]
    return {**RULES, **dict(scaled)}


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
