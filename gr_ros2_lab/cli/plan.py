"""`gr-ros2 plan`: does this traffic fit this radio, how fresh will it be, and what to change."""

from __future__ import annotations

from contextlib import ExitStack
from math import log
from pathlib import Path
from shlex import quote

import click
from rich import box
from rich.markup import escape
from rich.table import Table

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.params import Number, set_option
from gr_ros2.link.fates import ARRIVED, Fate
from gr_ros2.middleware.bag_files import is_bag
from gr_ros2_lab.cli.params import SCENARIO
from gr_ros2_lab.run.scenario import Scenario, load_scenario
from gr_ros2_lab.study.forecast import Advice, Cut, Effect, Forecast, Planner, prepare_processes
from gr_ros2_lab.study.traffic import link_values, of_recording, recorded_graph

_ADVICE = 3
_BEYOND = 10
"""Times as far as the farthest place of a survey, up to which its fit is said to reach."""
_MOST = 0.95
"""Share of the packets that arrive on a good link."""
_GOOD = 0.9
"""Share of the messages that arrive on a link that is not degraded, as on the dashboard."""
_GRAPH_S = 5.0
_HEADINGS = ("offered [1/s]", "message [B]", "on air [B]", "load", "rate [1/s]", "PDR", "age [ms]", "p99 [ms]")


@click.command()
@click.argument("what", type=SCENARIO, required=False, metavar="[SCENARIO | LINK | BAG]")
@click.option("--bag", type=click.Path(exists=True, path_type=Path), help="With LINK: send this recording.")
@click.option("--graph", is_flag=True, help="With LINK or alone: what is published on the ROS graph now.")
@click.option("--seed", type=int, help="Seed of robots and sender.")
@click.option("--duration", type=Number(0), help="Seconds of traffic; default: of a bag all, of the graph 5.")
@set_option(Scenario)
@click.option("--no-advice", is_flag=True, help="Only the forecast.")
def plan(
    *,
    what: str | None,
    bag: Path | None,
    graph: bool,
    seed: int | None,
    duration: float | None,
    overrides: tuple[str, ...],
    no_advice: bool,
) -> None:
    """Forecast whether messages fit a radio and how fresh they arrive, without sending any, and propose changes.

    SCENARIO is a built-in name or a YAML file. LINK is the YAML file of a link, such as `gr-ros2 link --save` writes,
    with the messages of a recording (--bag) or of the ROS graph (--graph). A BAG alone, or --graph alone, is planned
    for a link with default settings, which --set changes.
    """
    if not no_advice:
        prepare_processes()
    path = None if what is None else Path(what)
    if path is not None and bag is None and is_bag(path):
        path, bag = None, path
    with ExitStack() as stack:
        values = link_values(path, overrides) if path is not None or bag is not None or graph else None
        if values is None:
            if what is None:
                raise click.UsageError("give a scenario, a link's YAML file or a bag, or --graph")
            if bag is not None or graph:
                raise click.UsageError(f"{what}: has no front_end, so it is no link; leave --bag and --graph out")
            planner = Planner(load_scenario(what, overrides, seed=seed, duration_s=duration))
        elif bag is None and not graph:
            raise click.UsageError(f"{what}: says what carries the messages; which ones? --bag FILE or --graph")
        else:
            if graph:
                bag = stack.enter_context(recorded_graph(values, duration or _GRAPH_S))
            assert bag is not None
            planner = Planner(*of_recording(values, bag, duration))
        _tell(planner, not no_advice)


def _tell(planner: Planner, advise: bool) -> None:
    console = make_console()
    with console.status("the link is simulated"):
        if advise:
            planner.begin()
        forecast = planner.forecast()
    phy = planner.phy
    rate = f" at {phy.sample_rate:,.0f} samples/s" if phy.has_samples else ""
    console.print(
        f"{phy.name}{rate}: a packet of {forecast.packet_len} B takes "
        f"{forecast.airtime_s * 1e3:.2f} ms, {forecast.capacity:.3g} packets/s"
        + (f" within airtime ({planner.scenario.airtime.rule})\n" if planner.scenario.airtime.rule else "\n"),
        soft_wrap=True,
    )
    console.print(_table(forecast))
    if (fitting := _fitting(forecast)) is not None:
        console.print(fitting)
    console.print(_verdict(forecast), soft_wrap=True)
    console.print(forecast.in_use, soft_wrap=True)
    if task := planner.task:
        console.print(
            f"The robots drive their own ways here; gr-ros2 run says how well they do task {task!r} over this link.",
            soft_wrap=True,
        )
    if (survey := planner.survey) is not None:
        console.print(f"The channel is that of {survey.name}: {survey.words()}.", soft_wrap=True)
    if words := range_words(planner):
        console.print(words, soft_wrap=True)
    if not advise:
        return
    with console.status("cuts are tried"):
        cuts = planner.cuts()
    if cuts:
        console.print("To make it fit:", soft_wrap=True)
        for cut in cuts:
            console.print(f"  {_cut(cut)}", soft_wrap=True)
        settings = " ".join(f"--set {quote(setting)}" for setting in cuts[-1].settings)
        console.print(f"As settings: {settings}", soft_wrap=True, markup=False)
    with console.status("changes are tried") as status:
        found = planner.advice(not cuts, lambda done, of: status.update(f"changes are tried: {done} of {of}"))
    for advice in found[:_ADVICE]:
        console.print(_line(advice), soft_wrap=True)
    if not found and not cuts:
        console.print(
            "No change of packet_len, compression, pacing or medium makes more better than worse.", soft_wrap=True
        )


