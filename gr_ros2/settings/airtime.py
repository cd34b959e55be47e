"""How much a robot may send: the settings of ``airtime``, and the rules of bands by name.

Invariant: a setting may be stricter than its band, never laxer.

A band here is what this program can keep by itself: for how long it sends. Power, bandwidth, antenna and, in some
countries, a licence are up to the person who sends. Rules differ by country and change.
"""

from __future__ import annotations

from dataclasses import dataclass as plain
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.effect import ActsWhere, refuse_without_effect
from gr_ros2.settings.fields import AUTO, Auto

HOUR_S = 3600.0


@plain(frozen=True)
class Band:
    """What a rule says of one band.

    :param lowest_hz, highest_hz: its edges, 0 where the rule has none
    :param duty_cycle: share of ``window_s`` that one transmitter may send
    :param max_burst_s: s that it may send without a pause, 0 = no limit
    :param in_clear: whether nothing may be encrypted, and a callsign has to be sent
    :param source: where the rule stands
    """

    source: str
    lowest_hz: float = 0.0
    highest_hz: float = 0.0
    duty_cycle: float = 1.0
    window_s: float = HOUR_S
    max_burst_s: float = 0.0
    in_clear: bool = False


_EU = "ERC/REC 70-03 annex 1, EN 300 220-2; a duty cycle is a share of one hour (EN 300 220-1)"
BANDS = {
    "eu433": Band(_EU, 433.05e6, 434.79e6, 0.1),
    "eu863": Band(_EU, 863e6, 865e6, 0.001),
    "eu865": Band(_EU, 865e6, 868e6, 0.01),
    "eu868": Band(_EU, 868e6, 868.6e6, 0.01),
    "eu868.7": Band(_EU, 868.7e6, 869.2e6, 0.001),
    "eu869.4": Band(_EU, 869.4e6, 869.65e6, 0.1),
    "eu869.7": Band(_EU, 869.7e6, 870e6, 0.01),
    "us915": Band("47 CFR 15.247 (a)(1)(i): 0.4 s in 20 s on one frequency", 902e6, 928e6, 0.02, 20.0, 0.4),
    "amateur": Band("ITU Radio Regulations 25.2A, 47 CFR 97.113 (a)(4), 97.119 (a)", in_clear=True),
}
"""The bands by name. Those of Europe are without LBT and AFA, in 25 mW e.r.p. (``eu433`` 10 mW, ``eu869.4`` 500 mW)."""


@plain(frozen=True)
class AirtimeRule:
    """What holds for one transmitter: at most ``duty_cycle * window_s`` seconds of any ``window_s`` seconds, and at
    most ``max_burst_s`` without a pause (0 = no such limit)."""

    duty_cycle: float = 1.0
    window_s: float = HOUR_S
    max_burst_s: float = 0.0

    def __str__(self) -> str:
        words = [f"{self.duty_cycle:.3g} of any {self.window_s:g} s"] if self.duty_cycle < 1 else []
        return ", ".join([*words, *([f"at most {self.max_burst_s:g} s at a time"] if self.max_burst_s else [])])


def _sends(given: Any) -> Any:
    """A share that lets something leave: ``auto`` in its place would mean no limit."""
    if isinstance(given, int | float) and not isinstance(given, bool) and given <= 0:
        raise ValueError(
            "nothing could be sent; set transmit: false (--listen-only) for that, or a share above 0 to 1, as in 0.01"
        )
    return given


_STRICT = ConfigDict(extra="forbid", str_strip_whitespace=True)


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class AirtimeConfig:
    """How much a robot may send, whatever waits (docs/how-to/radios.md)."""

    band: str = ""
    """rules of a band by name, which hold beside the other settings: `eu433`, `eu863`, `eu865`, `eu868`, `eu868.7`,
    `eu869.4`, `eu869.7`, `us915`, `amateur`; '' = none"""
    duty_cycle: Annotated[
        Annotated[float, Field(gt=0, le=1)] | Auto,
        BeforeValidator(_sends),
        Field(title="Largest share of the time that it sends"),
    ] = AUTO
    """largest share of any ``window_s`` in which it sends, above 0 to 1; auto = the band's, without one no limit"""
    window_s: Annotated[
        Annotated[float, Field(ge=1, le=86400, allow_inf_nan=False)] | Auto, Field(title="Time of that share (s)")
    ] = AUTO
    """s over which ``duty_cycle`` holds; auto = the band's, without one an hour"""
    max_burst_s: Annotated[
        Annotated[float, Field(ge=0, allow_inf_nan=False)] | Auto, Field(title="Longest time without a pause (s)")
    ] = AUTO
    """most s without a pause of 0.1 s, 0 = no limit; auto = the band's, without one no limit"""
    listen_before_send: bool = False
    """a packet waits while the receiver hears a signal; for SDRs with ``half_duplex``"""
    conditions: ClassVar[Any] = (
        ActsWhere(
            ("window_s",),
            lambda airtime: airtime.duty_cycle != AUTO or airtime.of_band.duty_cycle < 1,
            "has no effect without a share; set duty_cycle, or leave it out",
        ),
    )

    @model_validator(mode="after")
    def _within_band(self) -> AirtimeConfig:
        band = self.of_band
        if band is None:
            raise ValueError(f"band = {self.band!r}: no such band; known are {', '.join(BANDS)}")
        refuse_without_effect(self)
        if not self.band:
            return self
        rule = self.rule
        if rule is not None and rule.duty_cycle * rule.window_s > band.duty_cycle * band.window_s * (1 + 1e-9):
            raise ValueError(
                f"duty_cycle = {rule.duty_cycle:g} of {rule.window_s:g} s: band {self.band} allows "
                f"{band.duty_cycle:g} of {band.window_s:g} s; leave it out, or set a smaller one"
            )
        if rule is not None and rule.window_s > band.window_s:
            raise ValueError(
                f"window_s = {rule.window_s:g}: band {self.band} counts {band.window_s:g} s; leave it out, or set less"
            )
        if band.max_burst_s and not 0 < (rule.max_burst_s if rule else 0) <= band.max_burst_s:
            raise ValueError(
                f"max_burst_s = {self.max_burst_s}: band {self.band} allows {band.max_burst_s:g} s; leave it out, or "
                "set less"
            )
        return self

    def check_seal(self, *, encrypts: bool) -> None:
        """:raises ConfigError: for a robot that encrypts in a band that forbids it"""
        band = self.of_band
        if band is not None and band.in_clear and encrypts:
            raise ConfigError(
                f"airtime.band = {self.band!r}: forbids encryption ({band.source}); set seal: authenticate"
            )

    @property
    def of_band(self) -> Band | None:
        """The band; one without limits where none is named; None for a name that is not known."""
        return BANDS.get(self.band, None if self.band else Band(""))

    @property
    def rule(self) -> AirtimeRule | None:
        """What holds; None where nothing is limited."""
        band = self.of_band or Band("")
        rule = AirtimeRule(
            band.duty_cycle if self.duty_cycle == AUTO else self.duty_cycle,
            band.window_s if self.window_s == AUTO else self.window_s,
            band.max_burst_s if self.max_burst_s == AUTO else self.max_burst_s,
        )
        return rule if rule.duty_cycle < 1 or rule.max_burst_s else None


def _by_name(given: Any) -> Any:
    return {"band": given} if isinstance(given, str) else given


Airtime = Annotated[AirtimeConfig, BeforeValidator(_by_name)]
"""The settings, or the name of a band alone."""
