"""What a limit of airtime means for a link, or what a band limits: shares as seconds and as packets.

Invariant: nothing is opened but the account file, and that only if no running link uses it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from gr_ros2.core.errors import ConfigError
from gr_ros2.doctor.finding import Check, Finding
from gr_ros2.link.airtime_limit import BURST, AirtimeLimit, sustained
from gr_ros2.phy import configured
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.config import LinkConfig, load_link
from gr_ros2.settings.airtime import BANDS, AirtimeConfig, AirtimeRule
from gr_ros2.settings.config import airtime_from, build
from gr_ros2.settings.fields import AUTO
from gr_ros2.state.airtime import AirtimeFile

_GROUP = "Airtime"
_SET = "set airtime to a band, or to {duty_cycle: 0.01, window_s: 3600} (docs/how-to/radios.md)"


def airtime_checks(what: str, overrides: Sequence[str] = ()) -> tuple[Check, ...]:
    """The checks of one limit.

    :param what: the YAML file of a link, or the name of a band
    :param overrides: settings of the link that are changed, ``key=value``
    :raises ConfigError: when it is neither, or a setting is wrong
    """
    if what in BANDS and not Path(what).exists():
        limits = airtime_from(what)
        return (Check(_GROUP, "band", lambda: _limit(limits)),)
    if not Path(what).exists():
        raise ConfigError(
            f"{what!r}: neither a link's YAML file nor a band; known bands are {', '.join(filter(None, BANDS))}"
        )
    config = load_link(what, overrides)
    return (
        Check(_GROUP, "limit", lambda: _limit(config.airtime, config)),
        Check(_GROUP, "packets", lambda: _packets(config)),
        Check(_GROUP, "account", lambda: _account(config)),
    )


def _limit(limits: AirtimeConfig, config: LinkConfig | None = None) -> Iterator[Finding]:
    """How much the limit allows, and where it stands."""
    band, rule = limits.of_band, limits.rule
    if rule is None:
        text = "no limit of time: it may send without end"
        asked = config is not None and not limits.band and FRONT_ENDS.load(config.front_end_name).has_radio
        yield Finding("limit", "warning", text, _SET) if asked else Finding("limit", "note", text)
    else:
        yield Finding("limit", "ok", _meaning(rule))
    if limits.band and band is not None:
        edges = f"{band.lowest_hz / 1e6:g} to {band.highest_hz / 1e6:g} MHz; " if band.highest_hz else ""
        clear = "callsign in clear, no encryption; " if band.in_clear else ""
        yield Finding(
            f"band {limits.band}",
            "note",
            f"{edges}{clear}{band.source}. Power, bandwidth and licence are up to you",
        )


def _meaning(rule: AirtimeRule) -> str:
    words = []
    if rule.duty_cycle < 1:
        allowed = rule.duty_cycle * rule.window_s
        words.append(
            f"{allowed:.3g} s of any {rule.window_s:g} s ({100 * rule.duty_cycle:.3g} %): {BURST * allowed:.3g} s of "
            f"it at once, the rest evenly, {100 * sustained(rule):.3g} % of the time at full load"
        )
    if rule.max_burst_s:
        words.append(f"at most {rule.max_burst_s:g} s without a pause")
    return "; ".join(words)


def _packets(config: LinkConfig) -> Iterator[Finding]:
    """The limit in packets of this link."""
    rule, rate = config.airtime.rule, config.phy.sample_rate
    front_end = FRONT_ENDS.load(config.front_end_name)
    phy = configured(config.phy, config.packet_len, 0.0 if rate == AUTO else rate)
    if not front_end.any_length:
        phy.pad_all()
    airtime = front_end.airtime_with(phy, build(front_end.Options, config.front_end_options, "front_end"))
    text = f"one of {config.packet_len} B takes {airtime:.3g} s"
    if rule is None or not airtime:
        yield Finding("packets", "ok", text)
        return
    try:
        AirtimeLimit(rule, airtime)
    except ConfigError as error:
        what, _, remedy = str(error).removeprefix("airtime: ").partition("; ")
        yield Finding("packets", "failed", what, remedy)
        return
    if rule.duty_cycle < 1:
        per_window = rule.duty_cycle * rule.window_s / airtime
        text += (
            f": {per_window:,.0f} of them in {rule.window_s:g} s, {BURST * per_window:,.0f} at once, then one every "
            f"{airtime / sustained(rule):.3g} s"
        )
    yield Finding("packets", "ok", text)


def _account(config: LinkConfig) -> Iterator[Finding]:
    """What this robot has sent of it already."""
    from gr_ros2.gr.starts import account_of  # loads GNU Radio

    rule = config.airtime.rule
    if rule is None or rule.duty_cycle == 1:
        return
    path = account_of(config.state, config.robot_id)
    try:
        file = AirtimeFile(path)
    except ConfigError as error:
        what, _, remedy = str(error).partition("; ")
        if "another link" in what:
            yield Finding("account", "note", "a running link has it; gr-ros2 status shows what it has sent")
        else:
            yield Finding("account", "failed", what, remedy)
        return
    counts = sum(airtime for until, airtime in file.spent if until > -rule.window_s)
    file.close()
    yield Finding("account", "ok", f"{counts:.3g} of {rule.duty_cycle * rule.window_s:.3g} s sent or reserved; {path}")