def _cut(cut: Cut) -> str:
    what = f"limit {cut.topic} to {cut.rate_hz:g} Hz" if cut.rate_hz else f"drop {cut.topic}"
    return f"{what}: new messages need {cut.load:.0%}"


def range_words(planner: Planner) -> str:
    """How far the link reaches; '' where levels do not follow from positions."""
    half_m = planner.range_m(0.5)
    if half_m is None:
        return ""
    if (survey := planner.survey) is not None and half_m > (known_m := _BEYOND * float(survey.apart.max())):
        return (
            f"The link ends beyond {known_m:.0f} m, {_BEYOND} times as far as the survey goes: it does not tell where."
        )
    return (
        f"The link ends at {half_m:.0f} m: half of the packets arrive there, and {_MOST:.0%} of them up to "
        f"{planner.range_m(_MOST):.0f} m, without walls, shadowing and other robots that send."
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


def _fitting(forecast: Forecast) -> Table | None:
    """What cameras and clouds become that fit what is left; None where there is none."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("Fits what is left", no_wrap=True)
    table.add_column("sent as")
    for heading in ("frames [1/s]", "kbit/s", "age [ms]"):
        table.add_column(escape(heading.replace(" ", "\n")), justify="right", no_wrap=True)
    for topic in forecast.topics:
        if (frames := topic.frames) is not None:
            age = _number(topic.result.age_s.mean, 1e3, ".0f")
            table.add_row(topic.topic, frames.made or "–", f"{frames.rate_hz:.1f}", f"{frames.kbit_s:.0f}", age)
    return table if table.row_count else None


def _verdict(forecast: Forecast) -> str:
    if forecast.load > 1:
        heaviest = max((topic for topic in forecast.topics if topic.frames is None), key=lambda topic: topic.load)
        what = "most of it" if heaviest.load > forecast.load / 2 else "the heaviest topic"
        fits = f"it does not fit, {what} is {heaviest.topic}"
    elif (arrives := _arrives(forecast)) < _GOOD:
        fits = (
            f"the air has room for it, but only {arrives:.0%} of the messages arrive, since packets are lost or collide"
        )
    elif (replaced := _replaced(forecast)) > 1 - _GOOD:
        fits = (
            f"it fits only just: {replaced:.0%} of the messages wait until a newer one replaces them, since repair "
            "and reports take air too"
        )
    else:
        fits = "it fits"
    per_message = _number(forecast.air_bytes_per_message, 1, ".0f")
    air = "of the air" if forecast.allowed == 1 else f"of the {forecast.allowed:.0%} of the air that may be used"
    alone = f"New messages need {forecast.load:.0%} {air}: {fits}"
    return f"{alone}. {per_message} bytes on the air per message delivered."


def _arrives(forecast: Forecast) -> float:
    """Share of all messages that arrive, 0..1, without those that newer ones replaced before they left."""
    left = 1 - _share(forecast, Fate.SUPERSEDED)
    return _share(forecast, *ARRIVED) / left if left else 1.0


def _replaced(forecast: Forecast) -> float:
    """Share of the messages that are to be sent which newer ones replace for want of air, 0..1."""
    topics = [topic for topic in forecast.topics if topic.frames is None]
    wanted = sum(topic.wanted_hz for topic in topics)
    return sum(max(topic.wanted_hz - topic.rate_hz, 0.0) for topic in topics) / wanted if wanted else 0.0


def _share(forecast: Forecast, *fates: Fate) -> float:
    """Share of all messages with these fates, 0..1."""
    results = [topic.result for topic in forecast.topics]
    sent = sum(result.sent for result in results)
    return sum(result.ledger.get(fate.value, 0) for result in results for fate in fates) / sent if sent else 0.0


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
