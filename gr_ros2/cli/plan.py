"""`gr-ros2 plan`: does this traffic fit this radio, how fresh will it be, and what to change."""

from __future__ import annotations

from math import log

import click
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gr_ros2.cli.params import SCENARIO, set_option
from gr_ros2.run.scenario import Scenario, load_scenario
from gr_ros2.study.forecast import Advice, Effect, Forecast, Planner

_WIDTH = 110
_ADVICE = 3
_HEADINGS = ("offered [1/s]", "message [B]", "on air [B]", "load", "rate [1/s]", "PDR", "age [ms]", "p99 [ms]")


@click.command()
@click.argument("scenario", type=SCENARIO)
@click.option("--seed", type=int, help="Seed of robots and sender.")
@click.option("--duration", type=float, help="Seconds of traffic that are looked at; 0 = to the end of a bag.")
@set_option(Scenario)
@click.option("--no-advice", is_flag=True, help="Only the forecast.")
def plan(scenario: str, seed: int | None, duration: float | None, overrides: tuple[str, ...], no_advice: bool) -> None:
    """Forecast SCENARIO, a built-in name or a YAML file, without running it, and propose changes."""
    planner = Planner(load_scenario(scenario, overrides, seed=seed, duration_s=duration))
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=_WIDTH)
    forecast = planner.forecast()
    phy = planner.phy
    rate = f" at {phy.sample_rate:,.0f} samples/s" if phy.has_samples else ""
    console.print(
        f"{phy.name}{rate}: a packet of {forecast.packet_len} B takes "
        f"{forecast.airtime_s * 1e3:.2f} ms, {forecast.capacity:.1f} packets/s\n",
        soft_wrap=True,
    )
    console.print(_table(forecast))
    console.print(_verdict(forecast), soft_wrap=True)
    if forecast.air:
        console.print(_air(forecast), soft_wrap=True)
    if not no_advice:
        found = planner.advice()
        for advice in found[:_ADVICE]:
            console.print(_line(advice), soft_wrap=True)
        if not found:
            console.print(
                "No change of packet_len, compression or pacing makes more better than worse.",
                soft_wrap=True,
            )


def _table(forecast: Forecast) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("Topic", no_wrap=True)
    for heading in _HEADINGS:
        table.add_column(escape(heading.replace(" ", "\n")), justify="right", no_wrap=True)
    for topic in forecast.topics:
        result = topic.result
        table.add_row(
            topic.topic,
            f"{topic.offered_hz:.1f}",
            f"{topic.message_bytes:.0f}",
            f"{topic.air_bytes:.0f}",
            f"{topic.load:.0%}",
            f"{topic.rate_hz:.1f}",
            _number(result.pdr, 1, ".2f"),
            _number(result.age_s.mean, 1e3, ".0f"),
            _number(result.latency_s.p99, 1e3, ".0f"),
        )
    return table


def _verdict(forecast: Forecast) -> str:
    per_message = _number(forecast.air_bytes_per_message, 1, ".0f")
    fits = "it fits"
    if forecast.load > 1:
        heaviest = max(forecast.topics, key=lambda topic: topic.load)
        fits = f"it does not fit, most of it is {heaviest.topic}; max_rate and weight of a topic say what is dropped"
    return (
        f"Load {forecast.load:.0%}: {fits}. {forecast.used:.0%} of the airtime is used, {forecast.pad:.0%} of it for "
        f"PAD; {per_message} bytes on the air per message delivered."
    )


def _air(forecast: Forecast) -> str:
    """Packets per message, by purpose."""
    spent = ", ".join(f"{packets:.2f} {kind}" for kind, packets in forecast.air.items())
    return f"{sum(forecast.air.values()):.2f} packets per message sent: {spent}."


def _line(advice: Advice) -> str:
    """What a change makes better and worse, and by how much. The strongest effects come first."""
    used, then = (f"{share:.0%}" for share in advice.used)
    parts = [f"{then} of the airtime" + (f" instead of {used}" if used != then else "")]
    for word, found in (
        ("younger", [effect for effect in advice.effects if effect.younger]),
        ("older", [effect for effect in advice.effects if effect.older]),
    ):
        found.sort(key=lambda effect: abs(log(effect.age_s[1] / effect.age_s[0])), reverse=True)
        parts += [f"{word}: {', '.join(map(_age, found))}"] if found else []
    for word, found in (
        ("more of", [effect for effect in advice.effects if effect.more]),
        ("less of", [effect for effect in advice.effects if effect.fewer]),
    ):
        shares = [f"{effect.topic} {effect.pdr[0]:.0%} to {effect.pdr[1]:.0%}" for effect in found]
        parts += [f"{word} {', '.join(shares)} arrives"] if found else []
    if advice.harmless:
        parts.append("no topic gets worse")
    verdict = "Better" if advice.harmless else "A trade"
    return f"{verdict}: --set {advice.setting.replace(' ', ' --set ')}: {'; '.join(parts)}"


def _age(effect: Effect) -> str:
    before, after = effect.age_s
    return f"{effect.topic} {before * 1e3:.0f} to {after * 1e3:.0f} ms ({after / before - 1:+.0%})"


def _number(value: float | None, factor: float, form: str) -> str:
    return "–" if value is None else format(value * factor, form)
